"""Find the port that a name means, and open it; every refusal says what to do."""

from __future__ import annotations

import contextlib
import errno
import grp
import os
import stat
from typing import Annotated, Any, Literal

import msgspec
import serial
from msgspec import Meta
from serial.tools import list_ports

from skinware.errors import BusNotAvailable, ConfigurationError
from skinware.status import BusReason
from skinware_drivers.serial.ports import DescriptorPort, Port, ThreadedPort

DEFAULT_BAUDRATE = 115_200
_WRITE_TIMEOUT_S = 1.0
_READ_TIMEOUT_S = 0.1


class SerialOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    baudrate: Annotated[
        Annotated[int, Meta(ge=1)] | None, Meta(description="bits per second; default: the driver's")
    ] = None
    serial_number: Annotated[str, Meta(description="of the USB device, in place of a path")] = ""
    vid_pid: Annotated[str, Meta(description="vendor and product of the USB device, as 0483:5700")] = ""
    parity: Annotated[Literal["none", "even", "odd"], Meta(description="parity bit")] = "none"
    stop_bits: Annotated[Literal[1, 2], Meta(description="stop bits")] = 1
    rtscts: Annotated[bool, Meta(description="hardware flow control")] = False
    low_latency: Annotated[bool, Meta(description="ask the adapter to hand on bytes at once")] = True
    dtr: Annotated[bool, Meta(description="level of DTR once the port is open")] = True
    rts: Annotated[bool, Meta(description="level of RTS once the port is open, without rtscts")] = True
    hang_up: Annotated[bool, Meta(description="no: DTR and RTS stay as they are when the port is closed")] = True


def find_port(channel: str, options: SerialOptions) -> str:
    """Return the present path or URL: a USB device may have another path than the last time."""
    if not options.serial_number and not options.vid_pid:
        if not channel:
            raise ConfigurationError("which serial port? serial:/dev/ttyUSB0, or serial:?serial_number=...")
        return channel
    if channel:
        raise ConfigurationError(f"serial:{channel}: give a path, or serial_number and vid_pid, not both")
    wanted = []
    ports = list(list_ports.comports())
    for port in ports:
        usb = "" if port.vid is None else f"{port.vid:04x}:{port.pid:04x}"
        if options.serial_number in ("", port.serial_number) and options.vid_pid.lower() in ("", usb):
            wanted.append(port)
    if len(wanted) == 1:
        return str(wanted[0].device)
    given = [f"serial number {options.serial_number}"] if options.serial_number else []
    given += [f"VID:PID {options.vid_pid}"] if options.vid_pid else []
    what = " and ".join(given)
    if wanted:
        numbers = ", ".join(f"{port.device} (serial_number={port.serial_number})" for port in wanted)
        raise BusNotAvailable(f"{len(wanted)} serial ports have {what}: {numbers}; say which")
    raise BusNotAvailable(f"no serial port has {what}; {_known_ports(ports)}")


def open_port(path: str, options: SerialOptions, baudrate: int) -> Port:
    """Open a port exclusively; ``baudrate``: bits per second."""
    is_url = "://" in path
    if is_url and not options.hang_up:
        raise ConfigurationError(f"{path}: hang_up=no is for ports of this machine: it is the machine that hangs up")
    try:
        line = serial.serial_for_url(
            path,
            do_not_open=True,
            baudrate=baudrate,
            parity={"none": "N", "even": "E", "odd": "O"}[options.parity],
            stopbits=options.stop_bits,
            rtscts=options.rtscts,
            exclusive=None if is_url else True,
            timeout=_READ_TIMEOUT_S,
            write_timeout=None if path.startswith("rfc2217:") else _WRITE_TIMEOUT_S,  # it has none
        )
    except (serial.SerialException, ValueError) as error:
        networks = "; over a network: tcp://HOST:PORT, udp://HOST:PORT or websocket:ws://HOST:PORT"
        raise ConfigurationError(f"{path}: {error}{networks if 'protocol' in str(error) else ''}") from None
    line.dtr, line.rts = options.dtr, options.rts
    try:
        line.open()
    except (OSError, ValueError, EOFError, NotImplementedError) as error:  # SerialException is an OSError
        raise _refusal(path, error, baudrate) from None
    if not is_url or path.startswith("socket://"):
        port: Port = DescriptorPort(path, line, hang_up=options.hang_up)
    else:
        port = ThreadedPort(path, line)
    if options.low_latency and not is_url and not os.path.realpath(path).startswith("/dev/pts/"):
        try:
            line.set_low_latency_mode(True)
        except (ValueError, OSError, NotImplementedError):
            port.note = f"{path}: no low-latency mode; an adapter may hold back bytes for some milliseconds"
    return port


def _refusal(path: str, error: Exception, baudrate: int) -> BusNotAvailable | ConfigurationError:
    number = getattr(error, "errno", None)
    if number in (errno.ENOENT, errno.ENODEV, errno.ENXIO):
        return BusNotAvailable(f"no serial port {path}; {_known_ports(list(list_ports.comports()))}")
    if number in (errno.EACCES, errno.EPERM):
        advice = "give it a group or uaccess by a udev rule (skin-find --udev)"
        with contextlib.suppress(OSError):
            if group := group_that_may(os.stat(path)):
                advice = f"sudo usermod -aG {group.gr_name} $USER, and log in again"
        return BusNotAvailable(f"{path}: permission denied; for good: {advice}", reason=BusReason.REFUSED)
    if number in (errno.EAGAIN, errno.EBUSY):
        return BusNotAvailable(
            f"{path}: another program has it open; which one: fuser -v {path}", reason=BusReason.REFUSED
        )
    if isinstance(error, ValueError) and "baud" in str(error).lower():
        return ConfigurationError(f"{path}: it cannot do {baudrate} baud")
    return BusNotAvailable(f"{path} cannot be opened as a serial port: {error}", reason=BusReason.FAILED)


def group_that_may(info: os.stat_result) -> grp.struct_group | None:
    """Return the group whose members may read and write."""
    if info.st_mode & (stat.S_IRGRP | stat.S_IWGRP) != stat.S_IRGRP | stat.S_IWGRP or info.st_gid == 0:
        return None
    try:
        return grp.getgrgid(info.st_gid)
    except KeyError:
        return None


def _known_ports(ports: list[Any]) -> str:
    known = [f"{port.device} ({port.description})" if port.vid else port.device for port in ports]
    return f"there are: {', '.join(known)}" if known else "there is none at all"
