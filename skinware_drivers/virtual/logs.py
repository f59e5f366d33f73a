"""Read logs of CAN buses that other programs wrote: candump, Vector's ASC and BLF, pcap and pcapng."""

from __future__ import annotations

import io
import logging
import re
import struct
from collections.abc import Iterator
from typing import Any, BinaryIO, NamedTuple, Protocol, Self

from skinware.errors import ConfigurationError
from skinware.realtime import NS_PER_S
from skinware.wire import ERROR, EXTENDED, IS_FD, REMOTE, SERIAL, SERIAL_HEADER, SOCKETCAN, WireItem

log: logging.Logger = logging.getLogger("skinware.driver")

_LOOK_FRAMES = 10_000
"""Frames that are looked at for the names of buses."""
_LARGEST_BLOCK = 16 << 20
_DUMPED = re.compile(rb"\s*\(\d+\.\d+\)\s+\S+\s+[0-9A-Fa-f]{3,8}#")
_ERROR_FRAME = re.compile(r"\)\s+\S+\s+[2367AaBbEeFf][0-9A-Fa-f]{7}#")
_SWITCHED, _PASSIVE = 0x01, 0x02
_PCAP = {0xA1B2C3D4: 1000, 0xA1B23C4D: 1}
"""By magic number: ns of a unit of the fractions of times."""
_SECTION, _INTERFACE, _PACKET = 0x0A0D0D0A, 1, 6
_ORDER, _NAME, _RESOLUTION, _FLAGS, _OUTBOUND = 0x1A2B3C4D, 2, 9, 2, 2


class WireSource(Protocol):
    """A recorded bus: a :class:`skinware.recording.WireTrack`, or one of a log."""

    @property
    def driver(self) -> str: ...

    @property
    def bus(self) -> str: ...

    @property
    def is_serial(self) -> bool: ...

    def items(self, *, start_s: float = 0.0, end_s: float | None = None) -> Iterator[WireItem]: ...


class LogFile:
    """A log, as a recording that has only wires.

    Args:
        path: of the log; its first bytes show its format.
        bus: a bus that must be in it; empty: those among its first frames count.
    """

    def __init__(self, path: str, bus: str = "") -> None:
        self.path = path
        is_serial: dict[str, bool] = {}
        self._has_sent = False
        try:
            for count, (name, item) in enumerate(self.frames()):
                is_serial.setdefault(name, item.identifier is None)
                self._has_sent |= item.is_sent
                if count >= _LOOK_FRAMES and bus in ("", *is_serial):
                    break
        except ConfigurationError:
            if not is_serial:  # otherwise, the frames before the damage are read
                raise
        if not is_serial:
            raise ConfigurationError(f"{path}: no frame of a CAN bus in it: log one with candump -l can0")
        self.wires: list[LoggedWire] = [LoggedWire(self, name, serial) for name, serial in is_serial.items()]

    def about(self, driver: str) -> dict[str, Any]:  # noqa: ARG002, as of a recording
        """Return what is known of the driver: it only listened, if the log has no sent frame."""
        return {"listen_only": not self._has_sent}

    def frames(self) -> Iterator[tuple[str, WireItem]]:
        """Yield the name of the bus and each frame."""
        with open(self.path, "rb") as file:
            begin = file.read(4096)
            file.seek(0)
            magic = int.from_bytes(begin[:4], "little")
            if magic == _SECTION:
                yield from _pcapng(self.path, file)
            elif magic in _PCAP or int.from_bytes(begin[:4], "big") in _PCAP:
                yield from _pcap(self.path, file)
            else:
                yield from _by_python_can(self.path, file, begin)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """Do nothing: no file stays open."""


class LoggedWire:
    """A bus in a log; see :class:`skinware.recording.WireTrack`.

    Attributes:
        driver: empty: a log does not have it.
    """

    driver = ""

    def __init__(self, file: LogFile, bus: str, is_serial: bool) -> None:
        self._file, self.bus, self.is_serial = file, bus, is_serial

    def items(self, *, start_s: float = 0.0, end_s: float | None = None) -> Iterator[WireItem]:
        """Yield its frames in order; a damaged part ends them with a message in the log.

        Args:
            start_s: begin at this time, s since the first frame.
            end_s: end before this time; None: at the end.
        """
        first_ns = None
        try:
            for name, item in self._file.frames():
                first_ns = item.time_ns if first_ns is None else first_ns
                time_s = (item.time_ns - first_ns) / NS_PER_S
                if end_s is not None and time_s >= end_s:
                    return
                if name == self.bus and time_s >= start_s:
                    yield item
        except ConfigurationError as error:
            log.error("%s", error)


class _CountedText(io.TextIOWrapper):
    """Lines of a log without error frames, which python-can takes for data."""

    number = 0

    def __next__(self) -> str:  # type: ignore[override]
        while True:
            self.number += 1
            line = super().__next__()
            if not line.endswith("\n"):  # half its data would be a frame, too
                raise ValueError("cut off: it has no line feed")
            if not _ERROR_FRAME.search(line):
                return line


