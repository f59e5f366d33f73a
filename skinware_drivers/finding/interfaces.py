"""Find CAN interfaces of the kernel, and adapters through the libraries of their makers."""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import json
import os
import shutil
import socket
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from skinware_drivers.can.controller import Controller, read_controller

_STATES = ("ERROR-ACTIVE", "ERROR-WARNING", "ERROR-PASSIVE", "BUS-OFF", "STOPPED", "SLEEPING")
_ARPHRD_CAN = 280
_IFF_UP = 1
_FD_MTU = 72
_STATISTICS = ("rx_packets", "tx_packets", "rx_errors", "tx_errors", "rx_dropped", "tx_dropped", "rx_over_errors")
_IP_TIMEOUT_S = 5.0
_SYSTEM_PATH = "/usr/sbin:/sbin:/usr/bin:/bin"

NO_INTERFACE = (
    "no CAN interface: is the adapter plugged in? For one without hardware:"
    " sudo modprobe vcan; sudo ip link add dev vcan0 type vcan; sudo ip link set vcan0 up"
)


@dataclass(frozen=True)
class CanInterface:
    """One interface.

    Attributes:
        name: ``can0``.
        kind: ``can`` (a controller), ``vcan``, ``vxcan``; ``virtual`` where iproute2 is missing.
        driver: kernel driver of the hardware, empty without.
        up: it is set up.
        carrier: what the kernel calls its operational state: ``up``, ``down``, ``unknown``.
        bit_rate: bit/s of the arbitration phase; None: not set, has none, or not known.
        data_bit_rate: of the data phase of CAN FD.
        sample_point: 0 to 1.
        state: of the controller: ``ERROR-ACTIVE``, ``ERROR-PASSIVE``, ``BUS-OFF``, ``STOPPED`` ...; empty: not known.
        restart_ms: pause before it comes back from bus-off by itself; 0: it does not; None: not known.
        is_fd: frames of CAN FD can pass.
        queue_length: frames that wait for the wire at most, in the kernel.
        statistics: what went through, as the kernel counts it.
        controller_errors: ``bus_error``, ``arbitration_lost``, ``error_passive``, ``bus_off`` ...; of controllers.
    """

    name: str
    kind: str
    driver: str
    up: bool
    carrier: str
    is_fd: bool
    queue_length: int
    bit_rate: int | None = None
    data_bit_rate: int | None = None
    sample_point: float | None = None
    state: str = ""
    restart_ms: int | None = None
    statistics: dict[str, int] = field(default_factory=dict)
    controller_errors: dict[str, int] = field(default_factory=dict)

    def advice(self) -> list[str]:
        """What to do so that it works, a line each; empty if it does."""
        name, told = self.name, []
        if not self.up and self.kind == "can" and self.bit_rate is None:
            told.append(
                f"down: sudo ip link set {name} type can bitrate 1000000 restart-ms 100; sudo ip link set {name} up"
            )
        elif not self.up:
            told.append(f"down: sudo ip link set {name} up")
        if self.state == "BUS-OFF":
            told.append("off the bus after too many errors in sending: check wires, termination and bit rate")
            if not self.restart_ms:
                told.append(
                    f"it stays off until: sudo ip link set {name} down; sudo ip link set {name} type can"
                    f" restart-ms 100; sudo ip link set {name} up"
                )
        elif self.state in ("ERROR-PASSIVE", "ERROR-WARNING"):
            told.append("many errors on the wire: check wires, termination, bit rate, and that another device is there")
        return told


def kernel_has_can() -> bool:
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except OSError as error:
        return error.errno not in (errno.EAFNOSUPPORT, errno.EPROTONOSUPPORT)
    return True


def can_interfaces(
    root: Path = Path("/sys"),
    links: dict[str, dict[str, Any]] | None = None,
    controller: Callable[[str], Controller | None] = read_controller,
) -> list[CanInterface]:
    """All CAN interfaces, by name.

    Args:
        root: where sysfs is.
        links: what iproute2 says of each interface; default: it is asked.
        controller: tells bit rate and state where iproute2 does not.
    """
    told = ask_iproute2() if links is None else links
    folders = sorted((root / "class/net").glob("*"))
    found = [_interface(folder, told.get(folder.name, {})) for folder in folders if _is_can(folder)]
    return [one if told else _with_controller(one, controller(one.name)) for one in found]


def ask_iproute2() -> dict[str, dict[str, Any]]:
    """What ``ip`` says of all interfaces; empty if it is missing or too old for JSON."""
    command = shutil.which("ip") or shutil.which("ip", path=_SYSTEM_PATH)
    if command is None:
        return {}
    arguments = [command, "-j", "-details", "-statistics", "link", "show"]
    with contextlib.suppress(OSError, subprocess.SubprocessError, ValueError):
        done = subprocess.run(arguments, capture_output=True, timeout=_IP_TIMEOUT_S, check=True)
        return {link["ifname"]: link for link in json.loads(done.stdout) if "ifname" in link}
    return {}


