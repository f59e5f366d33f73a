"""MCAP files, written chunk by chunk: each chunk is complete in itself, and is in the file as soon as it is closed.

A chunk brings the schemas and channels of its messages with it, so that it can be read without any other, copied to
another file, or kept for later. https://mcap.dev/spec has the format.
"""

from __future__ import annotations

import errno
import os
import struct
import zlib
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    MessageIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

MAGIC = bytes((137, 77, 67, 65, 80, 48, 13, 10))
PROFILE = "skinware"
COMPRESSION = "zstd"
_LEVEL = 1
"""Of compression: at higher ones, matches that chance makes in noise cost time and bytes."""
_MESSAGE = struct.Struct("<BQHIQQ")
_LEAST_FREE = 64 << 10
"""Bytes that are left on the disk for what comes last, beside the summary."""


@dataclass(frozen=True)
class ClosedChunk:
    """A chunk as it stands in a file, wherever that is.

    Attributes:
        record: bytes of the chunk, and of the indexes of its messages behind it.
        index: of the chunk in the summary, as if it began at 0.
        counts: messages of each channel.
        channels: of its messages.
        schemas: of these.
    """

    record: bytes
    index: ChunkIndex
    counts: Counter[int]
    channels: dict[int, Channel]
    schemas: dict[int, Schema]

    @property
    def start_ns(self) -> int:
        """Time of its first message, wall clock."""
        return int(self.index.message_start_time)

    @property
    def end_ns(self) -> int:
        """Time of its last message, wall clock."""
        return int(self.index.message_end_time)


@dataclass
class OpenChunk:
    """A chunk that is being filled.

    Attributes:
        size: bytes in it so far.
    """

    size: int = 0
    _parts: list[bytes | memoryview] = field(default_factory=list)
    _channels: dict[int, Channel] = field(default_factory=dict)
    _schemas: dict[int, Schema] = field(default_factory=dict)
    _places: dict[int, list[tuple[int, int]]] = field(default_factory=dict)

    def add(self, channel: Channel, schema: Schema, sequence: int, time_ns: int, data: bytes | memoryview) -> None:
        """Add a message.

        Args:
            channel: its channel, the same object each time.
            schema: of the channel.
            sequence: of the message.
            time_ns: when it was published, wall clock.
            data: of it.
        """
        if schema.id not in self._schemas:
            self._schemas[schema.id] = schema
            self._append(_bytes(schema))
        if channel.id not in self._channels:
            self._channels[channel.id] = channel
            self._append(_bytes(channel))
        self._places.setdefault(channel.id, []).append((time_ns, self.size))
        length = _MESSAGE.size - 9 + len(data)
        self._append(_MESSAGE.pack(Opcode.MESSAGE, length, channel.id, sequence & 0xFFFFFFFF, time_ns, time_ns))
        self._append(data)

    def has(self, channel: Channel) -> bool:
        """Whether a message of a channel is in it."""
        return channel.id in self._places

    @property
    def is_empty(self) -> bool:
        """Whether no message is in it."""
        return not self._places

    def close(self) -> ClosedChunk:
        """Compress it."""
        data = b"".join(self._parts)
        times = [time_ns for places in self._places.values() for time_ns, _ in places]
        compressed = zstandard.ZstdCompressor(level=_LEVEL).compress(data)
        start_ns, end_ns = min(times), max(times)
        chunk = Chunk(
            compression=COMPRESSION,
            data=compressed,
            message_start_time=start_ns,
            message_end_time=end_ns,
            uncompressed_crc=zlib.crc32(data),
            uncompressed_size=len(data),
        )
        builder = RecordBuilder()
        chunk.write(builder)
        chunk_length = builder.count
        offsets: dict[int, int] = {}
        for channel_id, places in self._places.items():
            offsets[channel_id] = builder.count
            MessageIndex(channel_id, places).write(builder)
        index = ChunkIndex(
            chunk_length=chunk_length,
            chunk_start_offset=0,
            compression=COMPRESSION,
            compressed_size=len(compressed),
            message_end_time=end_ns,
            message_index_length=builder.count - chunk_length,
            message_index_offsets=offsets,
            message_start_time=start_ns,
            uncompressed_size=len(data),
        )
        counts = Counter({channel_id: len(places) for channel_id, places in self._places.items()})
        record: bytes = builder.end()  # type: ignore[no-untyped-call]
        return ClosedChunk(record, index, counts, self._channels, self._schemas)

    def _append(self, data: bytes | memoryview) -> None:
        self._parts.append(data)
        self.size += len(data)


