"""Find serial ports, their permissions and users, and write udev rules for them."""

from __future__ import annotations

import os
import pwd
import re
from collections.abc import Iterable
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

from skinware_drivers.serial.ports import group_that_may

SLOW_LATENCY_MS = 1
"""A latency timer above this holds data back: FTDI's default is 16 ms."""
_UNKNOWN_UART = "0"
_NO_HARDWARE = "serial-base"
"""Subsystem of the devices (port, ctrl) between a built-in port and its hardware, since kernel 6.5."""


@dataclass(frozen=True)
class UsbIdentity:
    """The identity of a USB device.

    Attributes:
        vendor_id: ``0403``.
        product_id: ``6001``.
        serial_number: empty if it has none.
        place: USB socket: ``1-1.2``.
        interface: number of the port's interface: ``00``.
    """

    vendor_id: str
    product_id: str
    serial_number: str
    manufacturer: str
    product: str
    place: str
    interface: str


@dataclass(frozen=True)
class User:
    pid: int
    program: str


@dataclass(frozen=True)
class SerialPort:
    """A serial port.

    Attributes:
        path: ``/dev/ttyUSB0``.
        driver: of the kernel: ``ftdi_sio``, ``cdc_acm``.
        usb: None: the port is not on USB.
        links: other names, which do not change with the order of plugging in.
        group: its members may open it; empty: none.
        in_group: this user is a member, perhaps not yet in this session.
        users_known: all processes could be examined; False: there may be other users.
        latency_ms: latency timer of FTDI; None: it has none.
    """

    path: str
    driver: str
    usb: UsbIdentity | None
    links: tuple[str, ...]
    may_open: bool
    group: str
    in_group: bool
    users: tuple[User, ...] = ()
    users_known: bool = False
    latency_ms: int | None = None

    @property
    def name(self) -> str:
        if self.usb is None:
            return "pseudo terminal" if Path(self.path).parent.name == "pts" else "built-in port"
        return " ".join(part for part in (self.usb.manufacturer, self.usb.product) if part) or "USB serial device"

    def advice(self) -> list[str]:
        """Return what to do so that it works well, a line each; empty if it does."""
        lines = []
        if not self.may_open and self.in_group:
            lines.append(f"you may not open it yet: log out and in again, you are in group {self.group} since then")
        elif not self.may_open and self.group:
            lines.append(f"you may not open it: sudo usermod -aG {self.group} $USER, then log out and in again")
        elif not self.may_open:
            lines.append("you may not open it: give it a group or uaccess by a udev rule (skin-find --udev)")
        if self.latency_ms is not None and self.latency_ms > SLOW_LATENCY_MS:
            lines.append(
                f"holds data back for up to {self.latency_ms} ms, unless a program asks it not to, as skin-driver does;"
                " for all programs, a udev rule: skin-find --udev"
            )
        return lines


@dataclass(frozen=True)
class Machine:
    """The roots of the file systems to read, which tests replace."""

    sys: Path = Path("/sys")
    dev: Path = Path("/dev")
    proc: Path = Path("/proc")


def serial_ports(machine: Machine | None = None) -> list[SerialPort]:
    machine = machine or Machine()
    devices = {
        folder.name: (folder / "device").resolve()
        for folder in (machine.sys / "class/tty").glob("*")
        if (folder / "device").exists() and text_of(folder / "type") != _UNKNOWN_UART
    }
    present = {name: machine.dev / name for name in devices if (machine.dev / name).exists()}
    links: dict[Path, tuple[str, ...]] = {}  # by identity, by place, and from our rules: they do not change
    for folder in ("skin", "serial/by-id", "serial/by-path"):
        for link in sorted((machine.dev / folder).glob("*")):
            if link.is_symlink():
                links[link.resolve()] = (*links.get(link.resolve(), ()), str(link))
    users, all_seen = _users(machine, set(present.values()))
    return [
        _port(path, devices[name], links.get(path, ()), users.get(path, ()), all_seen)
        for name, path in sorted(
            present.items(), key=lambda item: re.sub(r"\d+", lambda number: number[0].zfill(6), item[0])
        )
    ]


def pseudo_terminal(path: str) -> SerialPort | None:
    """Return the pseudo terminal of a path, as ``skin-emulate --bus pty:port`` makes it; None if it is not one."""
    machine = Machine()
    real = Path(path).resolve()
    if real.parent != machine.dev / "pts" or not real.is_char_device():
        return None
    users, all_seen = _users(machine, {real})
    links = (path,) if path != str(real) else ()
    return _port(real, machine.sys / "devices/virtual", links, users.get(real, ()), all_seen)


