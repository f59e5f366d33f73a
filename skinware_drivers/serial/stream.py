"""Turn the bytes of a line into rows of a batch: framed, split, with the time of their last byte.

C finds the frames of most framings (``framing.c``), Python those of the others.
"""

from __future__ import annotations

import ctypes
from abc import ABC, abstractmethod
from bisect import bisect_left
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from skinware_drivers import native
from skinware_drivers.bus import FrameBatch
from skinware_drivers.counters import BusCounters
from skinware_drivers.native import structs
from skinware_drivers.native.compiling import compile_batch
from skinware_drivers.serial.checksums import Checksum, Crc, Sum, Xor
from skinware_drivers.serial.delimited import Cobs, Delimited, Escaped, Lines
from skinware_drivers.serial.framing import Field, Framed, Framer, Framing, Splitting, fill_rows
from skinware_drivers.serial.packets import Length, LengthTable, Packet, Pattern, values_of


class Part(NamedTuple):
    """A part of a body that becomes a frame.

    Attributes:
        identifier: of that frame.
        start: first byte in the body.
        stop: one past the last.
    """

    identifier: int
    start: int
    stop: int


@dataclass(frozen=True)
class Split(Framing):
    """Frames of another framing that is not split, each split into several with the time and the end of the whole.

    Attributes:
        whole: how frames lie in the stream, and how commands are sent.
        splitting: returns the parts of a frame; must not raise, whatever it is given.
    """

    whole: Framing
    splitting: Splitting
    maximum_body: int = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "maximum_body", self.whole.maximum_body)

    def framer(self) -> Framer:
        framer = self.whole.framer()
        framer.splitting = self.splitting
        return framer

    def encode(self, identifier: int, payload: bytes) -> bytes:
        return self.whole.encode(identifier, payload)


def by_length(known: Mapping[tuple[int, int], Sequence[Part]]) -> Splitting:
    """Return a splitting of frames of known identifiers and lengths of body; others stay whole."""

    def split(identifier: int, body: bytes) -> Iterable[tuple[int, bytes]]:
        parts = known.get((identifier, len(body)))
        if parts is None:
            return [(identifier, body)]
        return [(part.identifier, body[part.start : part.stop]) for part in parts]

    return split


CHUNK = 1 << 16
"""Bytes of a chunk, at most."""


class Stream(ABC):
    """The bytes of a line from when it is opened, or gets another framing, until it is closed or gets the next.

    Attributes:
        counters: of the bus; they go on from one stream to the next.
        is_lost: no more frames can be found, so that the bus must be opened again.
    """

    def __init__(self, counters: BusCounters) -> None:
        self.counters = counters
        self.is_lost = False

    @property
    @abstractmethod
    def is_behind(self) -> bool:
        """Whether the bytes so far may have more frames; until they have none, no bytes are added."""

    @property
    @abstractmethod
    def pending(self) -> int:
        """Bytes that may still become part of a frame."""

    def asked(self) -> None:  # noqa: B027  (most framings do not depend on questions)
        """Note that the host sends a question."""

    @abstractmethod
    def add(self, chunk: bytes, time_ns: int) -> None:
        """Add at most ``CHUNK`` bytes that were read at this time, CLOCK_MONOTONIC ns."""

    @abstractmethod
    def fill(self, batch: FrameBatch, ordinal: int) -> int:
        """Append frames to a batch, as many as fit; return their number."""

    @abstractmethod
    def take_damaged(self) -> bytes:
        """Return the last chunk, once, if it had damaged frames and no good one."""


