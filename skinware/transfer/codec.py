"""Code frames as the differences to the frame before, in as few bits as these need.

The message of a frame, all little-endian::

    HEADER                     48 bytes
    codes    u1[n_columns]     how each column is coded; columns as in the service's column table
    sizes    <u4[n_columns]    bytes of each
    ...                        those bytes, column after column

The words of a column are its numbers; a column without integers or floats of 1 to 8 bytes has words of one byte. Each
word is coded as its difference to the same word of the frame before (``HEADER.after``; in a key frame: to 0). Integers
are subtracted modulo 2**bits and zigzag-coded (0, -1, 1, -2 ... become 0, 1, 2, 3 ...); all others are exclusive ors.
The lower four bits of the code say which bytes of the differences follow: 0: none, all are 0; 1 to 8: this many byte
planes, the lowest first, where plane k has byte k of every difference; 15: four differences of two bits in each byte,
the first in the lowest bits. Its bit ``PACKED`` says that these bytes are packed by DEFLATE (raw, RFC 1951).

Noise of a few counts is one plane of values without order: only symbols of different length make it smaller, and a
search for repetitions costs time and bytes. So numbers of up to four bytes are packed by Huffman codes and runs only.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from skinware.errors import BadRecording
from skinware.limits import LIMITS
from skinware.memory.file_layout import SLOT, ColumnPlace
from skinware.memory.ring import Sample

HEADER = np.dtype(
    [
        ("generation", "<u8"),
        ("sequence", "<u8"),
        ("acquired_ns", "<i8"),
        ("published_ns", "<i8"),
        ("flags", "<u8"),
        ("after", "<u8"),
    ]
)
"""``after``: sequence of the frame before; 0: this is a key frame, which needs no other."""

PACKED = 0x80
_TWO_BITS = 15
_PACKED_FROM = 1024
"""Least size of a column that is packed by itself, bytes; smaller ones are packed with their chunk."""
_HEADER = struct.Struct("<6Q")

Words = npt.NDArray[np.unsignedinteger[Any]]


@dataclass(frozen=True)
class CodedColumn:
    """How a column of a slot is coded.

    Attributes:
        offset: in the slot, bytes.
        words: dtype of its words, unsigned.
        is_integer: differences are those of integers, not exclusive ors.
    """

    name: str
    offset: int
    words: np.dtype[Any]
    count: int
    is_integer: bool

    @staticmethod
    def of(column: ColumnPlace) -> CodedColumn:
        """Return how a column of a service's column table is coded."""
        dtype = column.dtype
        if dtype.kind in "uif" and dtype.itemsize in (1, 2, 4, 8):
            return CodedColumn(
                column.name, column.offset, np.dtype(f"<u{dtype.itemsize}"), column.count, dtype.kind != "f"
            )
        return CodedColumn(column.name, column.offset, np.dtype("u1"), column.count * dtype.itemsize, False)

    def words_of(self, slot: memoryview) -> Words:
        return np.frombuffer(slot, self.words, self.count, self.offset)


class FrameEncoder:
    """Codes the frames of one generation, in order."""

    def __init__(self, columns: Sequence[CodedColumn]) -> None:
        self._columns = columns
        self._before: Sample | None = None

    def next_is_key(self) -> None:
        self._before = None

    def encode(self, frame: Sample) -> bytes:
        """Return the message of a frame, and keep the frame until the next one."""
        before, self._before = self._before, frame
        return encoded(frame, before, self._columns)


def encoded(frame: Sample, before: Sample | None, columns: Sequence[CodedColumn]) -> bytes:
    """Return the message of a frame, coded as its difference to the frame before, or as a key frame."""
    slot, slot_before = frame.slot, None if before is None else before.slot
    after = 0 if before is None else before.sequence
    header = _HEADER.pack(frame.generation, frame.sequence, frame.acquired_ns, frame.published_ns, frame.flags, after)
    codes, parts, sizes = bytearray(), [], []
    for column in columns:
        words = column.words_of(slot)
        change = _change(words, None if slot_before is None else column.words_of(slot_before), column.is_integer)
        code, part = _coded(change, column)
        codes.append(code)
        parts.append(part)
        sizes.append(len(part))
    return b"".join([header, codes, struct.pack(f"<{len(sizes)}I", *sizes), *parts])


