"""Write recordings into one file, several, or memory, and make damaged files whole again."""

from __future__ import annotations

import contextlib
import errno
import os
from collections import Counter, deque
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from mcap.records import Channel, Schema

from skinware.errors import BadRecording
from skinware.realtime import NS_PER_S
from skinware.recording.mcap_reading import ChunkContents, Damaged, McapSource
from skinware.recording.mcap_writing import ClosedChunk, McapFile, OpenChunk

_RESTATED_AFTER_NS = 60 * NS_PER_S
_RESTATED_AFTER_BYTES = 64 << 20


@dataclass(frozen=True, eq=False)
class Head:
    """A generation, as it is told in a file before the first chunk that has frames of it.

    Attributes:
        channel, schema: of its message.
        sequence: how many of the service came before.
        data: the service's file up to its slots.
    """

    channel: Channel
    schema: Schema
    sequence: int
    data: bytes


class Target(Protocol):
    """Where a recording goes."""

    @property
    def paths(self) -> list[Path]:
        """The files that are there now."""

    @property
    def size(self) -> int:
        """Bytes of them; of what is kept in memory, where that is all."""

    @property
    def counts(self) -> Counter[int]:
        """Messages of each channel in them."""

    @property
    def is_full(self) -> bool:
        """Whether the recording is to end because it has its size."""

    def add(self, chunk: ClosedChunk, heads: Collection[Head]) -> None:
        """Add a chunk.

        Args:
            chunk: it.
            heads: of the generations that its frames are of.

        Raises:
            OSError: it cannot be written; all before it is safe.
        """

    def check(self) -> None:
        """Make sure that the file that is being written is still there, and as it was written.

        Raises:
            OSError: it is not.
        """

    def save(self) -> None:
        """Write what is only in memory.

        Raises:
            OSError: that is not possible.
        """

    def finish(self) -> None:
        """Complete the files. Idempotent.

        Raises:
            OSError: one is left without its summary, for which there is no room.
        """


class RecordingFile:
    """A file that explains itself: generations are told before their frames, now and then again, and at the end.

    Args:
        path: of the file, which must not be there.

    Raises:
        OSError: it cannot be made.
    """

    def __init__(self, path: Path) -> None:
        self.file = McapFile(path)
        self._told: dict[Head, int] = {}  # and how big the file was then
        self._told_ns = 0
        self._last_ns = 0

    def add(self, chunk: ClosedChunk, heads: Collection[Head]) -> None:
        """Append a chunk, after the generations that its frames are of."""
        self._last_ns = chunk.end_ns
        told_at = max(self._told.values(), default=0)
        if chunk.start_ns - self._told_ns > _RESTATED_AFTER_NS or self.file.size - told_at > _RESTATED_AFTER_BYTES:
            self._told.clear()
        self._tell([head for head in heads if head not in self._told], chunk.start_ns)
        self.file.add(chunk)

    def finish(self) -> None:
        told, self._told = list(self._told), {}
        try:
            self._tell(told, self._last_ns)
        finally:
            self.file.finish()

    def _tell(self, heads: Collection[Head], time_ns: int) -> None:
        if not heads:
            return
        chunk = OpenChunk()
        for head in heads:
            chunk.add(head.channel, head.schema, head.sequence, time_ns, head.data)
        self.file.add(chunk.close())
        self._told |= dict.fromkeys(heads, self.file.size)
        self._told_ns = time_ns


