"""Read the recorded wires of drivers, frames of CAN buses and bytes of serial lines, and export them as other files.

A message holds a sample of the driver's wire service (:mod:`skinware.wire`)::

    header      32 bytes: u8 generation, u8 sequence, i8 published_ns, u8 missed
    pieces      of one bus

A file of candump's text or of pcapng has the frames of all buses by time, each with the name of its interface
(``can0``). If two drivers listened to one bus, the second one's frames have the name ``can0_2``, and so on.
"""

from __future__ import annotations

import heapq
import struct
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import repeat
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, NamedTuple

import numpy as np
import numpy.typing as npt

from skinware.errors import BadRecording, ConfigurationError
from skinware.limits import LIMITS
from skinware.memory.ring import Sample
from skinware.realtime import NS_PER_S
from skinware.text import nearest_name
from skinware.wire import (
    IS_CUT,
    IS_FD,
    SERIAL,
    SERIAL_HEADER,
    SOCKETCAN,
    WireItem,
    candump_line,
    channel_name,
    read_pieces,
)

if TYPE_CHECKING:
    from skinware.recording.reading import Recording

_HEADER = struct.Struct("<QQqQ")
"""Generation and sequence of the sample, its time of publication, frames or bytes missed on the bus so far."""
_LATEST_S = 1.0
"""A frame is published at most so long after it crossed the wire."""
_WINDOW_NS = 2 * NS_PER_S
"""Received and sent frames within this time are sorted."""

FRAME = np.dtype(
    [
        ("time_ns", "<i8"),
        ("epoch_ns", "<i8"),
        ("identifier", "<u4"),
        ("length", "u1"),
        ("flags", "u1"),
        ("is_sent", "?"),
        ("payload", "u1", (64,)),
    ]
)
"""A CAN frame; the columns are those of :class:`WirePiece` and ``skinware.wire.ROWS``."""


def message_of(frame: Sample) -> bytes:
    used = int(frame.column("used")[()])
    header = _HEADER.pack(frame.generation, frame.sequence, frame.published_ns, int(frame.column("missed")[()]))
    return header + frame.column("pieces")[:used].tobytes()


class WirePiece(NamedTuple):
    """Frames of a CAN bus, or bytes of a serial line, that came or were sent together.

    Attributes:
        is_sent: the driver sent them; False: it received them.
        time_ns: (n,) int64, CLOCK_MONOTONIC of each frame; (1,) for bytes.
        epoch_ns: the same times, ns since 1970.
        frames: (n,) of ``skinware.wire.ROWS``; None for bytes.
        data: the bytes; empty for frames.
    """

    is_sent: bool
    time_ns: npt.NDArray[np.int64]
    epoch_ns: npt.NDArray[np.int64]
    frames: npt.NDArray[np.void] | None
    data: bytes