def _change(words: Words, before: Words | None, is_integer: bool) -> Words:
    if not is_integer:
        return words if before is None else words ^ before
    change = words if before is None else words - before
    bits = 8 * change.itemsize
    signed = change.view(f"<i{change.itemsize}")
    zigzag: Words = ((signed << 1) ^ (signed >> (bits - 1))).view(words.dtype)
    return zigzag


def _coded(change: Words, column: CodedColumn) -> tuple[int, bytes]:
    greatest = int(change.max(initial=0))
    if not greatest:
        return 0, b""
    if greatest < 4:
        fours = np.zeros(-(-len(change) // 4) * 4, np.uint8)
        fours[: len(change)] = change
        first, second, third, fourth = fours.reshape(-1, 4).T
        code, data = _TWO_BITS, (first | second << 2 | third << 4 | fourth << 6).tobytes()
    else:
        code = (greatest.bit_length() + 7) // 8
        data = change.view(np.uint8).reshape(-1, change.itemsize)[:, :code].T.tobytes()
    if len(data) < _PACKED_FROM:
        return code, data
    strategy = zlib.Z_DEFAULT_STRATEGY
    if column.is_integer and column.words.itemsize <= 4:
        strategy = zlib.Z_RLE if 1 < code < _TWO_BITS else zlib.Z_HUFFMAN_ONLY  # upper planes have long runs of 0
    packer = zlib.compressobj(1, zlib.DEFLATED, -15, 9, strategy)
    return code | PACKED, packer.compress(data) + packer.flush()


class Run:
    """Messages of frames of one generation: a key frame, and frames that are each coded after the one before.

    Attributes:
        headers: (n,) of :data:`HEADER`.

    Raises:
        BadRecording: a message is malformed.
    """

    def __init__(self, messages: Sequence[bytes | memoryview], columns: Sequence[CodedColumn]) -> None:
        self._messages, self._columns = messages, columns
        fixed = np.dtype([("header", HEADER), ("codes", "u1", (len(columns),)), ("sizes", "<u4", (len(columns),))])
        if any(len(message) < fixed.itemsize for message in messages):
            raise BadRecording("a frame is shorter than its header")
        starts = np.frombuffer(b"".join([message[: fixed.itemsize] for message in messages]), fixed)
        self.headers: npt.NDArray[np.void] = starts["header"].copy()
        for name in ("acquired_ns", "published_ns"):
            if (self.headers[name] > LIMITS.time_ns).any() or (self.headers[name] < 0).any():
                raise BadRecording("a frame has a time that no clock has")
        self._codes = starts["codes"]
        self._sizes = starts["sizes"].astype(np.int64)
        self._ends = fixed.itemsize + np.cumsum(self._sizes, axis=1)
        if not np.array_equal(self._ends[:, -1], [len(message) for message in messages]):
            raise BadRecording("a frame is longer or shorter than its columns")

    def decode(self, number: int, into: Words) -> None:
        """Write the words of a column.

        Args:
            into: (n, count) of its words' dtype; rows may lie apart.

        Raises:
            BadRecording: its bytes are malformed.
        """
        column = self._columns[number]
        change = np.zeros((len(self._messages), column.count), column.words)
        for row, message in enumerate(self._messages):
            code, end = int(self._codes[row, number]), int(self._ends[row, number])
            if code:
                _decode(code, message[end - int(self._sizes[row, number]) : end], change[row])
        if column.is_integer:
            change = (change >> 1) ^ (0 - (change & 1))
            np.cumsum(change, axis=0, dtype=column.words, out=into)
        else:
            np.bitwise_xor.accumulate(change, axis=0, out=into)

    def decode_slots(self, stride: int) -> npt.NDArray[np.uint8]:
        """Return (n, stride) uint8, the slots of the frames as they were in the ring."""
        slots = np.zeros((len(self._messages), stride), np.uint8)
        heads = slots[:, : SLOT.itemsize].view(SLOT)[:, 0]
        for name in ("sequence", "acquired_ns", "published_ns", "flags"):
            heads[name] = self.headers[name]
        for number, column in enumerate(self._columns):
            end = column.offset + column.count * column.words.itemsize
            self.decode(number, slots[:, column.offset : end].view(column.words))
        return slots


class FrameDecoder:
    """Decodes frames of one generation, each coded after one of the last two that were kept."""

    def __init__(self, columns: Sequence[CodedColumn], stride: int) -> None:
        self._columns, self._stride = columns, stride
        self._kept: dict[int, npt.NDArray[np.uint8]] = {}

    @property
    def sequence(self) -> int:
        """Sequence of the newest frame that is kept; 0: none."""
        return max(self._kept, default=0)

    def decode(self, message: bytes | memoryview, *, keeps: bool = True) -> npt.NDArray[np.uint8]:
        """Return (stride,) uint8, the slot of a frame; callers must not change it.

        Args:
            keeps: later frames may be coded after this one.

        Raises:
            BadRecording: it is malformed, or coded after a frame that is not kept.
        """
        run = Run([message], self._columns)
        sequence, after = int(run.headers["sequence"][0]), int(run.headers["after"][0])
        before = self._kept.get(after)
        if after and before is None:
            raise BadRecording(f"a frame is the difference to frame {after}, which is not here")
        slot: npt.NDArray[np.uint8] = run.decode_slots(self._stride)[0]
        if before is not None:
            for column in self._columns:
                words, words_before = column.words_of(slot.data), column.words_of(before.data)
                if column.is_integer:
                    words += words_before
                else:
                    words ^= words_before
        if keeps:
            self._kept.pop(sequence, None)
            self._kept[sequence] = slot
            for oldest in list(self._kept)[:-2]:
                del self._kept[oldest]
        return slot


def _decode(code: int, data: bytes | memoryview, into: Words) -> None:
    """Write the differences of one column of one frame into zeros, or raise BadRecording if the bytes do not fit."""
    planes = code & 15
    count = len(into)
    size = -(-count // 4) if planes == _TWO_BITS else planes * count
    if code & PACKED:
        try:
            data = zlib.decompressobj(-15).decompress(data, size + 1)
        except zlib.error as error:
            raise BadRecording(f"a column cannot be unpacked ({error})") from None
    if len(data) != size or not (planes == _TWO_BITS or planes <= into.itemsize):
        raise BadRecording("a column has not as many bytes as it should")
    in_bytes = np.frombuffer(data, np.uint8)
    if planes == _TWO_BITS:
        fours = np.stack([in_bytes >> shift & 3 for shift in (0, 2, 4, 6)], axis=1)
        into[:] = fours.ravel()[:count]
    elif count:
        into.view(np.uint8).reshape(count, -1)[:, :planes] = in_bytes.reshape(planes, count).T


def runs(messages: Sequence[bytes | memoryview]) -> Iterator[tuple[int, slice]]:
    """Divide the messages of one service, in recorded order, into runs.

    Messages before the first key frame, or after a frame that is missing, are left out: their values are not known.

    Yields:
        (generation, which messages) of each run.
    """
    begin, generation, sequence = None, 0, 0
    for number, message in enumerate(messages):
        header = _HEADER.unpack_from(message) if len(message) >= _HEADER.size else None
        after = -1 if header is None else header[-1]
        if begin is not None and header is not None and after == sequence and header[0] == generation:
            sequence = header[1]
            continue
        if begin is not None:
            yield generation, slice(begin, number)
            begin = None
        if header is not None and after == 0:
            begin, generation, sequence = number, header[0], header[1]
    if begin is not None:
        yield generation, slice(begin, len(messages))