class Files:
    """One file, or several one after the other.

    Args:
        path: of the file; of several, with a number before its suffix (``walk-001.mcap``).
        split_size: bytes after which another file begins; None: all in one.
        max_size: bytes of all files together. Of several the oldest are removed; one is ended. None: no limit.

    Raises:
        OSError: the first file cannot be made.
    """

    def __init__(self, path: Path, *, split_size: int | None = None, max_size: int | None = None) -> None:
        self._path, self._split_size, self._max_size = path, split_size, max_size
        self._number = 0
        self._ended: deque[McapFile] = deque()
        self._file = self._next_file()

    @property
    def paths(self) -> list[Path]:
        return [file.path for file in self._all if file.is_there]

    @property
    def size(self) -> int:
        return sum(file.size for file in self._all)

    @property
    def counts(self) -> Counter[int]:
        counts: Counter[int] = Counter()
        for file in self._all:
            counts += file.counts
        return counts

    @property
    def is_full(self) -> bool:
        return self._max_size is not None and self._split_size is None and self.size >= self._max_size

    def add(self, chunk: ClosedChunk, heads: Collection[Head]) -> None:
        """See :class:`Target`."""
        if self._split_size is not None and self._file.file.size >= self._split_size:
            self._file.finish()
            self._ended.append(self._file.file)
            self._file = self._next_file()
        self._file.add(chunk, heads)
        while self._split_size is not None and self._max_size is not None and self.size > self._max_size:
            if not self._ended:
                break
            self._ended.popleft().path.unlink(missing_ok=True)

    def check(self) -> None:
        """See :class:`Target`."""
        self._file.file.check()

    def save(self) -> None:
        """Nothing: all is written."""

    def finish(self) -> None:
        """See :class:`Target`."""
        self._file.finish()

    @property
    def _all(self) -> list[McapFile]:
        return [*self._ended, self._file.file]

    def _next_file(self) -> RecordingFile:
        self._number += 1
        split = self._split_size is not None
        return RecordingFile(_numbered(self._path, self._number, 3) if split else self._path)


class Past:
    """The last seconds, kept in memory, and written whenever somebody wants them and at the end.

    Args:
        path: of the first file; the next ones have a number before the suffix (``fall-2.mcap``).
        duration_s: how much of the past.
    """

    def __init__(self, path: Path, duration_s: float) -> None:
        self._path, self._duration_ns = path, round(duration_s * NS_PER_S)
        self._chunks: deque[tuple[ClosedChunk, Collection[Head]]] = deque()
        self._saved: list[McapFile] = []
        self._finished = False

    @property
    def paths(self) -> list[Path]:
        return [file.path for file in self._saved if file.is_there]

    @property
    def size(self) -> int:
        return sum(len(chunk.record) for chunk, _ in self._chunks)

    @property
    def counts(self) -> Counter[int]:
        """Messages of each channel in the last file; before there is one, in memory."""
        if self._saved:
            return self._saved[-1].counts
        counts: Counter[int] = Counter()
        for chunk, _ in self._chunks:
            counts += chunk.counts
        return counts

    @property
    def is_full(self) -> bool:
        return False

    def add(self, chunk: ClosedChunk, heads: Collection[Head]) -> None:
        """See :class:`Target`."""
        self._chunks.append((chunk, tuple(heads)))
        while self._chunks[0][0].end_ns < chunk.end_ns - self._duration_ns:
            self._chunks.popleft()

    def check(self) -> None:
        """Nothing: no file is being written."""

    def save(self) -> None:
        """Write what is kept; it stays in memory too."""
        number = len(self._saved) + 1
        file = RecordingFile(self._path if number == 1 else _numbered(self._path, number, 1))
        self._saved.append(file.file)
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
    """What came of a recovery.

    Attributes:
        messages: of each channel that are in the new file.
        damaged: chunks that were found, but are damaged.
        was_whole: the file ended in good order, and nothing of it was damaged.
    """

    messages: dict[str, int]
    damaged: int
    was_whole: bool


def recover(source: Path, target: Path) -> Recovered:
    """Write what is undamaged in a recording into a new file, which is there only when it is complete.

    Args:
        source: the recording; it is only read.
        target: the new file; may have the place of the old one, and of no other.

    Raises:
        BadRecording: it is not a recording, or nothing of it can be used.
        OSError: it cannot be read, or the new one cannot be written.
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
                chunk = _again(contents)
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


def _again(contents: ChunkContents) -> OpenChunk:
    chunk = OpenChunk()
    for message in contents.messages:
        channel = contents.channels.get(message.channel_id)
        schema = contents.schemas.get(channel.schema_id) if channel is not None else None
        if channel is not None and schema is not None:
            chunk.add(channel, schema, message.sequence, message.time_ns, message.data)
    return chunk
