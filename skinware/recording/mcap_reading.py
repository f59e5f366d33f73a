"""Read MCAP files of recordings, however damaged they are.

A whole file ends with a summary that lists its chunks. In any other file, chunks are found by their signature and not
from record to record, so that a damaged length or missing bytes cost only the chunk that they are in.
"""

from __future__ import annotations

import mmap
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from io import BytesIO
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, Self

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, Header, Schema, Statistics

from skinware.errors import BadRecording
from skinware.limits import LIMITS, Limits
from skinware.recording.mcap_writing import COMPRESSION, MAGIC

_CHUNK = struct.Struct("<BQQQQII4sQ")  # opcode, length, start, end, uncompressed size, CRC, length of "zstd", it, size
_SIGNATURE = struct.pack("<I", len(COMPRESSION)) + COMPRESSION.encode()
_SIGNATURE_AT = _CHUNK.size - 8 - len(_SIGNATURE)
_RECORD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")
_CHUNK_INDEX = struct.Struct("<QQQQI")  # first and last time, offset, length, size of the map that follows
_MESSAGE_INDEX = struct.Struct("<HQ")  # channel, offset
_FOOTER = struct.Struct("<BQQQI")
_MOST_REFUSED = 10  # chunks that get a line each


class Damaged(Exception):
    """A chunk or the summary is not as it was written."""


class McapMessage(NamedTuple):
    """One message; ``time_ns``: of publication, on the axis that orders the file (``log_time``)."""

    channel_id: int
    sequence: int
    time_ns: int
    data: memoryview


@dataclass(frozen=True)
class ChunkPlace:
    """The place of a chunk in its file.

    Attributes:
        start_ns, end_ns: times of its first and last message.
        size: bytes of its contents.
        compressed_at, compressed_size: place of its compressed contents.
        crc: CRC-32 of its contents.
        channel_ids: channels of its messages; None: not known.
    """

    offset: int
    start_ns: int
    end_ns: int
    size: int
    compressed_at: int
    compressed_size: int
    crc: int
    channel_ids: frozenset[int] | None = None

    @property
    def end(self) -> int:
        return self.compressed_at + self.compressed_size


@dataclass
class ChunkContents:
    channels: dict[int, Channel] = field(default_factory=dict)
    schemas: dict[int, Schema] = field(default_factory=dict)
    messages: list[McapMessage] = field(default_factory=list)


