"""A stream whose frames are found in C (``framing.c``): the compiled framing, and the state between two takes."""

from __future__ import annotations

import ctypes

import numpy as np

from skinware_drivers import native
from skinware_drivers.bus import FrameBatch
from skinware_drivers.counters import BusCounters
from skinware_drivers.native import structs
from skinware_drivers.native.compiling import compile_batch
from skinware_drivers.serial.checksums import Checksum, Crc, Sum, Xor
from skinware_drivers.serial.delimited import Cobs, Delimited, Escaped, Lines
from skinware_drivers.serial.framing import Field, Framing
from skinware_drivers.serial.packets import Length, LengthTable, Packet, Pattern, values_of
from skinware_drivers.serial.stream import CHUNK, PythonStream, Stream

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
