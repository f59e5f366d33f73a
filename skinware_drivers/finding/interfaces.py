"""Find CAN interfaces of the kernel."""

from __future__ import annotations

import errno
import socket
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from skinware_drivers.can.controller import Controller, read_link
from skinware_drivers.finding.ports import text_of

_STATES = ("ERROR-ACTIVE", "ERROR-WARNING", "ERROR-PASSIVE", "BUS-OFF", "STOPPED", "SLEEPING")
_ARPHRD_CAN = 280
_IFF_UP = 1
_FD_MTU = 72
_STATISTICS = ("rx_packets", "tx_packets", "rx_errors", "tx_errors", "rx_dropped", "tx_dropped", "rx_over_errors")

NO_INTERFACE = (
    "no CAN interface: is the adapter plugged in? For one without hardware:"
    " sudo modprobe vcan; sudo ip link add dev vcan0 type vcan; sudo ip link set vcan0 up"
)


@dataclass(frozen=True)
class CanInterface:
    """A CAN interface of the kernel.

    Attributes:
        name: ``can0``.
        kind: ``can`` (a controller), ``vcan``, ``vxcan``; ``virtual``: unknown.
        driver: kernel driver of the hardware; empty: none.
        carrier: operational state of the kernel: ``up``, ``down``, ``unknown``.
        bit_rate: bit/s of the arbitration phase; None: not set, or unknown.
        data_bit_rate: of the data phase of CAN FD.
        sample_point: 0 to 1.
        state: of the controller: ``ERROR-ACTIVE``, ``ERROR-PASSIVE``, ``BUS-OFF``, ``STOPPED`` ...; empty: unknown.
        restart_ms: pause before it restarts after bus-off; 0: it does not; None: unknown.
        queue_length: most frames that wait for the wire in the kernel.
        controller_errors: counters of the controller: ``bus_error``, ``arbitration_lost``, ``bus_off`` ...
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
        """Return what to do so that it works, a line each; empty if it works."""
        name, lines = self.name, []
        if not self.up and self.kind == "can" and self.bit_rate is None:
            lines.append(
                f"down: sudo ip link set {name} type can bitrate 1000000 restart-ms 100; sudo ip link set {name} up"
            )
        elif not self.up:
            lines.append(f"down: sudo ip link set {name} up")
        if self.state == "BUS-OFF":
            lines.append("off the bus after too many errors while sending: check wires, termination and bit rate")
            if not self.restart_ms:
                lines.append(
                    f"it stays off until: sudo ip link set {name} down; sudo ip link set {name} type can"
                    f" restart-ms 100; sudo ip link set {name} up"
                )
        elif self.state in ("ERROR-PASSIVE", "ERROR-WARNING"):
            lines.append(
                "many errors on the wire: check wires, termination, bit rate, and that another device is on it"
            )
        return lines


def kernel_has_can() -> bool:
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except OSError as error:
        return error.errno not in (errno.EAFNOSUPPORT, errno.EPROTONOSUPPORT)
    return True


def can_interfaces(
    root: Path = Path("/sys"), ask: Callable[[str], tuple[str, Controller | None]] = read_link
) -> list[CanInterface]:
    """Return all CAN interfaces, by name; ``ask`` returns kind and controller of one."""
    folders = sorted((root / "class/net").glob("*"))
    return [_interface(folder, *ask(folder.name)) for folder in folders if _number(folder / "type") == _ARPHRD_CAN]


def _interface(folder: Path, kind: str, controller: Controller | None) -> CanInterface:
    own = controller or Controller()
    has_state = own.state is not None and own.state < len(_STATES)
    has_hardware = controller is not None or (folder / "device").exists()
    return CanInterface(
        name=folder.name,
        kind=kind or ("can" if has_hardware else "virtual"),
        driver=(folder / "device/driver").resolve().name if (folder / "device/driver").exists() else "",
        up=bool((_number(folder / "flags", 16) or 0) & _IFF_UP),
        carrier=text_of(folder / "operstate"),
        is_fd=(_number(folder / "mtu") or 0) >= _FD_MTU,
        queue_length=_number(folder / "tx_queue_len") or 0,
        bit_rate=own.bit_rate or None,
        data_bit_rate=own.data_bit_rate or None,
        sample_point=own.sample_point or None,
        state=_STATES[own.state or 0] if has_state else "",
        restart_ms=None if controller is None else own.restart_ms,
        statistics={name: _number(folder / "statistics" / name) or 0 for name in _STATISTICS},
        controller_errors=dict(own.errors),
    )


def _number(path: Path, base: int = 10) -> int | None:
    try:
        return int(text_of(path), base)
    except ValueError:
        return None