class PythonStream(Stream):
    """A stream whose frames a framer finds."""

    def __init__(self, framing: Framing, payload_size: int, counters: BusCounters) -> None:
        super().__init__(counters)
        self._payload_size = payload_size
        self._framer = framing.framer()
        self._framer.counters = counters.framing
        self._reads: list[tuple[int, int]] = []
        self._backlog: list[tuple[list[Framed], list[int]]] = []
        self._damaged = b""

    @property
    def is_behind(self) -> bool:
        return bool(self._backlog)

    @property
    def pending(self) -> int:
        return self._framer.pending

    def asked(self) -> None:
        self._framer.asked()
        self.is_lost = self._framer.is_lost

    def add(self, chunk: bytes, time_ns: int) -> None:
        framer, counters = self._framer, self.counters.framing
        known = framer.position
        damaged = counters.checksum_errors + counters.refused
        framed = framer.feed(chunk)
        damaged = counters.checksum_errors + counters.refused - damaged
        self.counters.errors += damaged
        self._damaged = chunk if damaged and not framed else b""
        self._reads.append((framer.position, time_ns))
        fitting = [frame for frame in framed if len(frame.body) <= self._payload_size]
        self.counters.refused += len(framed) - len(fitting)
        if fitting:
            time_of = [time_ns] * len(fitting)
            if fitting[0].end <= known:  # frames were held back behind a false beginning
                ends, times = zip(*self._reads, strict=True)
                time_of = [times[bisect_left(ends, frame.end)] for frame in fitting]
            self._backlog.append((fitting, time_of))
        # keep the times of the bytes that are still held back
        undecided = framer.position - framer.pending
        if not framer.pending:
            self._reads.clear()
        while self._reads and self._reads[0][0] <= undecided:
            self._reads.pop(0)

    def fill(self, batch: FrameBatch, ordinal: int) -> int:
        taken = 0
        while self._backlog and batch.free:
            framed, time_ns = self._backlog[0]
            count = min(len(framed), batch.free)
            rows = slice(batch.stop, batch.stop + count)
            fill_rows(batch.wire[rows], framed[:count])
            batch.time_ns[rows], batch.bus[rows] = time_ns[:count], ordinal
            batch.stop += count
            taken += count
            if count == len(framed):
                self._backlog.pop(0)
            else:
                self._backlog[0] = framed[count:], time_ns[count:]
        self.counters.frames += taken
        return taken

    def take_damaged(self) -> bytes:
        damaged, self._damaged = self._damaged, b""
        return damaged


_XOR, _SUM, _CRC_FROM_HIGH, _CRC_FROM_LOW = range(4)
_PACKETS, _LINES, _COBS, _ESCAPED = range(4)
_BYTE_VALUES = 256
_COUNTED = {name: name for name in ("bytes_in", "frame_bytes", "idle_bytes", "skipped_bytes", "checksum_errors")} | {
    "frames": "found",
    "refused": "bad_form",
}
"""Counters of a framer, and their names in C."""


def stream_of(framing: Framing, payload_size: int, counters: BusCounters) -> Stream:
    """Return a stream in C if C can find these frames, else in Python; bodies beyond ``payload_size`` are refused."""
    made = NativeStream if can_compile(framing) else PythonStream
    return made(framing, payload_size, counters)


def can_compile(framing: Framing) -> bool:
    """Return whether C can find these frames: not those of other people's classes, nor of a strange declaration."""
    if type(framing) is Delimited:
        can = type(framing.stuffing) in (Lines, Cobs, Escaped) and framing.body_start >= 0
    else:
        can = type(framing) is Packet and _stays_within(framing)
    checksum, identifier = getattr(framing, "checksum", None), getattr(framing, "identifier", None)
    is_known = checksum is None or type(checksum).of in (Xor.of, Sum.of, Crc.of)
    return can and is_known and _is_plain(identifier)


def _is_plain(field: Field | None) -> bool:
    return field is None or (field.offset >= 0 and field.size in (1, 2, 4))


