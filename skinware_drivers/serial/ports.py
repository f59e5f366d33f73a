"""Ports for bytes: a tty, a socket, one of pyserial's other URLs, or the end of a pseudo terminal for emulators.

A port is found by its path or its USB device; every refusal says what to do.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import grp
import logging
import os
import stat
import termios
import threading
import tty
from abc import ABC, abstractmethod
from collections import deque
from typing import Annotated, Any, Literal

import msgspec
import serial
from msgspec import Meta
from serial.tools import list_ports

from skinware.errors import BusNotAvailable, ConfigurationError
from skinware.status import BusReason

log: logging.Logger = logging.getLogger("skinware.driver")

_MOST_THREADED = 1 << 16
"""Bytes that a port with threads holds in each direction."""
_THREAD_TURN_S = 0.1
_THREAD_END_S, _CLOSE_S = 0.25, 0.8
"""Time that a thread may take to end, and a port to be closed (the same as for python-can's interfaces)."""


class Port(ABC):
    """An open serial line; no call blocks, and one that finds it gone raises :class:`BusNotAvailable`.

    Attributes:
        longest_wait: bytes that may wait until it takes them. 0: bytes that are written together stay together.
    """

    note = ""
    longest_wait = 1 << 16

    @abstractmethod
    def fileno(self) -> int:
        """Return a descriptor that is readable when ``read`` has something to do."""

    @abstractmethod
    def read(self, size: int) -> bytes:
        """Return up to ``size`` bytes; none if none have come."""

    @abstractmethod
    def write(self, data: bytes) -> int:
        """Write the bytes that can be written now; return their number."""

    @abstractmethod
    def close(self) -> None:
        """Close the port. Idempotent."""


class DescriptorPort(Port):
    """A tty or a socket, whose descriptor an object of pyserial's owns.

    Without ``hang_up``, DTR and RTS keep their levels when it is closed.
    """

    def __init__(self, name: str, serial: Any, *, hang_up: bool = True) -> None:
        self._name = name
        self._serial = serial
        self._fd: int = serial.fileno()
        os.set_blocking(self._fd, False)
        self._is_tty = os.isatty(self._fd)
        if self._is_tty:
            with contextlib.suppress(termios.error):
                settings = termios.tcgetattr(self._fd)
                if not hang_up:
                    settings[2] &= ~termios.HUPCL
                # a read of no bytes then fails, instead of returning none, which means that the device is gone
                settings[6][termios.VMIN], settings[6][termios.VTIME] = 1, 0
                termios.tcsetattr(self._fd, termios.TCSANOW, settings)
            with contextlib.suppress(OSError):
                fcntl.ioctl(self._fd, termios.TIOCEXCL)

    def fileno(self) -> int:
        return self._fd

    def read(self, size: int) -> bytes:
        """Return up to ``size`` bytes; none if none have come."""
        try:
            data = os.read(self._fd, size)
        except BlockingIOError:
            return b""
        except OSError as error:
            raise self.gone(error.errno or 0) from None
        if not data:
            raise self.gone(0)
        return data

    def gone(self, number: int) -> BusNotAvailable:
        """Return the error for an error number of the system; 0: the port is readable, but nothing comes."""
        why = os.strerror(number) if number else "readable, but nothing comes"
        return BusNotAvailable(f"{self._name} went away, perhaps unplugged ({why})")

    def write(self, data: bytes) -> int:
        return _write_some(self._fd, data)

    def close(self) -> None:
        if self._serial is not None:
            if self._is_tty:
                with contextlib.suppress(OSError):
                    fcntl.ioctl(self._fd, termios.TIOCNXCL)
            self._serial.close()
            self._serial = None


class ThreadedPort(Port):
    """A port without a descriptor to wait for (``rfc2217://``, ``loop://``, ``spy://`` ...): two threads serve it."""

    def __init__(self, name: str, serial: Any) -> None:
        self._name = name
        self._serial = serial
        self._received: deque[bytes] = deque()
        self._to_send: deque[bytes] = deque()
        self._changed = threading.Condition()
        self._failure = ""
        self._closing = False
        self._event = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._threads = [
            threading.Thread(target=self._work, args=(work,), name=f"{name} {what}", daemon=True)
            for what, work in (("reader", self._read_on), ("writer", self._write_on))
        ]
        for thread in self._threads:
            thread.start()

    def fileno(self) -> int:
        return self._event

    def read(self, size: int) -> bytes:
        with self._changed:
            with contextlib.suppress(BlockingIOError):
                os.eventfd_read(self._event)
            if not self._received and self._failure:
                raise BusNotAvailable(f"{self._name} went away ({self._failure})")
            taken = b"".join(self._received)
            self._received.clear()
            if len(taken) > size:
                self._received.append(taken[size:])
            if self._received or self._failure:
                os.eventfd_write(self._event, 1)
            self._changed.notify_all()
        return taken[:size]

    def write(self, data: bytes) -> int:
        """Give bytes to the thread, as many as fit into its queue."""
        with self._changed:
            if self._failure:
                raise OSError(self._failure)
            taken = data[: max(0, _MOST_THREADED - sum(map(len, self._to_send)))]
            if taken:
                self._to_send.append(taken)
                self._changed.notify_all()
        return len(taken)

    def close(self) -> None:
        """End the threads. A port that hangs is left to itself after 0.8 s, and a warning is logged."""
        if self._closing:
            return
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        closing = threading.Thread(target=self._end, name=f"{self._name} closing", daemon=True)
        closing.start()
        closing.join(_CLOSE_S)
        if closing.is_alive():
            log.warning("%s: it hangs while it is closed, and is left to itself", self._name)

    def _end(self) -> None:
        for thread in self._threads:
            thread.join(_THREAD_END_S)
        try:
            self._serial.close()  # it also ends a write that hangs
        except Exception as error:  # noqa: BLE001  (see _work)
            log.debug("%s: %s", self._name, error)
        for thread in self._threads:
            thread.join()
        os.close(self._event)

    def _work(self, work: Any) -> None:
        try:
            while not self._closing:
                work()
        except Exception as error:  # noqa: BLE001  (the exceptions of pyserial's handlers are not documented)
            with self._changed:
                self._failure = str(error) or type(error).__name__
                os.eventfd_write(self._event, 1)

    def _read_on(self) -> None:
        data = self._serial.read(1)
        if data:
            data += self._serial.read(min(self._serial.in_waiting, _MOST_THREADED))
        with self._changed:
            if data:
                self._received.append(bytes(data))
                os.eventfd_write(self._event, 1)
            while sum(map(len, self._received)) >= _MOST_THREADED and not self._closing:
                self._changed.wait(_THREAD_TURN_S)

    def _write_on(self) -> None:
        with self._changed:
            while not self._to_send and not self._closing and not self._failure:
                self._changed.wait(_THREAD_TURN_S)
            data = self._to_send.popleft() if self._to_send else b""
        if data:
            self._serial.write(data)


class PtyPort(Port):
    """The device's end of a pseudo terminal, which programs open as a serial port, also by a symbolic ``link``."""

    def __init__(self, link: str = "") -> None:
        self._link = link
        try:
            self._fd, self._other = os.openpty()  # the other end stays open, so that programs can come and go
        except OSError as error:
            raise BusNotAvailable(f"no pseudo terminal: {error.strerror}") from None
        self.path: str = os.ttyname(self._other)
        tty.setraw(self._other)
        os.set_blocking(self._fd, False)
        self.note: str = f"serial port {self.path}"
        if link:
            try:
                if os.path.islink(link):
                    os.unlink(link)
                os.symlink(self.path, link)
            except OSError as error:
                self._link = ""
                self.close()
                raise BusNotAvailable(f"cannot make the link {link}: {error.strerror}") from None
            self.note += f", {link}"

    def fileno(self) -> int:
        return self._fd

    def read(self, size: int) -> bytes:
        try:
            return os.read(self._fd, size)
        except BlockingIOError:
            return b""
        except OSError as error:
            raise BusNotAvailable(f"{self.path} went away ({error.strerror})") from None

    def write(self, data: bytes) -> int:
        return _write_some(self._fd, data)

    def close(self) -> None:
        if self._fd < 0:
            return
        if self._link and os.path.islink(self._link) and os.readlink(self._link) == self.path:
            os.unlink(self._link)
        os.close(self._fd)
        os.close(self._other)
        self._fd = -1


def _write_some(fd: int, data: bytes) -> int:
    try:
        return os.write(fd, data)
    except BlockingIOError:
        return 0


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
