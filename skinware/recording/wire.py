"""What was recorded of wires, as files of other programs: candump's text, and pcapng.

Frames of all buses are in one file by time, each with the name of its interface (``can0``). Where two drivers listened
to one bus, the second one's frames have the name ``can0_2``, and so on.
"""

from __future__ import annotations

import heapq
import struct
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np
import numpy.typing as npt

from skinware.candump import candump_line, channel_name
from skinware.errors import BadRecording, ConfigurationError
from skinware.recording.reading import Recording
from skinware.recording.wire_tracks import WirePiece, WireTrack
from skinware.wire import IS_CUT, IS_FD

SOCKETCAN, SERIAL = 227, 147
"""Link types of interfaces in pcapng: LINKTYPE_CAN_SOCKETCAN, and LINKTYPE_USER0 with :data:`SERIAL_HEADER`."""
SERIAL_HEADER = struct.Struct("<BBH")
"""Before the bytes of a packet of a serial line: version (1), 0 received or 1 sent, 0."""

_SECTION, _INTERFACE, _PACKET = 0x0A0D0D0A, 1, 6
_NAME, _DESCRIPTION, _RESOLUTION, _FLAGS = 2, 3, 9, 2
_INBOUND, _OUTBOUND = 1, 2
_WINDOW_S = 5.0
"""So much is put in order at once."""
_ASKED_EACH = 1000

_Wires = list[tuple[WireTrack, str]]
"""Each with the name of its interface."""


@dataclass(frozen=True)
class Chosen:
    """What is exported.

    Attributes:
        drivers: names; empty: all.
        start_s: where to begin, s since the recording began.
        end_s: where to end, likewise; None: with the last.
        is_stopped: asked now and then; True ends it with :class:`KeyboardInterrupt`.
    """

    drivers: Collection[str] = ()
    start_s: float = 0.0
    end_s: float | None = None
    is_stopped: Callable[[], bool] = lambda: False


@dataclass
class Exported:
    """What came of an export.

    Attributes:
        counts: frames of each interface; of serial lines, reads and writes.
        notes: what could not be told in the format.
    """

    counts: Counter[str] = field(default_factory=Counter)
    notes: list[str] = field(default_factory=list)


class _Item(NamedTuple):
    """A frame, or bytes, of a wire; they sort by time."""

    epoch_ns: int
    number: int
    order: int
    is_sent: bool
    identifier: int
    flags: int
    data: bytes


def export_candump(recording: Recording, path: Path, chosen: Chosen | None = None) -> Exported:
    """Write the frames of all CAN buses as ``candump -L`` does; each line ends with ``R`` (received) or ``T`` (sent).

    Args:
        recording: with wires.
        path: of the new file.
        chosen: what of it; None: all.

    Raises:
        BadRecording: no frame of a CAN bus was recorded.
        ConfigurationError: no wire of a chosen driver was.
        OSError: the file is there already, or cannot be written.
    """

    def write(file: BinaryIO, wires: _Wires, what: Chosen, told: Exported) -> None:
        for item in _in_order(wires, what, told):
            channel = wires[item.number][1]
            fd_flags = item.flags if item.flags & IS_FD else None
            line = candump_line(
                item.epoch_ns // 1000, channel, item.identifier, fd_flags, item.data, "T" if item.is_sent else "R"
            )
            file.write(line.encode() + b"\n")
            told.counts[channel] += 1

    return _export(recording, path, chosen or Chosen(), write, with_serial=False)


def export_pcapng(recording: Recording, path: Path, chosen: Chosen | None = None) -> Exported:
    """Write what went over all wires for Wireshark and its like, with times in ns and directions.

    An interface of a CAN bus has the link type :data:`SOCKETCAN`, one of a serial line :data:`SERIAL`.

    Args:
        recording: with wires.
        path: of the new file.
        chosen: what of it; None: all.

    Raises:
        BadRecording: no wire was recorded.
        ConfigurationError: none of a chosen driver was.
        OSError: the file is there already, or cannot be written.
    """

    def write(file: BinaryIO, wires: _Wires, what: Chosen, told: Exported) -> None:
        file.write(_block(_SECTION, struct.pack("<IHHq", 0x1A2B3C4D, 1, 0, -1)))
        are_serial = []
        for wire, name in wires:
            is_serial = _is_serial(wire)
            are_serial.append(is_serial)
            options = _option(_NAME, name.encode()) + _option(_RESOLUTION, b"\x09")
            options += _option(_DESCRIPTION, f"bus {wire.bus} of {wire.driver}".encode()) + struct.pack("<HH", 0, 0)
            link_type = SERIAL if is_serial else SOCKETCAN
            file.write(_block(_INTERFACE, struct.pack("<HHI", link_type, 0, 0) + options))
        for item in _in_order(wires, what, told):
            file.write(_packet(item, are_serial[item.number]))
            told.counts[wires[item.number][1]] += 1

    return _export(recording, path, chosen or Chosen(), write, with_serial=True)