def _port(path: Path, device: Path, links: tuple[str, ...], users: tuple[User, ...], all_seen: bool) -> SerialPort:
    info = path.stat()
    group = group_that_may(info)
    latency = text_of(device / "latency_timer")
    try:
        user_name = pwd.getpwuid(os.geteuid()).pw_name
    except KeyError:
        user_name = ""
    driven = device
    while (driven / "subsystem").resolve().name == _NO_HARDWARE:
        driven = driven.parent
    return SerialPort(
        path=str(path),
        driver=(driven / "driver").resolve().name if (driven / "driver").exists() else "",
        usb=_usb_identity(device),
        links=links,
        may_open=os.access(path, os.R_OK | os.W_OK),
        group=group.gr_name if group else "",
        in_group=group is not None and user_name in group.gr_mem,
        users=users,
        users_known=all_seen,
        latency_ms=int(latency) if latency.isdigit() else None,
    )


def _usb_identity(device: Path) -> UsbIdentity | None:
    """Return the USB device above a port's device in sysfs: port, interface, device."""
    interface = ""
    for folder in (device, *device.parents):
        if (folder / "idVendor").exists():
            return UsbIdentity(
                vendor_id=text_of(folder / "idVendor"),
                product_id=text_of(folder / "idProduct"),
                serial_number=text_of(folder / "serial"),
                manufacturer=text_of(folder / "manufacturer"),
                product=text_of(folder / "product"),
                place=folder.name,
                interface=interface,
            )
        interface = interface or text_of(folder / "bInterfaceNumber")
    return None


def _users(machine: Machine, paths: set[Path]) -> tuple[dict[Path, tuple[User, ...]], bool]:
    """Return the users of the paths, and whether every process could be examined."""
    found: dict[Path, list[User]] = {}
    all_seen = True
    for process in machine.proc.glob("[0-9]*"):
        try:
            targets = {os.readlink(link) for link in (process / "fd").iterdir()}
        except PermissionError:
            all_seen = False
            continue
        except OSError:  # it ended meanwhile
            continue
        for path in paths:
            # the maker of a pseudo terminal keeps it open for other programs
            infos = (process / "fdinfo").glob("*") if path.parent.name == "pts" else ()
            is_maker = any(f"tty-index:\t{path.name}" in text_of(info).splitlines() for info in infos)
            if str(path) in targets and int(process.name) != os.getpid() and not is_maker:
                found.setdefault(path, []).append(User(int(process.name), text_of(process / "comm")))
    return {path: tuple(users) for path, users in found.items()}, all_seen


def text_of(path: Path) -> str:
    """Return the text of a file without spaces at its ends; empty if it cannot be read."""
    try:
        return path.read_text(errors="replace").strip()
    except OSError:
        return ""


RULES_FILE = "70-skinware.rules"
PLACE = f"/etc/udev/rules.d/{RULES_FILE}"
RELOAD = (
    "sudo udevadm control --reload-rules",
    "sudo udevadm trigger --subsystem-match=tty --subsystem-match=usb-serial",
)
_USUAL_GROUP = "dialout"
_NO_LETTER = re.compile(r"[^A-Za-z0-9_.:-]")


def shipped_rules() -> str:
    return (files("skinware_drivers") / "data" / RULES_FILE).read_text()


def rules_for(ports: Iterable[SerialPort]) -> str:
    """Return a rules file for these ports on USB; other ports always keep their names."""
    lines = []
    for port in ports:
        usb = port.usb
        if usb is not None:
            which = f"serial number {usb.serial_number}"
            if not usb.serial_number:
                which = f"no serial number, in socket {usb.place}"
            lines += [
                "",
                f"# {port.path}: {_NO_LETTER.sub(' ', port.name)}, {_NO_LETTER.sub(' ', which)}",
                *_rules(port, usb),
            ]
    if not lines:
        return ""
    head = [f"# {PLACE}: fixed names of serial skin hardware", f"# then: {'; '.join(RELOAD)}"]
    return "\n".join([*head, *lines, ""])


def _rules(port: SerialPort, usb: UsbIdentity) -> list[str]:
    # the name below /dev: by serial number, or without one by the USB socket
    link = f"skin/{_NO_LETTER.sub('_', usb.serial_number or f'usb-{usb.place}')}"
    if usb.interface not in ("", "00"):
        link += f"-if{usb.interface}"
    # all ATTRS (and KERNELS) of a rule must hold of one and the same parent: the USB device
    device = [f'ATTRS{{idVendor}}=="{usb.vendor_id}"', f'ATTRS{{idProduct}}=="{usb.product_id}"']
    if usb.serial_number:
        device.append(f'ATTRS{{serial}}=="{_NO_LETTER.sub("?", usb.serial_number)}"')
    else:
        device.append(f'KERNELS=="{usb.place}"')
    interface = [f'ENV{{ID_USB_INTERFACE_NUM}}=="{usb.interface}"'] if usb.interface else []
    gives = [f'GROUP="{port.group or _USUAL_GROUP}"', 'MODE="0660"', 'TAG+="uaccess"', 'ENV{ID_MM_DEVICE_IGNORE}="1"']
    rules = [", ".join(['SUBSYSTEM=="tty"', *device, *interface, f'SYMLINK+="{link}"', *gives])]
    if port.latency_ms is not None:
        latency = ['ACTION!="remove"', 'SUBSYSTEM=="usb-serial"', *device, 'ATTR{latency_timer}="1"']
        rules.append(", ".join(latency))
    return rules
