"""Turn the bytes of a line into rows of a batch: framed, split, with the time of their last byte.

C finds the frames of most framings (``framing.c``), Python those of the others.
"""

from __future__ import annotations

import ctypes
from abc import ABC, abstractmethod
from bisect import bisect_left
from collections.abc import Collection, Iterable, Sequence
from dataclasses import astuple, fields

import numpy as np

from skinware.errors import ConfigurationError
from skinware_drivers import native
from skinware_drivers.bus import FrameBatch
from skinware_drivers.counters import BusCounters, FramerCounters
from skinware_drivers.native import structs
from skinware_drivers.native.compiling import compile_batch
from skinware_drivers.serial.checksums import Checksum, Crc, Sum, Xor
from skinware_drivers.serial.framing import Field, Framed, Framer, Framing, fill_rows

Pattern = Sequence[int | Collection[int]]
"""The value of each byte, or the values that it can have."""
PACKET_FORM, LINE_FORM, COBS_FORM, ESCAPED_FORM = range(4)
"""Forms of framings in C."""
BYTE_VALUES = 256


class CompiledFraming(Framing):
    """A framing whose frames C finds.

    Attributes:
        is_first_trusted: the bytes before the first delimiter may be a frame.
        undecided: bytes that must have come to decide whether a frame begins, at most.
    """

    @property
    def undecided(self) -> int:
        return 0

    @property
    def is_first_trusted(self) -> bool:
        return True

    def framer(self) -> Framer:
        return NativeFramer(self)

    @abstractmethod
    def compiled(self, arrays: structs.Arrays) -> structs.Framing:
        """Return the declaration for C, with its tables in ``arrays``."""


def check_parts(checksum: Checksum | None, identifier: Field | None) -> None:
    """Refuse what C does not know.

    Raises:
        ConfigurationError: the checksum is none of these classes, or the identifier lies before the frame.
    """
    if checksum is not None and type(checksum).of not in (Xor.of, Sum.of, Crc.of):
        raise ConfigurationError(f"a checksum is an Xor, Sum or Crc, not {checksum!r}; for another, write a Framing")
    if identifier is not None and identifier.offset < 0:
        raise ConfigurationError(f"the identifier begins {-identifier.offset} bytes before the frame")


_XOR, _SUM, _CRC_FROM_HIGH, _CRC_FROM_LOW = range(4)
_COUNTED = {name: name for name in ("bytes_in", "frame_bytes", "idle_bytes", "skipped_bytes", "checksum_errors")} | {
    "frames": "found",
    "refused": "bad_form",
}
"""Counters of a framer, and their names in C."""


def compile_field(field: Field) -> structs.WireField:
    return structs.WireField(field.offset, field.size, field.order == "big", field.mask & 0xFFFF_FFFF)


def values_of(what: int | Collection[int]) -> list[int]:
    """Return the values that a byte of a pattern can have, ascending."""
    return [what] if isinstance(what, int) else sorted(what)


def compile_pattern(pattern: Pattern, arrays: structs.Arrays) -> tuple[int, int]:
    """Return the length of a pattern, and the address of (n, 256) bool: whether a byte fits."""
    table = np.zeros((max(1, len(pattern)), BYTE_VALUES), bool)
    for row, what in zip(table, pattern, strict=False):
        row[values_of(what)] = True
    return len(pattern), arrays.at(table)


def compile_checksum(checksum: Checksum, arrays: structs.Arrays) -> structs.Checksum:
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

    @abstractmethod
    def rest(self) -> list[tuple[bytes, int]]:
        """Return the bytes that are pending, in pieces, each with the time at which it was read."""

    def begin(self, rest: Sequence[tuple[bytes, int]]) -> None:
        """Begin with the rest of the stream before."""
        for piece, time_ns in rest:
            self.add(piece, time_ns)

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


def _pieces(pending: bytes, start: int, reads: Iterable[tuple[int, int]]) -> list[tuple[bytes, int]]:
    """Return bytes in the pieces in which they were read; ``start`` and the ends of reads are places in the stream."""
    pieces, place = [], 0
    for end, time_ns in reads:
        if end - start > place:
            pieces.append((pending[place : end - start], time_ns))
            place = end - start
    return pieces