def _stays_within(framing: Packet) -> bool:
    """Return whether every byte that is looked at lies within the frame, whatever the length field says."""
    least = least_checked = framing.shortest
    ends = [framing.body_start, len(framing.sync), len(framing.trailer)]
    if isinstance(framing.length, Length):
        if not _is_plain(framing.length.field):
            return False
        if framing.bare_when_empty:
            least_checked = max(least, 1 + framing.length.more)
    elif isinstance(framing.length, LengthTable):
        if framing.length.has_fields:
            return False
        ends.append(framing.length.offset)
    if framing.identifier is not None:
        ends.append(framing.identifier.end)
    if framing.checksum is not None:
        begin, end = framing.covered(least_checked)
        ends.append((framing.checksum_at or 0) + framing.checksum.size)
        if not 0 <= begin <= end <= least_checked or (framing.checksum_at or 0) < 0:
            return False
    return min(ends) >= 0 and max(ends) <= least and framing.behind <= least_checked


def _compile(framing: Framing, arrays: structs.Arrays) -> structs.Framing:
    compiled = structs.Framing()
    if not isinstance(framing, Delimited | Packet):
        return compiled
    compiled.body_start = framing.body_start
    if framing.identifier is not None:
        compiled.identifier = _field(framing.identifier)
    if framing.checksum is not None:
        compiled.checksum = _checksum(framing.checksum, arrays)
    if isinstance(framing, Delimited):
        stuffing = framing.stuffing
        compiled.shortest = framing.minimum_body + framing.overhead
        compiled.longest = framing.maximum_body + framing.overhead
        compiled.delimiter, compiled.longest_segment = stuffing.delimiter, stuffing.longest(compiled.longest)
        compiled.form = _COBS if isinstance(stuffing, Cobs) else _LINES
        if isinstance(stuffing, Escaped):
            compiled.form, compiled.escape = _ESCAPED, stuffing.escape
            meaning = [stuffing.meaning.get(byte, -1) for byte in range(_BYTE_VALUES)]
            compiled.meaning = arrays.of(meaning, np.int16)
        return compiled
    compiled.form = _PACKETS
    compiled.shortest, compiled.longest, compiled.behind = framing.shortest, framing.longest, framing.behind
    compiled.n_sync, compiled.sync = _pattern(framing.sync, arrays)
    compiled.n_trailer, compiled.trailer = _pattern(framing.trailer, arrays)
    if isinstance(framing.length, Length):
        compiled.length, compiled.more = _field(framing.length.field), framing.length.more
        if framing.bare_when_empty and framing.checksum is not None:
            compiled.bare = framing.checksum.size
    elif isinstance(framing.length, LengthTable):
        compiled.length = _field(Field(framing.length.offset))
        known = {value: total for value, total in framing.length.total.items() if isinstance(total, int)}
        totals = [known.get(value, 0) for value in range(_BYTE_VALUES)]
        compiled.totals = arrays.of(totals, np.int64)
    compiled.known_from, compiled.look_ahead = framing.known_from, framing.look_ahead
    compiled.confirms_each = framing.confirmed == "each"
    compiled.checksum_at = framing.checksum_place(0)
    compiled.covered_from, compiled.covered_to = framing.covered(0)
    return compiled


def _field(field: Field) -> structs.WireField:
    return structs.WireField(field.offset, field.size, field.order == "big", field.mask & 0xFFFF_FFFF)


def _pattern(pattern: Pattern, arrays: structs.Arrays) -> tuple[int, int]:
    """Return the length of a pattern, and the address of (n, 256) bool: whether a byte fits."""
    table = np.zeros((max(1, len(pattern)), _BYTE_VALUES), bool)
    for row, what in zip(table, pattern, strict=False):
        row[values_of(what)] = True
    return len(pattern), arrays.at(table)


