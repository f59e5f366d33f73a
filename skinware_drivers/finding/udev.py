"""udev rules for the serial ports that are plugged in: a name that stays, access, and no waiting in the adapter.

Sources: udev(7); systemd's 60-serial.rules (which properties there are) and 73-seat-late.rules (why a rule that gives
access must come before 73).
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from importlib.resources import files

from skinware_drivers.finding.ports import SerialPort, UsbIdentity

RULES_FILE = "70-skinware.rules"
PLACE = f"/etc/udev/rules.d/{RULES_FILE}"
RELOAD = (
    "sudo udevadm control --reload-rules",
    "sudo udevadm trigger --subsystem-match=tty --subsystem-match=usb-serial",
)
_USUAL_GROUP = "dialout"
_NO_LETTER = re.compile(r"[^A-Za-z0-9_.:-]")


def shipped_rules() -> str:
    """The rules for adapters that skins are usually connected by, as they come with this package."""
    return (files("skinware_drivers") / "data" / RULES_FILE).read_text()


def rules_for(ports: Iterable[SerialPort]) -> str:
    """A rules file for exactly these ports; ports that are not on USB keep their names anyway."""
    lines = []
    for port in ports:
        if port.usb is not None:
            lines += [
                "",
                f"# {port.path}: {_NO_LETTER.sub(' ', port.name)}, {_which(port.usb)}",
                *_rules(port, port.usb),
            ]
    if not lines:
        return ""
    head = [f"# {PLACE}: serial skin hardware, names that stay", f"# then: {'; '.join(RELOAD)}"]
    return "\n".join([*head, *lines, ""])


def link_of(usb: UsbIdentity) -> str:
    """The name below /dev that a rule gives: by serial number, or where there is none by the USB socket."""
    name = _NO_LETTER.sub("_", usb.serial_number or f"usb-{usb.place}")
    return f"skin/{name}" if usb.interface in ("", "00") else f"skin/{name}-if{usb.interface}"


def _which(usb: UsbIdentity) -> str:
    number = f"serial number {usb.serial_number}" if usb.serial_number else f"no serial number, in socket {usb.place}"
    return _NO_LETTER.sub(" ", number)


def _rules(port: SerialPort, usb: UsbIdentity) -> list[str]:
    # all ATTRS (and KERNELS) of a rule must hold of one and the same parent: the USB device
    device = [f'ATTRS{{idVendor}}=="{usb.vendor_id}"', f'ATTRS{{idProduct}}=="{usb.product_id}"']
    if usb.serial_number:
        device.append(f'ATTRS{{serial}}=="{_NO_LETTER.sub("?", usb.serial_number)}"')
    else:
        device.append(f'KERNELS=="{usb.place}"')
    interface = [f'ENV{{ID_USB_INTERFACE_NUM}}=="{usb.interface}"'] if usb.interface else []
    gives = [f'GROUP="{port.group or _USUAL_GROUP}"', 'MODE="0660"', 'TAG+="uaccess"', 'ENV{ID_MM_DEVICE_IGNORE}="1"']
    rules = [", ".join(['SUBSYSTEM=="tty"', *device, *interface, f'SYMLINK+="{link_of(usb)}"', *gives])]
    if port.latency_ms is not None:
        latency = ['ACTION!="remove"', 'SUBSYSTEM=="usb-serial"', *device, 'ATTR{latency_timer}="1"']
        rules.append(", ".join(latency))
    return rules
