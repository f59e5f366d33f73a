"""A recording, written again from tables: equal to the one that they were made of, as far as they have it."""

from __future__ import annotations

import heapq
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from skinware.conversion.tables import Source
from skinware.conversion.timed_frames import TimedFrame, timed_frames
from skinware.limits import LIMITS
from skinware.realtime import NS_PER_S
from skinware.recording.files import Head, RecordingFile
from skinware.recording.mcap_writing import OpenChunk
from skinware.recording.topics import CLOCK, EVENTS, FRAME, GENERATION, Channels
from skinware.transfer.codec import Encoder
from skinware.transfer.generation import Generation

_CHUNK_NS = NS_PER_S // 4
_CHUNK_BYTES = 8 << 20


class _Told(NamedTuple):
    """An event, or what the clocks were.

    Attributes:
        time_ns: on the axis of the recording.
        topic: of which.
        data: as JSON has it.
    """

    time_ns: int
    topic: str
    data: dict[str, Any]


def write_recording(source: Source, path: Path) -> None:
    """Write a source.

    Raises:
        OSError: it cannot be written.
    """
    file = RecordingFile(path)
    writer = _Writer(file)
    items: list[Iterator[TimedFrame | _Told]] = [
        *(timed_frames([table]) for table in source.tables),
        _told(EVENTS, source.events),
        _told(CLOCK, source.clock),
    ]
    try:
        for item in heapq.merge(*items, key=lambda item: item.time_ns):
            writer.close_chunk_before(item.time_ns)
            if isinstance(item, TimedFrame):
                writer.add_frame(item)
            else:
                writer.add_json(item)
        writer.close_chunk()
    finally:
        file.finish()


def _told(topic: str, told: list[dict[str, Any]]) -> Iterator[_Told]:
    for each in told:
        yield _Told(each["log_time_ns"], topic, {name: value for name, value in each.items() if name != "log_time_ns"})


@dataclass
class _Stream:
    """The frames of one service as they are coded."""

    head: Head
    generation: Generation
    encoder: Encoder


class _Writer:
    """Codes frames and fills chunks.

    Args:
        file: where they go.
    """

    def __init__(self, file: RecordingFile) -> None:
        self._file = file
        self._channels = Channels()
        self._streams: dict[str, _Stream] = {}
        self._chunk, self._heads, self._begun_ns = OpenChunk(), set[Head](), 0
        self._frames_size = 0  # of the chunk, decoded

    def add_frame(self, timed: TimedFrame) -> None:
        stream = self._streams.get(timed.service)
        if stream is None or stream.generation is not timed.generation:
            stream = self._streams[timed.service] = self._stream(timed.service, timed.generation, stream)
        channel, schema = self._channels.of_service(timed.service, FRAME)
        if not self._chunk.has(channel):
            stream.encoder.next_is_key()
        self._heads.add(stream.head)
        self._frames_size += len(timed.frame.slot)
        self._chunk.add(channel, schema, timed.frame.sequence, timed.time_ns, stream.encoder.encode(timed.frame))

    def add_json(self, told: _Told) -> None:
        channel, schema = self._channels.of_all(told.topic)
        self._chunk.add(channel, schema, 0, told.time_ns, json.dumps(told.data).encode())

    def close_chunk_before(self, time_ns: int) -> None:
        """End the chunk at hand if a message of a time is not to be in it."""
        is_large = self._chunk.size > _CHUNK_BYTES or self._frames_size > LIMITS.frames_size // 2
        if is_large or time_ns >= self._begun_ns + _CHUNK_NS:
            self.close_chunk()
            self._begun_ns = time_ns

    def close_chunk(self) -> None:
        if not self._chunk.is_empty:
            self._file.add(self._chunk.close(), self._heads)
            self._chunk, self._heads, self._frames_size = OpenChunk(), set(), 0

    def _stream(self, service: str, generation: Generation, before: _Stream | None) -> _Stream:
        number = 1 if before is None else before.head.sequence + 1
        channel, schema = self._channels.of_service(service, GENERATION)
        return _Stream(Head(channel, schema, number, generation.head), generation, Encoder(generation.coded))