def _export(
    recording: Recording,
    path: Path,
    chosen: Chosen,
    write: Callable[[BinaryIO, _Wires, Chosen, Exported], None],
    *,
    with_serial: bool,
) -> Exported:
    recorded = {wire.driver for wire in recording.wires}
    for driver in chosen.drivers:
        if recorded and driver not in recorded:
            there_are = ", ".join(sorted(recorded))
            raise ConfigurationError(f"{recording.path}: no wire of {driver!r} in it; there are: {there_are}")
    told = Exported()
    wires: _Wires = []
    for wire, name in _named(recording):
        if chosen.drivers and wire.driver not in chosen.drivers:
            continue
        if with_serial or not _is_serial(wire):
            wires.append((wire, name))
        else:
            told.notes.append(f"{wire.bus} of {wire.driver} left out: the format has no serial lines")
        if wire.lost:
            told.notes.append(f"{wire.bus} of {wire.driver}: {wire.lost} lost while it was recorded")
    if not wires:
        what = "nothing of a CAN bus" if told.notes else "no wire"
        raise BadRecording(f"{recording.path}: {what} was recorded: skin-record --wire records what goes over buses")
    with _new_file(path) as file:
        write(file, wires, chosen, told)
    return told


@contextmanager
def _new_file(path: Path) -> Iterator[BinaryIO]:
    """A file that was not there, and is not there if something fails."""
    with path.open("xb") as file:
        try:
            yield file
        except BaseException:
            path.unlink()
            raise


def _named(recording: Recording) -> _Wires:
    """The wires, each with the name of an interface that no other has."""
    named: _Wires = []
    used: Counter[str] = Counter()
    for wire in recording.wires:
        interface, _, channel = wire.bus.partition("?")[0].rpartition(":")
        name = channel_name(interface or "bus", channel)
        used[name] += 1
        named.append((wire, name if used[name] == 1 else f"{name}_{used[name]}"))
    return named


def _is_serial(wire: WireTrack) -> bool:
    first = next(wire.pieces(), None)
    return first is not None and first.frames is None


def _in_order(wires: _Wires, chosen: Chosen, told: Exported) -> Iterator[_Item]:
    """Everything by time; what is cut is counted in the notes."""
    cut = 0
    streams = [_by_time(wire, number, chosen) for number, (wire, _) in enumerate(wires)]
    for count, item in enumerate(heapq.merge(*streams)):
        if not count % _ASKED_EACH and chosen.is_stopped():
            raise KeyboardInterrupt
        cut += bool(item.flags & IS_CUT)
        yield item
    if cut:
        told.notes.append(f"{cut} CAN FD frames without their end: their driver knows none that are so long")


def _by_time(wire: WireTrack, number: int, chosen: Chosen) -> Iterator[_Item]:
    """What went over one wire by time: what was received and sent is put in order within some seconds."""
    waiting: list[_Item] = []
    order = 0
    for piece in wire.pieces(start_s=chosen.start_s, end_s=chosen.end_s):
        for item in _items(piece, number, order):
            heapq.heappush(waiting, item)
            order += 1
        until_ns = int(piece.epoch_ns[-1]) - round(_WINDOW_S * 1e9) if len(piece.epoch_ns) else 0
        while waiting and waiting[0].epoch_ns < until_ns:
            yield heapq.heappop(waiting)
    while waiting:
        yield heapq.heappop(waiting)


def _items(piece: WirePiece, number: int, order: int) -> Iterator[_Item]:
    times: npt.NDArray[np.int64] = piece.epoch_ns
    if piece.frames is None:
        yield _Item(int(times[0]), number, order, piece.is_sent, 0, 0, piece.data)
        return
    names = ("identifier", "length", "flags")
    columns = (piece.frames[name].tolist() for name in names)
    for place, (time_ns, identifier, length, flags) in enumerate(zip(times.tolist(), *columns, strict=True)):
        data = piece.frames["payload"][place, :length].tobytes()
        yield _Item(time_ns, number, order + place, piece.is_sent, identifier, flags, data)


def _block(kind: int, body: bytes) -> bytes:
    size = 12 + len(body)
    return struct.pack("<II", kind, size) + body + struct.pack("<I", size)


def _option(code: int, value: bytes) -> bytes:
    return struct.pack("<HH", code, len(value)) + _filled_up(value)


def _filled_up(data: bytes) -> bytes:
    return data + bytes(-len(data) % 4)


def _packet(item: _Item, is_serial: bool) -> bytes:
    if is_serial:
        data = SERIAL_HEADER.pack(1, item.is_sent, 0) + item.data
    else:
        data = struct.pack(">IBBH", item.identifier, len(item.data), item.flags & ~IS_CUT & 0xFF, 0) + item.data
    head = struct.pack("<IIIII", item.number, item.epoch_ns >> 32, item.epoch_ns & 0xFFFF_FFFF, len(data), len(data))
    options = _option(_FLAGS, struct.pack("<I", _OUTBOUND if item.is_sent else _INBOUND)) + struct.pack("<HH", 0, 0)
    return _block(_PACKET, head + _filled_up(data) + options)


__all__ = ["SERIAL", "SERIAL_HEADER", "SOCKETCAN", "Chosen", "Exported", "export_candump", "export_pcapng"]
