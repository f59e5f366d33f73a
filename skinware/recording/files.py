"""Write recordings into one file, several, or memory, and make damaged files whole again."""

from __future__ import annotations

import contextlib
import errno
import os
from collections import Counter, deque
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

from mcap.records import Channel, Schema

from skinware.errors import BadRecording
from skinware.limits import LIMITS
from skinware.memory.ring import Sample
from skinware.realtime import NS_PER_S
from skinware.recording.mcap_reading import Damaged, McapSource
from skinware.recording.mcap_writing import ClosedChunk, McapFile, OpenChunk
from skinware.transfer.codec import FrameEncoder
from skinware.transfer.generation import Generation

_REPEATED_AFTER_NS = 60 * NS_PER_S
_REPEATED_AFTER_BYTES = 64 << 20
_CHUNK_BYTES = 8 << 20
CHUNK_NS = NS_PER_S // 4
"""A chunk is closed so long after its first message; a killed recorder loses at most that."""


@dataclass(frozen=True, eq=False)
class Head:
    """The message that describes a generation, written before the first chunk with its samples.

    Attributes:
        sequence: number of the generations of the service before it.
        data: the service's file up to its slots.
    """

    channel: Channel
    schema: Schema
    sequence: int
    data: bytes


@dataclass(frozen=True)
class SampleStream:
    """The samples of a generation on their way into chunks; ``generation``: None where it is not read."""

    head: Head
    encoder: FrameEncoder
    generation: Generation | None


class RecordingFile:
    """A file that explains itself: heads of generations stand before their samples, now and then, and at the end."""

    def __init__(self, path: Path) -> None:
        self.file = McapFile(path)
        self._written: dict[Head, int] = {}  # and the size of the file then
        self._written_ns = 0
        self._last_ns = 0

    def add(self, chunk: ClosedChunk, heads: Collection[Head]) -> None:
        self._last_ns = chunk.end_ns
        size = max(self._written.values(), default=0)
        if chunk.start_ns - self._written_ns > _REPEATED_AFTER_NS or self.file.size - size > _REPEATED_AFTER_BYTES:
            self._written.clear()
        self._write([head for head in heads if head not in self._written], chunk.start_ns)
        self.file.add(chunk)

    def finish(self) -> None:
        heads, self._written = list(self._written), {}
        try:
            self._write(heads, self._last_ns)
        finally:
            self.file.finish()

    def _write(self, heads: Collection[Head], time_ns: int) -> None:
        if not heads:
            return
        chunk = OpenChunk()
        for head in heads:
            chunk.add(head.channel, head.schema, head.sequence, time_ns, head.data)
        self.file.add(chunk.close())
        self._written |= dict.fromkeys(heads, self.file.size)
        self._written_ns = time_ns


class PendingChunk:
    """A chunk that is being filled, with the heads of the generations of its samples."""

    def __init__(self) -> None:
        self.chunk = OpenChunk()
        self.heads: set[Head] = set()
        self._decoded_size = 0

    @property
    def is_large(self) -> bool:
        return self.chunk.size > _CHUNK_BYTES or self._decoded_size > LIMITS.frames_size // 2

    def add_sample(
        self,
        channel: Channel,
        schema: Schema,
        sample: Sample,
        time_ns: int,
        stream: SampleStream,
        wall_ns: int | None = None,
    ) -> None:
        """Code a sample and add it; the first one of its channel becomes a key frame."""
        if not self.chunk.has(channel):
            stream.encoder.next_is_key()
        self.heads.add(stream.head)
        self._decoded_size += len(sample.slot)
        self.chunk.add(channel, schema, sample.sequence, time_ns, stream.encoder.encode(sample), wall_ns)

    def move_to(self, target: Target | RecordingFile) -> None:
        """Close the chunk, add it to a target unless it is empty, and begin another."""
        if self.chunk.is_empty:
            return
        chunk, heads = self.chunk.close(), self.heads
        self.chunk, self.heads, self._decoded_size = OpenChunk(), set(), 0
        target.add(chunk, heads)