class WireTrack:
    """The frames or bytes of one bus of a driver, as the driver received and sent them.

    Args:
        recording: the source of its chunks.
        driver: name of the driver.
        bus: name of the bus.
        channel: number of its channel.
    """

    def __init__(self, recording: Recording, driver: str, bus: str, channel: int) -> None:
        self._recording = recording
        self.driver: str = driver
        self.bus: str = bus
        self.channel: int = channel

    @property
    def missed(self) -> int:
        """Frames or bytes that the driver received and had no room to publish.

        Losses before the driver are in its ``bus_counters``.
        """
        missed: dict[int, int] = {}
        for generation, count, _, _ in self._batches(0.0, None):
            missed[generation] = max(missed.get(generation, 0), count)
        return sum(missed.values())

    def pieces(self, *, start_s: float = 0.0, end_s: float | None = None) -> Iterator[WirePiece]:
        """Yield all pieces as they came; damaged ones are left out and named in the recording's ``problems``.

        Args:
            start_s: begin at this time, s since the recording began.
            end_s: end before this time; None: after the last piece.
        """
        first_ns = self._recording.start_ns + round(start_s * NS_PER_S) if start_s else None
        end_ns = None if end_s is None else self._recording.start_ns + round(end_s * NS_PER_S)
        for _, _, offset_ns, data in self._batches(start_s, end_s):
            pieces, is_whole = read_pieces(data)
            if not is_whole:
                self._recording.note(f"wire of {self.bus}: damaged frames or bytes left out")
            for piece in pieces:
                epoch_ns = piece.time_ns + offset_ns
                wanted = np.ones(len(epoch_ns), bool)
                if first_ns is not None:
                    wanted &= epoch_ns >= first_ns
                if end_ns is not None:
                    wanted &= epoch_ns < end_ns
                if wanted.all():
                    yield WirePiece(piece.is_sent, piece.time_ns, epoch_ns, piece.frames, piece.data)
                elif piece.frames is not None and wanted.any():
                    frames = piece.frames[wanted]
                    yield WirePiece(piece.is_sent, piece.time_ns[wanted], epoch_ns[wanted], frames, b"")

    @property
    def is_serial(self) -> bool:
        """Whether the bus is a serial line; False if nothing was recorded."""
        first = next(self.pieces(), None)
        return first is not None and first.frames is None

    def items(self, *, start_s: float = 0.0, end_s: float | None = None) -> Iterator[WireItem]:
        """Yield every frame, or every read and write, by time; arguments as for :meth:`pieces`."""
        waiting: list[tuple[int, int, WireItem]] = []
        order = 0
        for piece in self.pieces(start_s=start_s, end_s=end_s):
            for item in _items(piece):
                heapq.heappush(waiting, (item.time_ns, order, item))
                order += 1
            until_ns = int(piece.time_ns[-1]) - _WINDOW_NS if len(piece.time_ns) else 0
            while waiting and waiting[0][0] < until_ns:
                yield heapq.heappop(waiting)[2]
        while waiting:
            yield heapq.heappop(waiting)[2]

    def frames(self, *, start_s: float = 0.0, end_s: float | None = None) -> npt.NDArray[np.void]:
        """Return (n,) of :data:`FRAME`: all frames of a CAN bus by time; arguments as for :meth:`pieces`."""
        found = [np.zeros(0, FRAME)]
        for piece in self.pieces(start_s=start_s, end_s=end_s):
            if piece.frames is None:
                continue
            rows = np.zeros(len(piece.frames), FRAME)
            rows["time_ns"], rows["epoch_ns"], rows["is_sent"] = piece.time_ns, piece.epoch_ns, piece.is_sent
            for name in ("identifier", "length", "flags"):
                rows[name] = piece.frames[name]
            payload = piece.frames["payload"]
            rows["payload"][:, : payload.shape[1]] = payload
            found.append(rows)
        frames = np.concatenate(found)
        return frames[np.argsort(frames["time_ns"], kind="stable")]

    def _batches(self, start_s: float, end_s: float | None) -> Iterator[tuple[int, int, int, memoryview]]:
        """Yield (generation, missed so far, ns since 1970 minus CLOCK_MONOTONIC, pieces) of every message."""
        until_s = None if end_s is None else end_s + _LATEST_S
        for contents in self._recording.chunks({self.channel}, start_s, until_s):
            for message in contents.messages:
                if message.channel_id != self.channel:
                    continue
                if len(message.data) < _HEADER.size:
                    self._recording.note(f"wire of {self.bus}: a message is shorter than its header")
                    continue
                generation, _, published_ns, missed = _HEADER.unpack_from(message.data)
                if not (LIMITS.is_time(message.time_ns) and LIMITS.is_time(published_ns)):
                    self._recording.note(f"wire of {self.bus}: a message has a time that no clock has")
                    continue
                yield generation, missed, message.time_ns - published_ns, message.data[_HEADER.size :]

    def __repr__(self) -> str:
        return f"<WireTrack of {self.bus!r} of {self.driver!r}>"


def _items(piece: WirePiece) -> Iterator[WireItem]:
    times, epochs = piece.time_ns.tolist(), piece.epoch_ns.tolist()
    if piece.frames is None:
        yield WireItem(times[0], epochs[0], piece.is_sent, None, 0, piece.data)
        return
    columns = (piece.frames[name].tolist() for name in ("identifier", "length", "flags"))
    payloads = piece.frames["payload"]
    for place, (time_ns, epoch_ns, identifier, length, flags) in enumerate(zip(times, epochs, *columns, strict=True)):
        data = payloads[place, :length].tobytes()
        yield WireItem(time_ns, epoch_ns, piece.is_sent, identifier, flags, data)


_SECTION, _INTERFACE, _PACKET = 0x0A0D0D0A, 1, 6
_NAME, _DESCRIPTION, _RESOLUTION, _FLAGS = 2, 3, 9, 2
_INBOUND, _OUTBOUND = 1, 2
_ASKED_EACH = 1000

_Wires = list[tuple[WireTrack, str]]
"""(wire, name of its interface)."""


@dataclass(frozen=True)
class Chosen:
    """The part of the wires to export.

    Attributes:
        start_s: begin at this time, s since the recording began.
        end_s: end before this time; None: at the end of the recording.
        is_stopped: called now and then; True ends the export with :class:`KeyboardInterrupt`.
    """

    drivers: Collection[str] = ()
    start_s: float = 0.0
    end_s: float | None = None
    is_stopped: Callable[[], bool] = lambda: False


@dataclass
class Exported:
    """The result of an export.

    Attributes:
        counts: frames of each interface; reads and writes of serial lines.
        notes: a line for each thing that the format cannot hold.
    """

    counts: Counter[str] = field(default_factory=Counter)
    notes: list[str] = field(default_factory=list)


