"""Write MCAP files chunk by chunk. A chunk is complete in itself, and is in the file as soon as it is closed.

A chunk contains the schemas and channels of its messages, so that it can be read without any other, copied to another
file, or kept for later. https://mcap.dev/spec defines the format.
"""

from __future__ import annotations

import contextlib
import errno
import os
import struct
import tempfile
import zlib
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
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
_LEVEL = 1  # higher levels find chance matches in noise, which cost time and bytes
_MESSAGE = struct.Struct("<BQHIQQ")
_LEAST_FREE = 64 << 10  # bytes of the disk that are kept free for the last heads, besides the summary
_SPOOL_BYTES = 64 << 10  # records of the summary in memory: those of 500 chunks, two minutes; others are in a file


@dataclass(frozen=True)
class ClosedChunk:
    """A finished chunk, ready for any file; ``index``: its entry in the summary, for a chunk at offset 0."""

    record: bytes
    index: ChunkIndex
    counts: Counter[int]
    channels: dict[int, Channel]
    schemas: dict[int, Schema]

    @property
    def start_ns(self) -> int:
        """Time of its first message, as for :meth:`OpenChunk.add`."""
        return int(self.index.message_start_time)

    @property
    def end_ns(self) -> int:
        return int(self.index.message_end_time)


@dataclass
class OpenChunk:
    """A chunk that is being filled; ``size``: bytes in it so far."""

    size: int = 0
    _parts: list[bytes | memoryview] = field(default_factory=list)
    _channels: dict[int, Channel] = field(default_factory=dict)
    _schemas: dict[int, Schema] = field(default_factory=dict)
    _places: dict[int, list[tuple[int, int]]] = field(default_factory=dict)

    def add(
        self,
        channel: Channel,
        schema: Schema,
        sequence: int,
        time_ns: int,
        data: bytes | memoryview,
        wall_ns: int | None = None,
    ) -> None:
        """Add a message.

        Args:
            channel: its channel, the same object each time.
            time_ns: time of publication, on the axis that orders the file (MCAP's ``log_time``).
            wall_ns: the same moment by the wall clock (MCAP's ``publish_time``); None: ``time_ns``.
        """
        if schema.id not in self._schemas:
            self._schemas[schema.id] = schema
            self._append(_bytes(schema))
        if channel.id not in self._channels:
            self._channels[channel.id] = channel
            self._append(_bytes(channel))
        self._places.setdefault(channel.id, []).append((time_ns, self.size))
        length = _MESSAGE.size - 9 + len(data)
        label_ns = time_ns if wall_ns is None else max(0, wall_ns)
        self._append(_MESSAGE.pack(Opcode.MESSAGE, length, channel.id, sequence & 0xFFFFFFFF, time_ns, label_ns))
        self._append(data)

    def has(self, channel: Channel) -> bool:
        return channel.id in self._places

    @property
    def is_empty(self) -> bool:
        return not self._places

    def close(self) -> ClosedChunk:
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
    """A file that grows by whole chunks, and always consists of the chunks that were added."""

    def __init__(self, path: Path, profile: str = PROFILE) -> None:
        from importlib.metadata import version

        self.path: Path = path
        self.counts: Counter[int] = Counter()
        self._channels: dict[int, Channel] = {}
        self._schemas: dict[int, Schema] = {}
        self._chunks = 0
        self._start_ns, self._end_ns = (1 << 64) - 1, 0
        self._fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        self._index = tempfile.SpooledTemporaryFile(_SPOOL_BYTES, dir=str(path.parent))  # noqa: SIM115
        self._is_ours = True
        info = os.fstat(self._fd)
        self._inode = info.st_dev, info.st_ino
        self.size: int = 0
        try:
            self._append([MAGIC, _bytes(Header(profile, f"skinware {version('skinware')}"))])
        except BaseException:
            self._index.close()
            os.close(self._fd)
            path.unlink()
            raise

    @property
    def is_there(self) -> bool:
        try:
            info = os.stat(self.path)
        except OSError:
            return False
        return (info.st_dev, info.st_ino) == self._inode

    def check(self) -> None:
        """Make sure that the file is unchanged, and where it was made, or raise OSError."""
        if self._fd < 0:
            return
        info = os.fstat(self._fd)
        if not info.st_nlink:
            raise OSError(errno.ESTALE, "deleted while it was recorded: what was in it is gone", str(self.path))
        if info.st_size != self.size:
            self._is_ours = False  # a summary would not fit it
            what = f"changed by another program while it was recorded: {info.st_size} bytes instead of {self.size}"
            raise OSError(errno.EIO, f"{what}; skin-recover saves what is left", str(self.path))
        if not self.is_there:
            where = os.readlink(f"/proc/self/fd/{self._fd}")
            raise OSError(errno.ENOENT, f"moved while it was recorded; all until then is in {where}", str(self.path))

    def add(self, chunk: ClosedChunk) -> None:
        """Append a chunk, or raise OSError: the file stays without it."""
        self.check()
        free = os.fstatvfs(self._fd)
        index_size = self._index.tell()
        summary_size = 2048 + index_size
        if free.f_bavail * free.f_frsize < len(chunk.record) + 2 * summary_size + _LEAST_FREE:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self.path))
        index = chunk.index
        offsets = {channel: self.size + at for channel, at in index.message_index_offsets.items()}
        moved = replace(index, chunk_start_offset=self.size, message_index_offsets=offsets)
        try:
            self._index.write(_bytes(moved))
            self._index.flush()
            self._append([chunk.record])
        except OSError as error:
            with contextlib.suppress(OSError):
                self._index.seek(index_size)
                self._index.truncate()
            raise OSError(error.errno, error.strerror, str(self.path)) from None
        self._chunks += 1
        self._start_ns, self._end_ns = min(self._start_ns, chunk.start_ns), max(self._end_ns, chunk.end_ns)
        self._channels |= chunk.channels
        self._schemas |= chunk.schemas
        self.counts += chunk.counts

    def finish(self) -> None:
        """Write the summary, which makes reading fast, and close the file. Idempotent. It may lack room: OSError."""
        if self._fd < 0:
            return
        try:
            if self._is_ours:
                end = _bytes(DataEnd(0))
                self._append([end, *self._summary(self.size + len(end))])
        finally:
            self._index.close()
            fd, self._fd = self._fd, -1
            try:
                os.close(fd)
            except OSError as error:  # network file systems report a full disk late
                raise OSError(error.errno, error.strerror, str(self.path)) from None

    def _summary(self, start: int) -> Iterator[bytes]:
        statistics = Statistics(
            attachment_count=0,
            channel_count=len(self._channels),
            channel_message_counts=dict(self.counts),
            chunk_count=self._chunks,
            message_count=self.counts.total(),
            message_end_time=self._end_ns,
            message_start_time=min(self._start_ns, self._end_ns),
            metadata_count=0,
            schema_count=len(self._schemas),
        )
        groups: list[tuple[Opcode, Iterable[bytes]]] = [
            (Opcode.SCHEMA, map(_bytes, self._schemas.values())),
            (Opcode.CHANNEL, map(_bytes, self._channels.values())),
            (Opcode.STATISTICS, [_bytes(statistics)]),
            (Opcode.CHUNK_INDEX, iter(partial(self._index.read, _SPOOL_BYTES), b"")),
        ]
        self._index.seek(0)
        at, crc, offsets = start, 0, b""
        for opcode, parts in groups:
            begin = at
            for part in parts:
                at, crc = at + len(part), zlib.crc32(part, crc)
                yield part
            if at > begin:
                offsets += _bytes(SummaryOffset(opcode, begin, at - begin))
        footer = _bytes(Footer(start, at, 0))
        yield offsets
        yield _bytes(Footer(start, at, zlib.crc32(offsets + footer[:-4], crc)))
        yield MAGIC

    def _append(self, parts: Iterable[bytes]) -> None:
        size = self.size
        try:
            for part in parts:
                rest = memoryview(part)
                while rest:
                    rest = rest[os.write(self._fd, rest) :]
                size += len(part)
        except OSError as error:
            os.ftruncate(self._fd, self.size)
            os.lseek(self._fd, self.size, os.SEEK_SET)
            raise OSError(error.errno, error.strerror, str(self.path)) from None
        self.size = size


def _bytes(record: McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    data: bytes = builder.end()  # type: ignore[no-untyped-call]
    return data