class Target:
    """A destination of a recording; ``path``: of its first file."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._files: deque[McapFile] = deque()

    @property
    def paths(self) -> list[Path]:
        return [file.path for file in self._files if file.is_there]

    @property
    def size(self) -> int:
        """Bytes in these files; bytes in memory before there is a file."""
        return sum(file.size for file in self._files)

    @property
    def counts(self) -> Counter[int]:
        return sum((file.counts for file in self._files), Counter())

    @property
    def is_full(self) -> bool:
        return False

    def add(self, chunk: ClosedChunk, heads: Collection[Head]) -> None:
        """Add a chunk, with the heads of its generations; OSError if that fails: the chunks before it are safe."""
        raise NotImplementedError

    def check(self) -> None:
        """Make sure that the open file, if there is one, still exists, unchanged by others; raise OSError if not."""

    def save(self) -> None:
        """Write the chunks that are only in memory; raise OSError if that fails."""

    def finish(self) -> None:
        """Complete the files. Idempotent. OSError: the disk has no room for a summary; the file stays without one."""
        raise NotImplementedError


class Files(Target):
    """One file, or several one after the other.

    Args:
        path: of the file; several get a number before the suffix (``walk-001.mcap``).
        split_size: bytes after which another file begins; None: one file.
        max_size: most bytes of all files together: the oldest of several are removed, a single one is ended. None: no
            limit.
    """

    def __init__(self, path: Path, *, split_size: int | None = None, max_size: int | None = None) -> None:
        super().__init__(path)
        self._split_size, self._max_size = split_size, max_size
        self._number = 0
        self._file = self._next_file()

    @property
    def is_full(self) -> bool:
        return self._max_size is not None and self._split_size is None and self.size >= self._max_size

    def add(self, chunk: ClosedChunk, heads: Collection[Head]) -> None:
        if self._split_size is not None and self._file.file.size >= self._split_size:
            self._file.finish()
            self._file = self._next_file()
        self._file.add(chunk, heads)
        if self._split_size is not None and self._max_size is not None:
            while len(self._files) > 1 and self.size > self._max_size:
                self._files.popleft().path.unlink(missing_ok=True)

    def check(self) -> None:
        self._file.file.check()

    def finish(self) -> None:
        self._file.finish()

    def _next_file(self) -> RecordingFile:
        self._number += 1
        split = self._split_size is not None
        file = RecordingFile(_numbered(self._path, self._number, 3) if split else self._path)
        self._files.append(file.file)
        return file


class Past(Target):
    """The last seconds, kept in memory, and written on request and at the end.

    Args:
        path: of the first file; the next ones get a number before the suffix (``fall-2.mcap``).
        duration_s: time that is kept.
    """

    def __init__(self, path: Path, duration_s: float) -> None:
        super().__init__(path)
        self._duration_ns = round(duration_s * NS_PER_S)
        self._chunks: deque[tuple[ClosedChunk, Collection[Head]]] = deque()
        self._finished = False

    @property
    def size(self) -> int:
        return sum(len(chunk.record) for chunk, _ in self._chunks)

    @property
    def counts(self) -> Counter[int]:
        if self._files:
            return self._files[-1].counts
        return sum((chunk.counts for chunk, _ in self._chunks), Counter())

    def add(self, chunk: ClosedChunk, heads: Collection[Head]) -> None:
        self._chunks.append((chunk, tuple(heads)))
        while self._chunks[0][0].end_ns < chunk.end_ns - self._duration_ns:
            self._chunks.popleft()

    def save(self) -> None:
        number = len(self._files) + 1
        file = RecordingFile(self._path if number == 1 else _numbered(self._path, number, 1))
        self._files.append(file.file)
        try:
            for chunk, heads in self._chunks:
                file.add(chunk, heads)
        finally:
            file.finish()

    def finish(self) -> None:
        if not self._finished:
            self._finished = True
            self.save()


def _numbered(path: Path, number: int, digits: int) -> Path:
    return path.with_name(f"{path.stem}-{number:0{digits}d}{path.suffix}")


@dataclass(frozen=True)
class Recovered:
    """The result of a recovery; ``was_whole``: the file had its summary, and no chunk was damaged."""

    messages: dict[str, int]
    damaged: int
    was_whole: bool


def recover(source: Path, target: Path) -> Recovered:
    """Copy the undamaged chunks of a recording into a new file, which appears when it is complete.

    Args:
        target: the new file; it may replace the old one, but no other.
    """
    if target.exists() and not target.samefile(source):
        raise FileExistsError(errno.EEXIST, "exists already: give another name", str(target))
    with McapSource(source) as old:
        begun = target.with_name(f".{target.name}.{os.getpid()}.part")
        new = McapFile(begun)
        damaged = old.damaged
        try:
            for place in old.chunks:
                try:
                    contents = old.contents(place)
                except Damaged:
                    damaged += 1
                    continue
                chunk = OpenChunk()
                for message in contents.messages:
                    channel = contents.channels.get(message.channel_id)
                    schema = contents.schemas.get(channel.schema_id) if channel is not None else None
                    if channel is not None and schema is not None:
                        chunk.add(channel, schema, message.sequence, message.time_ns, message.data)
                if not chunk.is_empty:
                    new.add(chunk.close())
            new.finish()
            if not new.counts:
                raise BadRecording(f"{source}: nothing in it can be used: no chunk is undamaged")
            os.rename(begun, target)
        except BaseException:
            with contextlib.suppress(OSError):
                new.finish()
            begun.unlink()
            raise
        messages = {old.channels[channel].topic: count for channel, count in sorted(new.counts.items())}
        return Recovered(messages, damaged, old.is_whole and not damaged)