def export_candump(recording: Recording, path: Path, chosen: Chosen | None = None) -> Exported:
    """Write the frames of all CAN buses as ``candump -L`` does; each line ends with R (received) or T (sent)."""
    part = chosen or Chosen()
    with _exporting(recording, path, part, with_serial=False) as (file, wires, exported):
        for number, item in _in_order(wires, part, exported):
            channel = wires[number][1]
            fd_flags = item.flags if item.flags & IS_FD else None
            direction = "T" if item.is_sent else "R"
            line = candump_line(item.epoch_ns // 1000, channel, item.identifier or 0, fd_flags, item.data, direction)
            file.write(line.encode() + b"\n")
            exported.counts[channel] += 1
    return exported


def export_pcapng(recording: Recording, path: Path, chosen: Chosen | None = None) -> Exported:
    """Write all wires for Wireshark, with times in ns and directions.

    An interface of a CAN bus has the link type :data:`SOCKETCAN`, one of a serial line :data:`SERIAL`.
    """
    part = chosen or Chosen()
    with _exporting(recording, path, part, with_serial=True) as (file, wires, exported):
        file.write(_block(_SECTION, struct.pack("<IHHq", 0x1A2B3C4D, 1, 0, -1)))
        for wire, name in wires:
            options = _option(_NAME, name.encode()) + _option(_RESOLUTION, b"\x09")
            options += _option(_DESCRIPTION, f"bus {wire.bus} of {wire.driver}".encode()) + struct.pack("<HH", 0, 0)
            link_type = SERIAL if wire.is_serial else SOCKETCAN
            file.write(_block(_INTERFACE, struct.pack("<HHI", link_type, 0, 0) + options))
        for number, item in _in_order(wires, part, exported):
            file.write(_packet(number, item))
            exported.counts[wires[number][1]] += 1
    return exported


@contextmanager
def _exporting(
    recording: Recording, path: Path, chosen: Chosen, *, with_serial: bool
) -> Iterator[tuple[BinaryIO, _Wires, Exported]]:
    """Yield a new file, the wires to write into it, and the result to fill in; a file that fails is removed."""
    recorded = {wire.driver for wire in recording.wires}
    for driver in chosen.drivers:
        if recorded and driver not in recorded:
            others = nearest_name(driver, sorted(recorded))
            raise ConfigurationError(f"{recording.path}: no wire of {driver!r} in it{others}")
    exported = Exported()
    wires: _Wires = []
    for wire, name in _named(recording):
        if chosen.drivers and wire.driver not in chosen.drivers:
            continue
        if with_serial or not wire.is_serial:
            wires.append((wire, name))
        else:
            exported.notes.append(f"{wire.bus} of {wire.driver} left out: the format has no serial lines")
        if wire.missed:
            exported.notes.append(f"{wire.bus} of {wire.driver}: {wire.missed} missed while it was recorded")
    if not wires:
        what = "no frame of a CAN bus" if exported.notes else "no wire"
        raise BadRecording(f"{recording.path}: {what} was recorded: skin-record --wire records them")
    with path.open("xb") as file:
        try:
            yield file, wires, exported
        except BaseException:
            path.unlink()
            raise


def _named(recording: Recording) -> _Wires:
    named: _Wires = []
    used: Counter[str] = Counter()
    for wire in recording.wires:
        interface, _, channel = wire.bus.partition("?")[0].rpartition(":")
        name = channel_name(interface or "bus", channel)
        used[name] += 1
        named.append((wire, name if used[name] == 1 else f"{name}_{used[name]}"))
    return named


def _in_order(wires: _Wires, chosen: Chosen, exported: Exported) -> Iterator[tuple[int, WireItem]]:
    """Yield (number of its wire, item) of all wires by time; note how many frames were cut."""
    cut = 0
    streams = [
        zip(repeat(number), wire.items(start_s=chosen.start_s, end_s=chosen.end_s))
        for number, (wire, _) in enumerate(wires)
    ]
    for count, (number, item) in enumerate(heapq.merge(*streams, key=lambda one: one[1].epoch_ns)):
        if not count % _ASKED_EACH and chosen.is_stopped():
            raise KeyboardInterrupt
        cut += bool(item.flags & IS_CUT)
        yield number, item
    if cut:
        exported.notes.append(f"{cut} CAN FD frames without their end: their driver knows none that are so long")


def _block(kind: int, body: bytes) -> bytes:
    size = 12 + len(body)
    return struct.pack("<II", kind, size) + body + struct.pack("<I", size)


def _option(code: int, value: bytes) -> bytes:
    return struct.pack("<HH", code, len(value)) + _filled_up(value)


def _filled_up(data: bytes) -> bytes:
    return data + bytes(-len(data) % 4)


def _packet(number: int, item: WireItem) -> bytes:
    if item.identifier is None:
        data = SERIAL_HEADER.pack(1, item.is_sent, 0) + item.data
    else:
        data = struct.pack(">IBBH", item.identifier, len(item.data), item.flags & ~IS_CUT & 0xFF, 0) + item.data
    head = struct.pack("<IIIII", number, item.epoch_ns >> 32, item.epoch_ns & 0xFFFF_FFFF, len(data), len(data))
    options = _option(_FLAGS, struct.pack("<I", _OUTBOUND if item.is_sent else _INBOUND)) + struct.pack("<HH", 0, 0)
    return _block(_PACKET, head + _filled_up(data) + options)