def _by_python_can(path: str, file: BinaryIO, begin: bytes) -> Iterator[tuple[str, WireItem]]:
    from can.io import ASCReader, BLFReader, CanutilsLogReader

    text = _CountedText(file, "utf-8", errors="replace")
    try:
        reader: Any
        if begin.startswith(b"LOGG"):
            reader = BLFReader(file)
            size = file.seek(0, io.SEEK_END)
            file.seek(struct.unpack_from("<I", begin, 4)[0])
            if size < reader.file_size:
                log.warning("%s: cut off at byte %d of %d: decoded as far as it is whole", path, size, reader.file_size)
        elif _DUMPED.match(begin):
            reader = CanutilsLogReader(text)
        elif re.search(rb"(?im)^(date|base) ", begin):
            reader = ASCReader(text)
        else:
            raise ConfigurationError(
                f"{path}: no log of a CAN bus: candump -l, ASC, BLF, pcap and pcapng are read, recordings too"
            )
        for message in reader:
            channel = message.channel
            yield f"can{channel}" if isinstance(channel, int) else str(channel or "can0"), _item(message)
    except (ConfigurationError, GeneratorExit, OSError):
        raise
    except Exception as error:  # noqa: BLE001, readers of python-can raise whatever they meet
        at = text.number or file.tell()
        where = f"{'line' if text.number else 'byte'} {at}"
        what = str(error) or type(error).__name__
        raise ConfigurationError(f"{path}, {where}: damaged ({what}): mend or remove what is there") from None
    finally:
        if not file.closed:  # python-can closes a file that it has read
            text.detach()


def _item(message: Any) -> WireItem:
    time_ns = round(message.timestamp * 1e6) * 1000
    identifier = message.arbitration_id | EXTENDED * message.is_extended_id | REMOTE * message.is_remote_frame
    flags = IS_FD * message.is_fd | _SWITCHED * message.bitrate_switch | _PASSIVE * message.error_state_indicator
    is_sent = not message.is_rx
    return WireItem(time_ns, time_ns, is_sent, identifier | ERROR * message.is_error_frame, flags, bytes(message.data))


def _pcap(path: str, file: BinaryIO) -> Iterator[tuple[str, WireItem]]:
    head = _taken(path, file, 24)
    order = "<" if int.from_bytes(head[:4], "little") in _PCAP else ">"
    magic, link = struct.unpack(f"{order}I16xI", head)
    _check_link(path, link & 0x0FFF_FFFF)
    while head := file.read(16):
        head += _taken(path, file, 16 - len(head))
        seconds, fraction, size, _ = struct.unpack(f"{order}4I", head)
        data = _taken(path, file, size)
        yield from _packet(link, "can0", seconds * NS_PER_S + fraction * _PCAP[magic], data, is_sent=False)


class _Interface(NamedTuple):
    link: int
    name: str
    units_in_s: int


def _pcapng(path: str, file: BinaryIO) -> Iterator[tuple[str, WireItem]]:
    order, interfaces = "<", list[_Interface]()
    while head := file.read(8):
        at = file.tell() - len(head)
        head += _taken(path, file, 8 - len(head))
        if head[:4] == _SECTION.to_bytes(4, "little"):
            head += _taken(path, file, 4)
            order, interfaces = "<" if int.from_bytes(head[8:], "little") == _ORDER else ">", []
        kind, size = struct.unpack_from(f"{order}II", head)
        if not len(head) + 4 <= size <= _LARGEST_BLOCK:
            raise ConfigurationError(f"{path}, byte {at}: damaged: a block of {size} bytes: cut the file there")
        body = _taken(path, file, size - len(head))[:-4]
        if kind == _INTERFACE and size >= 20:
            options = dict(_options(order, body[8:]))
            name = options.get(_NAME, b"").decode(errors="replace").rstrip("\0") or f"can{len(interfaces)}"
            (power,) = options.get(_RESOLUTION, b"\x06")[:1] or (6,)
            units_in_s = 2 ** (power & 0x7F) if power & 0x80 else 10**power
            interfaces.append(_Interface(struct.unpack_from(f"{order}H", body)[0], name, units_in_s))
        elif kind == _PACKET and size >= 32:
            number, high, low, length, _ = struct.unpack_from(f"{order}5I", body)
            if number >= len(interfaces) or length > len(body) - 20:
                raise ConfigurationError(
                    f"{path}, byte {at}: damaged: a packet of no interface, or cut: cut the file there"
                )
            link, name, units_in_s = interfaces[number]
            _check_link(path, link)
            flags = dict(_options(order, body[20 + -(-length // 4) * 4 :])).get(_FLAGS, b"\0\0\0\0")
            is_sent = struct.unpack(f"{order}I", flags)[0] & 3 == _OUTBOUND
            time_ns = (high << 32 | low) * NS_PER_S // units_in_s
            yield from _packet(link, name, time_ns, body[20 : 20 + length], is_sent=is_sent)


def _options(order: str, data: bytes) -> Iterator[tuple[int, bytes]]:
    at = 0
    while at + 4 <= len(data):
        code, size = struct.unpack_from(f"{order}HH", data, at)
        yield code, data[at + 4 : at + 4 + size]
        at += 4 + -(-size // 4) * 4


def _packet(link: int, name: str, time_ns: int, data: bytes, *, is_sent: bool) -> Iterator[tuple[str, WireItem]]:
    if link == SERIAL:
        if len(data) > SERIAL_HEADER.size:
            is_sent = bool(SERIAL_HEADER.unpack_from(data)[1])
            yield name, WireItem(time_ns, time_ns, is_sent, None, 0, data[SERIAL_HEADER.size :])
    elif len(data) >= 8:
        identifier, length, flags = struct.unpack_from(">IBB", data)
        payload = data[8 : 8 + length]
        yield name, WireItem(time_ns, time_ns, is_sent, identifier, flags | IS_FD * (len(payload) > 8), payload)


def _check_link(path: str, link: int) -> None:
    if link not in (SOCKETCAN, SERIAL):
        raise ConfigurationError(
            f"{path}: packets of link type {link}, not of CAN ({SOCKETCAN}): capture the interface can0 itself"
        )


def _taken(path: str, file: BinaryIO, size: int) -> bytes:
    data = file.read(size) if size <= _LARGEST_BLOCK else b""
    if len(data) < size:
        at = file.tell()
        raise ConfigurationError(f"{path}, byte {at}: cut off in a packet: all before it was read")
    return data