class NativeStream(Stream):
    """A stream whose frames C finds, also while the event loop rests."""

    def __init__(self, framing: CompiledFraming, payload_size: int, counters: BusCounters) -> None:
        super().__init__(counters)
        self._payload_size = payload_size
        library = native.library()
        self._fill, self._add = library.quick.skinware_stream_fill, library.quick.skinware_stream_add
        self._fill.restype = ctypes.c_int64
        self._arrays = arrays = structs.Arrays()
        compiled = framing.compiled(arrays)
        self._room = undecided = max(framing.undecided, compiled.longest_segment)
        self._stream = structs.Stream(
            framing=arrays.structs(structs.Framing, [compiled])[1],
            payload_size=payload_size,
            bytes=arrays.at(np.zeros(undecided + CHUNK, np.uint8)),
            content=arrays.at(np.zeros(compiled.longest_segment + 1, np.uint8)),
            reads=arrays.at(np.zeros((undecided + 2, 2), np.int64)),
            false_marks=arrays.at(np.zeros(max(1, compiled.longest), np.uint8)),
            follows_at=-1,
            is_discarding=not framing.is_first_trusted,
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

    def rest(self) -> list[tuple[bytes, int]]:
        stream = self._stream
        reads = (structs.Reading * stream.n_reads).from_address(stream.reads)
        pending = ctypes.string_at(stream.bytes + stream.place, self.pending)
        return _pieces(pending, self.judged, [(read.end, read.time_ns) for read in reads])

    def begin(self, rest: Sequence[tuple[bytes, int]]) -> None:
        early, late = rest[: -self._room], rest[-self._room :]  # there is room for so many times
        if early:
            late = [(b"".join(piece for piece, _ in early), early[-1][1]), *late]
        for piece, time_ns in late:
            self._add(ctypes.byref(self._stream), piece, ctypes.c_int64(len(piece)), ctypes.c_int64(time_ns))

    @property
    def judged(self) -> int:
        """Bytes of the stream up to the end of the last frame, or of those that are none."""
        return int(self._stream.before + self._stream.place)

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


class NativeFramer(Framer):
    """Finds the frames of one stream one by one."""

    def __init__(self, framing: CompiledFraming) -> None:
        super().__init__()
        self._counted = FramerCounters()
        size = framing.maximum_body
        self._stream = NativeStream(framing, size, BusCounters(framing=self._counted))
        self._row = FrameBatch(1, max(8, -(-size // 8) * 8))

    @property
    def position(self) -> int:
        return self._stream.judged + self.pending

    @property
    def pending(self) -> int:
        return self._stream.pending

    def feed(self, chunk: bytes) -> list[Framed]:
        before, found = astuple(self._counted), list[Framed]()
        for start in range(0, len(chunk), CHUNK):
            self._stream.add(chunk[start : start + CHUNK], 0)
            while self._stream.is_behind:
                self._row.clear()
                if self._stream.fill(self._row, 0):
                    row = self._row.wire[0]
                    body = row["payload"][: row["length"]].tobytes()
                    found.append(Framed(int(row["identifier"]), body, self._stream.judged))
        for counter, was in zip(fields(FramerCounters), before, strict=True):
            grown = getattr(self._counted, counter.name) - was
            setattr(self.counters, counter.name, getattr(self.counters, counter.name) + grown)
        return self._split(found)

    def _find(self, stream: bytes) -> tuple[list[Framed], int]:
        raise NotImplementedError


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

    def rest(self) -> list[tuple[bytes, int]]:
        framer = self._framer
        return _pieces(framer.rest, framer.position - framer.pending, self._reads)

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


def stream_of(framing: Framing, payload_size: int, counters: BusCounters) -> Stream:
    """Return a stream in C if C finds these frames, else in Python; bodies beyond ``payload_size`` are refused."""
    if isinstance(framing, CompiledFraming):
        return NativeStream(framing, payload_size, counters)
    return PythonStream(framing, payload_size, counters)
