"""A machine in a folder: sysfs, device files and procfs as the kernel would show them."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from skinware.memory.namespace import Namespace
from skinware_drivers.bus import FrameBatch
from skinware_drivers.can.controller import Controller
from skinware_drivers.finding import running
from skinware_drivers.finding.guess import Traffic
from skinware_drivers.finding.ports import Machine


def see_only(namespace: Namespace, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let only the drivers of one namespace run on this machine: other tests may have theirs."""
    (folder / namespace.path.name).mkdir()
    monkeypatch.setattr(running, "ROOT", folder)


def write(folder: Path, **files: object) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in files.items():
        (folder / name).write_text(f"{text}\n")


def add_interface(root: Path, name: str, *, driver: str = "", flags: int = 0x1003, **files: object) -> None:
    """An interface of sysfs; a CAN interface unless ``type`` says otherwise."""
    told: dict[str, object] = {"type": 280, "operstate": "up", "mtu": 16, "tx_queue_len": 10, **files}
    folder = root / "class/net" / name
    write(folder, flags=hex(flags), **told)
    write(folder / "statistics", rx_packets=1234, tx_packets=5, rx_errors=2)
    if driver:
        (root / "drivers" / driver).mkdir(parents=True)
        (folder / "device").mkdir()
        (folder / "device/driver").symlink_to(root / "drivers" / driver)


class FakeMachine:
    """Serial ports on USB in a folder.

    Attributes:
        machine: for ``serial_ports``.
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        self.machine = Machine(root / "sys", root / "dev", root / "proc")
        for folder in ("sys/class/tty", "dev", "proc"):
            (root / folder).mkdir(parents=True)

    def add_usb_port(
        self,
        name: str,
        driver: str,
        vendor_id: str,
        product_id: str,
        serial: str = "",
        *,
        place: str = "1-1.2",
        **more: str,
    ) -> Path:
        """As ftdi_sio shows it: device, interface, and (unlike cdc_acm) a port of its own below that."""
        device = self.root / "sys/devices/usb1" / place
        interface = device / f"{place}:1.0"
        port = interface / name if driver == "ftdi_sio" else interface
        write(device, idVendor=vendor_id, idProduct=product_id)
        if serial:
            write(device, serial=serial)
        write(device, **more)
        write(interface, bInterfaceNumber="00")
        write(port)
        drivers = self.root / "sys/drivers" / driver
        drivers.mkdir(parents=True, exist_ok=True)
        if driver == "ftdi_sio":
            write(port, latency_timer=16)
        (port / "driver").symlink_to(drivers)
        return self._add(name, port)

    def add_uart(self, name: str, kind: int) -> Path:
        """A built-in port; of kind 0 there is nothing behind it."""
        chip = self.root / "sys/devices/pnp" / name
        device = chip / f"{name}:0" / f"{name}:0.0"
        write(device)
        for folder, subsystem, driver in (
            (chip, "pnp", "serial"),
            (device.parent, "serial-base", "ctrl"),
            (device, "serial-base", "port"),
        ):
            for link, target in (("subsystem", subsystem), ("driver", driver)):
                (folder / link).symlink_to(self.root / "sys/bus" / target)
                (self.root / "sys/bus" / target).mkdir(parents=True, exist_ok=True)
        path = self._add(name, device)
        write(self.root / "sys/class/tty" / name, type=kind)
        return path

    def add_process(self, pid: int, program: str, *paths: Path) -> None:
        write(self.root / "proc" / str(pid), comm=program)
        descriptors = self.root / "proc" / str(pid) / "fd"
        descriptors.mkdir()
        for number, path in enumerate(paths):
            os.symlink(path, descriptors / str(number))

    def _add(self, name: str, device: Path) -> Path:
        write(self.root / "sys/class/tty" / name)
        (self.root / "sys/class/tty" / name / "device").symlink_to(device)
        path = self.root / "dev" / name
        path.touch(mode=0o660)
        return path


def traffic_of(*frames: tuple[int, str], times: int = 1, payload_size: int = 64) -> Traffic:
    """Frames (identifier, payload in hex), ``times`` over."""
    traffic = Traffic()
    for _ in range(times):
        batch = FrameBatch(len(frames), payload_size)
        for identifier, payload in frames:
            batch.append(0, 0, identifier, bytes.fromhex(payload))
        traffic.take(batch)
    return traffic


CONTROLLER = Controller(1_000_000, 0, 100, sample_point=0.75, errors={"error_warning": 3, "restarts": 1})
"""One that works."""


SKIN = [(0x473, "40 F0 F0 F0 F0 F0 F0 F0"), (0x473, "C0 F0 F0 F0 F0 F0 00 00")]
"""A head and a tail of board 7, triangle 3."""