def _is_can(folder: Path) -> bool:
    return _number(folder / "type") == _ARPHRD_CAN


def _with_controller(one: CanInterface, controller: Controller | None) -> CanInterface:
    """What our own question to the kernel told added."""
    if controller is None:
        return one
    known = controller.state is not None and controller.state < len(_STATES)
    return dataclasses.replace(
        one,
        kind="can",
        bit_rate=controller.bit_rate or None,
        state=_STATES[controller.state or 0] if known else "",
        restart_ms=controller.restart_ms,
    )


def _interface(folder: Path, link: dict[str, Any]) -> CanInterface:
    info: dict[str, Any] = link.get("linkinfo", {})
    data: dict[str, Any] = info.get("info_data", {})
    has_hardware = (folder / "device").exists()
    driver = (folder / "device/driver").resolve().name if (folder / "device/driver").exists() else ""
    timing = data.get("bittiming", {})
    return CanInterface(
        name=folder.name,
        kind=info.get("info_kind", "can" if has_hardware else "virtual"),
        driver=driver,
        up=bool((_number(folder / "flags", 16) or 0) & _IFF_UP),
        carrier=_text(folder / "operstate"),
        is_fd=(_number(folder / "mtu") or 0) >= _FD_MTU,
        queue_length=_number(folder / "tx_queue_len") or 0,
        bit_rate=timing.get("bitrate") or None,
        data_bit_rate=data.get("data_bittiming", {}).get("bitrate") or None,
        sample_point=float(timing["sample_point"]) if timing.get("sample_point") else None,
        state=data.get("state", ""),
        restart_ms=data.get("restart_ms", 0 if data.get("state") else None),
        statistics={name: _number(folder / "statistics" / name) or 0 for name in _STATISTICS},
        controller_errors={name: int(count) for name, count in info.get("info_xstats", {}).items()},
    )


def _text(path: Path) -> str:
    try:
        return path.read_text().strip()
    except OSError:  # gone meanwhile, or not told
        return ""


def _number(path: Path, base: int = 10) -> int | None:
    try:
        return int(_text(path), base)
    except ValueError:
        return None


_NOT_ASKED = ("socketcan", "serial", "virtual", "udp_multicast", "socketcand")
"""Looked at otherwise, no adapters, or (socketcand) waits four seconds for who may announce himself in the network."""


@dataclass(frozen=True)
class CanAdapterFound:
    """A channel of an adapter.

    Attributes:
        bus: its name for ``--bus``: ``kvaser:0``.
        details: what else the library told.
    """

    bus: str
    details: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Detection:
    """What python-can found.

    Attributes:
        found: adapters.
        problem: what went wrong, empty if nothing did.
    """

    found: list[CanAdapterFound] = field(default_factory=list)
    problem: str = ""


def detect_adapters(timeout_s: float, command: list[str] | None = None) -> Detection:
    """Ask all interfaces of python-can that can tell.

    Args:
        timeout_s: longest time for all of them.
        command: the process to start, for tests.
    """
    process = subprocess.Popen(
        command or [sys.executable, "-m", __name__],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    in_time = True
    try:
        output, _ = process.communicate(timeout=timeout_s)
    except subprocess.TimeoutExpired:
        in_time = False
        process.kill()
        output, _ = process.communicate()
    found, asked, is_over = _read(output)
    if is_over:
        return Detection(found)
    how = f"did not answer within {timeout_s:g} s" if not in_time else "ended the search"
    return Detection(found, f"python-can's interface {asked!r} {how}" if asked else f"python-can {how}")


def _read(output: str) -> tuple[list[CanAdapterFound], str, bool]:
    """Adapters, the interface that was asked last, and whether all were asked. Libraries may print what they like."""
    found: list[CanAdapterFound] = []
    asked = ""
    for line in output.splitlines():
        try:
            told = json.loads(line)
            asked, configs = told["asked"], told["configs"]
        except (ValueError, TypeError, KeyError):
            continue
        if asked is None:
            return found, "", True
        for config in configs:
            interface, channel = config.pop("interface", asked), config.pop("channel", "")
            found.append(CanAdapterFound(f"{interface}:{channel}", config))
    return found, asked, False


def _tell(asked: str | None, configs: list[dict[str, Any]]) -> None:
    sys.stdout.write(json.dumps({"asked": asked, "configs": configs}, default=str) + "\n")
    sys.stdout.flush()


def main() -> None:
    """Ask one interface after the other; tell which is asked before and what it found afterwards."""
    import can

    for name in sorted(set(can.VALID_INTERFACES) - set(_NOT_ASKED)):
        _tell(name, [])
        _tell(name, [dict(config) for config in can.detect_available_configs(interfaces=[name])])
    _tell(None, [])
    os._exit(0)  # whatever threads and exit handlers the libraries have


if __name__ == "__main__":
    main()