class McapSource:
    """An open MCAP file.

    Attributes:
        is_whole: it ends with a summary that fits it.
        chunks: places of its chunks, in the order of the file; without a summary only those that are whole.
        damaged: number of damaged chunks found so far.
        refused: a line for each chunk that claims more bytes than the limits allow.
    """

    def __init__(self, path: Path, limits: Limits = LIMITS) -> None:
        self.path, self._limits = path, limits
        with path.open("rb") as file:
            try:
                self._map = mmap.mmap(file.fileno(), 0, prot=mmap.PROT_READ)
            except ValueError:
                raise BadRecording(f"{path}: empty, so not a recording") from None
        self._data = memoryview(self._map)
        self.channels: dict[int, Channel] = {}
        self.damaged: int = 0
        self.refused: list[str] = []
        self._room = limits.room(len(self._map))
        self._compressions: set[str] = set()  # of chunks that the summary misplaces
        try:
            self.chunks: list[ChunkPlace] = self._chunks_in_summary()
            self.is_whole: bool = True
        except Damaged:
            self._room, self.damaged, self.refused = limits.room(len(self._map)), 0, []
            self.chunks, self.is_whole = list(self._undamaged_chunks()), False
        if not self.chunks and self._compressions - {COMPRESSION}:
            self.close()
            how = ", ".join(each or "nothing" for each in sorted(self._compressions))
            raise BadRecording(f"{path}: compressed by {how}; recordings are by {COMPRESSION}")
        if not self.chunks and self._data[: len(MAGIC)] != MAGIC:
            self.close()
            raise BadRecording(
                f"{path}: not a recording (not an MCAP file); skin-convert --guess begins with data of others"
            )

    @property
    def size(self) -> int:
        return len(self._map)

    @property
    def library(self) -> str:
        """The program that wrote the file, from its header; empty if that is damaged."""
        try:
            opcode, record = next(_records(self._data[len(MAGIC) :]), (0, memoryview(b"")))
            return str(_read(Header, record).library) if opcode == Opcode.HEADER else ""
        except Damaged:
            return ""

    def contents(self, place: ChunkPlace) -> ChunkContents:
        try:
            compressed = self._data[place.compressed_at : place.end]
            if zstandard.frame_content_size(compressed) not in (-1, place.size):
                raise Damaged("its contents are not as large as it says")
            data = zstandard.ZstdDecompressor().decompress(compressed, max_output_size=place.size)
        except (zstandard.ZstdError, MemoryError) as error:
            raise Damaged(f"its contents cannot be decompressed ({error})") from None
        if len(data) != place.size or zlib.crc32(data) != place.crc:  # 0, MCAP's "none", too: ours have a CRC
            raise Damaged("its contents do not fit their checksum")
        contents = ChunkContents()
        for opcode, record in _records(memoryview(data)):
            if opcode == Opcode.MESSAGE:
                if len(record) < _MESSAGE.size:
                    raise Damaged("a message is shorter than its header")
                channel_id, sequence, time_ns, _ = _MESSAGE.unpack_from(record)
                if time_ns > self._limits.time_ns:
                    raise Damaged("a message has a time that no clock has")
                contents.messages.append(McapMessage(channel_id, sequence, time_ns, record[_MESSAGE.size :]))
            elif opcode == Opcode.CHANNEL:
                channel = _read(Channel, record)
                contents.channels[channel.id] = channel
            elif opcode == Opcode.SCHEMA:
                schema = _read(Schema, record)
                contents.schemas[schema.id] = schema
        return contents

    def close(self) -> None:
        """Close the file; contents that were read stay valid. Idempotent."""
        self._data.release()
        self._map.close()

    def _chunks_in_summary(self) -> list[ChunkPlace]:
        """Return the places that the summary lists; Damaged: there is none, or it does not fit the file."""
        end = len(self._data) - len(MAGIC)
        footer_at = end - _FOOTER.size
        if footer_at < len(MAGIC) or self._data[end:] != MAGIC or self._data[: len(MAGIC)] != MAGIC:
            raise Damaged("no end")
        opcode, length, start, _, crc = _FOOTER.unpack_from(self._data, footer_at)
        if opcode != Opcode.FOOTER or length != _FOOTER.size - 9 or not len(MAGIC) <= start <= footer_at:
            raise Damaged("no footer")
        if zlib.crc32(self._data[start : end - 4]) != crc:
            raise Damaged("the summary does not fit its checksum")
        places: list[ChunkPlace] = []
        count, n_found = None, 0
        for kind, record in _records(self._data[start:footer_at]):
            if kind == Opcode.CHUNK_INDEX:
                start_ns, end_ns, offset, channel_ids = _chunk_index(record)
                n_found += 1
                place = self._chunk_at(offset, channel_ids)
                if place is None:
                    self._compressions.add(_read(ChunkIndex, record).compression)
                    raise Damaged("a chunk is not where the summary says")
                if max(start_ns, end_ns) > self._limits.time_ns:
                    raise Damaged("the summary has a time that no clock has")
                if self._is_refused(place):
                    continue
                # the times in the summary are covered by its checksum, those in front of the chunk by none
                places.append(replace(place, start_ns=start_ns, end_ns=end_ns))
            elif kind == Opcode.CHANNEL:
                channel = _read(Channel, record)
                self.channels[channel.id] = channel
            elif kind == Opcode.STATISTICS:
                count = _read(Statistics, record).chunk_count
        if count != n_found:
            raise Damaged("the summary does not say where all chunks are")
        return places

    def _undamaged_chunks(self) -> Iterator[ChunkPlace]:
        at = 0
        while (signature := self._map.find(_SIGNATURE, at)) >= 0:
            at = signature + 1  # the length of a damaged chunk may be wrong too: others may begin within it
            place = self._chunk_at(signature - _SIGNATURE_AT)
            if place is None or self._is_refused(place):
                continue
            try:
                contents = self.contents(place)
            except Damaged:
                self.damaged += 1
            else:
                self.channels |= contents.channels
                at = place.end
                times_ns = [message.time_ns for message in contents.messages] or [place.start_ns]
                channels = frozenset(message.channel_id for message in contents.messages)
                # no checksum covers the times in front of the chunk
                yield replace(place, start_ns=min(times_ns), end_ns=max(times_ns), channel_ids=channels)

    def _chunk_at(self, offset: int, channel_ids: frozenset[int] | None = None) -> ChunkPlace | None:
        if not 0 <= offset <= len(self._data) - _CHUNK.size:
            return None
        opcode, length, start_ns, end_ns, size, crc, name_length, name, compressed_size = _CHUNK.unpack_from(
            self._data, offset
        )
        compressed_at = offset + _CHUNK.size
        if (
            opcode != Opcode.CHUNK
            or name_length != len(COMPRESSION)
            or name != COMPRESSION.encode()
            or length != _CHUNK.size - _RECORD.size + compressed_size
            or compressed_at + compressed_size > len(self._data)
        ):
            return None
        return ChunkPlace(offset, start_ns, end_ns, size, compressed_at, compressed_size, crc, channel_ids)

    def _is_refused(self, place: ChunkPlace) -> bool:
        """Return whether a chunk, or all chunks together, claim more bytes than the limits allow."""
        most = min(self._limits.chunk_size, self._room)
        if place.size <= most:
            self._room -= place.size
            return False
        self.damaged += 1
        if len(self.refused) < _MOST_REFUSED:
            self.refused.append(f"the chunk at byte {place.offset} claims {place.size} bytes; at most {most} are read")
        return True

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: type[BaseException] | BaseException | TracebackType | None) -> None:
        self.close()


def _records(data: memoryview) -> Iterator[tuple[int, memoryview]]:
    """Yield (opcode, contents) of each record in a part of a file; Damaged: they do not fill it."""
    at = 0
    while at < len(data):
        if at + _RECORD.size > len(data):
            raise Damaged("a record ends too early")
        opcode, length = _RECORD.unpack_from(data, at)
        at += _RECORD.size
        if at + length > len(data):
            raise Damaged("a record ends too early")
        yield opcode, data[at : at + length]
        at += length


def _chunk_index(record: memoryview) -> tuple[int, int, int, frozenset[int]]:
    """Return (first time, last time, offset, channels) of a chunk index. An hour has some 14,000 of these records."""
    try:
        start_ns, end_ns, offset, _, size = _CHUNK_INDEX.unpack_from(record)
        channels = _MESSAGE_INDEX.iter_unpack(record[_CHUNK_INDEX.size : _CHUNK_INDEX.size + size])
        return start_ns, end_ns, offset, frozenset(channel for channel, _ in channels)
    except struct.error as error:
        raise Damaged(f"a record cannot be read ({error})") from None


def _read(kind: Any, record: memoryview) -> Any:
    """Return a record as an object of the package mcap, or raise Damaged."""
    try:
        return kind.read(ReadDataStream(BytesIO(record)))
    except (McapError, struct.error, UnicodeDecodeError) as error:
        raise Damaged(f"a record cannot be read ({error})") from None