def _checksum(checksum: Checksum, arrays: structs.Arrays) -> structs.Checksum:
    found = structs.Checksum(size=checksum.size, is_big=checksum.order == "big")
    if isinstance(checksum, Xor):
        found.form, found.init = _XOR, checksum.init
    elif isinstance(checksum, Sum):
        found.form, found.init, found.mask = _SUM, checksum.init, (1 << checksum.width) - 1
        found.is_negative = checksum.negative
    elif isinstance(checksum, Crc):
        found.form = _CRC_FROM_LOW if checksum.reflected_in else _CRC_FROM_HIGH
        found.width, found.mask = checksum.width, (1 << checksum.width) - 1
        found.init, found.xor_out = checksum.first_state, checksum.xor_out
        found.is_reversed = checksum.reflected_in != checksum.reflected_out
        found.table = arrays.of(checksum.table, np.uint32)
    return found


class NativeStream(Stream):
    """A stream whose frames C finds, also while the event loop rests: if ``can_compile`` is true for its framing."""

    def __init__(self, framing: Framing, payload_size: int, counters: BusCounters) -> None:
        super().__init__(counters)
        self._payload_size = payload_size
        library = native.library()
        self._fill, self._add = library.quick.skinware_stream_fill, library.quick.skinware_stream_add
        self._fill.restype = ctypes.c_int64
        self._arrays = arrays = structs.Arrays()
        compiled = _compile(framing, arrays)
        undecided = max(compiled.longest + compiled.look_ahead, compiled.known_from, compiled.longest_segment)
        self._stream = structs.Stream(
            framing=arrays.structs(structs.Framing, [compiled])[1],
            payload_size=payload_size,
            bytes=arrays.at(np.zeros(undecided + CHUNK, np.uint8)),
            content=arrays.at(np.zeros(compiled.longest_segment + 1, np.uint8)),
            reads=arrays.at(np.zeros((undecided + 2, 2), np.int64)),
            follows_at=-1,
            is_discarding=isinstance(framing, Delimited) and not framing.is_first_trusted,
            frames=counters.frames,
            too_long=counters.refused,
            **{there: getattr(counters.framing, here) for here, there in _COUNTED.items()},
        )
        self._too_long = counters.refused
        self._batch: FrameBatch | None = None
        self._rows = structs.Batch()

    @property
    def is_behind(self) -> bool:
        return bool(self._stream.is_behind)

    @property
    def pending(self) -> int:
        return int(self._stream.size - self._stream.place)

    def add(self, chunk: bytes, time_ns: int) -> None:
        if len(chunk) > CHUNK or self.is_behind:
            raise ValueError(f"{len(chunk)} bytes more than there is room for")
        size, time = ctypes.c_int64(len(chunk)), ctypes.c_int64(time_ns)
        self._add(ctypes.byref(self._stream), chunk, size, time)

    def fill(self, batch: FrameBatch, ordinal: int) -> int:
        if batch is not self._batch:
            self._batch, self._rows = batch, compile_batch(batch, structs.Arrays())
        rows = self._rows
        rows.stop, rows.limit = batch.stop, batch.limit
        self._fit(batch)
        taken = int(self._fill(ctypes.byref(self._stream), ctypes.byref(rows), ctypes.c_int64(ordinal)))
        batch.stop = rows.stop
        self.count()
        return taken

    def take_damaged(self) -> bytes:
        stream = self._stream
        if not stream.is_damaged or stream.is_good or stream.is_behind:
            return b""
        stream.is_damaged = False
        return ctypes.string_at(stream.chunk, stream.chunk_bytes)

    def hand_over(self, fd: int, batch: FrameBatch) -> int:
        """Let C read from this descriptor into this batch until ``count`` is called; return the stream's address."""
        self._fit(batch)
        self._stream.fd = fd
        return ctypes.addressof(self._stream)

    def count(self) -> None:
        counters, stream = self.counters, self._stream
        counters.frames = stream.frames
        counters.refused += stream.too_long - self._too_long  # the bus itself may refuse something, too
        self._too_long = stream.too_long
        for here, there in _COUNTED.items():
            setattr(counters.framing, here, getattr(stream, there))
        counters.errors = stream.checksum_errors + stream.bad_form

    def _fit(self, batch: FrameBatch) -> None:
        self._stream.payload_size = min(self._payload_size, batch.payload_size)