class McapFile:
    """A file that grows by whole chunks. Whatever happens, it consists of whole chunks up to the last that was added.

    Args:
        path: of the file, which must not be there.
        profile: what MCAP tools may expect of its channels.

    Attributes:
        size: bytes in it so far.

    Raises:
        OSError: it cannot be made.
    """

    def __init__(self, path: Path, profile: str = PROFILE) -> None:
        from importlib.metadata import version

        self.path: Path = path
        self.counts: Counter[int] = Counter()
        self._channels: dict[int, Channel] = {}
        self._schemas: dict[int, Schema] = {}
        self._index: list[ChunkIndex] = []
        self._fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        self.size: int = 0
        try:
            self._append(MAGIC + _bytes(Header(profile, f"skinware {version('skinware')}")))
        except BaseException:
            os.close(self._fd)
            path.unlink()
            raise

    def add(self, chunk: ClosedChunk) -> None:
        """Append a chunk.

        Raises:
            OSError: it cannot be written, in particular because the disk is full: nothing of it is in the file then.
        """
        free = os.fstatvfs(self._fd)
        if free.f_bavail * free.f_frsize < len(chunk.record) + 2 * self._summary_size + _LEAST_FREE:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self.path))
        begin = self.size
        self._append(chunk.record)
        index = chunk.index
        moved = ChunkIndex(
            chunk_length=index.chunk_length,
            chunk_start_offset=begin,
            compression=index.compression,
            compressed_size=index.compressed_size,
            message_end_time=index.message_end_time,
            message_index_length=index.message_index_length,
            message_index_offsets={channel: begin + at for channel, at in index.message_index_offsets.items()},
            message_start_time=index.message_start_time,
            uncompressed_size=index.uncompressed_size,
        )
        self._index.append(moved)
        self._channels |= chunk.channels
        self._schemas |= chunk.schemas
        self.counts += chunk.counts

    def finish(self) -> None:
        """Write the summary, by which readers find everything at once, and close the file. Idempotent.

        Raises:
            OSError: there is no room for it. The file then ends with its last chunk, and is closed.
        """
        if self._fd < 0:
            return
        try:
            self._append(_bytes(DataEnd(0)) + self._summary(self.size + len(_bytes(DataEnd(0)))))
        finally:
            fd, self._fd = self._fd, -1
            os.close(fd)

    @property
    def _summary_size(self) -> int:
        return 2048 + sum(80 + 10 * len(index.message_index_offsets) for index in self._index[-1:]) * len(self._index)

    def _summary(self, start: int) -> bytes:
        statistics = Statistics(
            attachment_count=0,
            channel_count=len(self._channels),
            channel_message_counts=dict(self.counts),
            chunk_count=len(self._index),
            message_count=self.counts.total(),
            message_end_time=max((index.message_end_time for index in self._index), default=0),
            message_start_time=min((index.message_start_time for index in self._index), default=0),
            metadata_count=0,
            schema_count=len(self._schemas),
        )
        groups: list[tuple[Opcode, Iterable[McapRecord]]] = [
            (Opcode.SCHEMA, self._schemas.values()),
            (Opcode.CHANNEL, self._channels.values()),
            (Opcode.STATISTICS, [statistics]),
            (Opcode.CHUNK_INDEX, self._index),
        ]
        summary, offsets = bytearray(), bytearray()
        for opcode, records in groups:
            begin = len(summary)
            for record in records:
                summary += _bytes(record)
            if len(summary) > begin:
                offsets += _bytes(SummaryOffset(opcode, start + begin, len(summary) - begin))
        offsets_start = start + len(summary)
        summary += offsets
        footer = _bytes(Footer(start, offsets_start, 0))
        crc = zlib.crc32(bytes(summary) + footer[:-4])
        return bytes(summary) + _bytes(Footer(start, offsets_start, crc)) + MAGIC

    def _append(self, data: bytes) -> None:
        """All of it, or nothing."""
        rest = memoryview(data)
        try:
            while rest:
                rest = rest[os.write(self._fd, rest) :]
        except OSError as error:
            os.ftruncate(self._fd, self.size)
            os.lseek(self._fd, self.size, os.SEEK_SET)
            raise OSError(error.errno, error.strerror, str(self.path)) from None
        self.size += len(data)


def _bytes(record: McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    data: bytes = builder.end()  # type: ignore[no-untyped-call]
    return data
