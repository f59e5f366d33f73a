"""A recording, written again from tables: equal to the one that they were made of, as far as they have it."""

from __future__ import annotations

import heapq
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from mcap.records import Channel, Schema

from skinware.conversion.tables import COLUMNS, TIME, Source, Table
from skinware.memory.file_layout import SLOT
from skinware.realtime import NS_PER_S
from skinware.recording.codec import Encoder
from skinware.recording.files import Head, RecordingFile
from skinware.recording.frames import RecordedFrame
from skinware.recording.generation import Generation
from skinware.recording.mcap_writing import OpenChunk
from skinware.recording.topics import CLOCK, EVENTS, FRAME, GENERATION, Channels

_CHUNK_NS = NS_PER_S // 4
_CHUNK_BYTES = 8 << 20

_Item = tuple[int, str, Any]
"""(wall clock, service or topic, a frame after its generation or what JSON has)"""


def write_recording(source: Source, path: Path) -> None:
    """Write a source.

    Raises:
        OSError: it cannot be written.
    """
    file = RecordingFile(path)
    writer = _Writer(file)
    try:
        streams = [_frames(table) for table in source.tables]
        streams += [_told(EVENTS, source.events), _told(CLOCK, source.clock)]
        for time_ns, name, what in heapq.merge(*streams, key=lambda item: item[0]):
            writer.close_chunk_before(time_ns)
            if isinstance(what, dict):
                writer.add_json(time_ns, name, what)
            else:
                writer.add_frame(time_ns, name, *what)
        writer.close_chunk()
    finally:
        file.finish()


def _frames(table: Table) -> Iterator[_Item]:
    generations = {generation.generation: generation for generation in table.generations}
    origin = table.origin
    for block in table.blocks(table.arrays):
        slots = np.zeros((len(block[TIME]), origin.slot_stride), np.uint8)
        heads = slots[:, : SLOT.itemsize].view(SLOT)[:, 0]
        for name in ("sequence", "acquired_ns", "published_ns", "flags"):
            heads[name] = block[f"frames/{name}"]
        for name, (_, _, offset) in origin.columns.items():
            rows = block.get(COLUMNS + name)
            if rows is not None:
                data = np.frombuffer(rows.tobytes(), np.uint8).reshape(len(slots), -1)
                slots[:, offset : offset + data.shape[1]] = data
        for slot, number, time_ns in zip(slots, block["frames/generation"].tolist(), block[TIME].tolist(), strict=True):
            yield time_ns, table.service, (generations[number], RecordedFrame(generations[number], slot.data))


def _told(topic: str, told: list[dict[str, Any]]) -> Iterator[_Item]:
    for each in told:
        yield each["log_time_ns"], topic, {name: value for name, value in each.items() if name != "log_time_ns"}


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

    def add_frame(self, time_ns: int, service: str, generation: Generation, frame: RecordedFrame) -> None:
        """A frame of a service."""
        stream = self._streams.get(service)
        if stream is None or stream.generation is not generation:
            stream = self._streams[service] = self._stream(service, generation, stream)
        channel, schema = self._channels.of_service(service, FRAME)
        if not self._chunk.has(channel):
            stream.encoder.next_is_key()
        self._heads.add(stream.head)
        self._add(channel, schema, frame.sequence, time_ns, stream.encoder.encode(frame))

    def add_json(self, time_ns: int, topic: str, data: dict[str, Any]) -> None:
        """An event, or what the clocks were."""
        channel, schema = self._channels.of_all(topic)
        self._add(channel, schema, 0, time_ns, json.dumps(data).encode())

    def close_chunk_before(self, time_ns: int) -> None:
        """End the chunk at hand if a message of a time is not to be in it."""
        if self._chunk.size > _CHUNK_BYTES or time_ns >= self._begun_ns + _CHUNK_NS:
            self.close_chunk()
            self._begun_ns = time_ns

    def close_chunk(self) -> None:
        """End the chunk at hand."""
        if not self._chunk.is_empty:
            self._file.add(self._chunk.close(), self._heads)
            self._chunk, self._heads = OpenChunk(), set()

    def _stream(self, service: str, generation: Generation, before: _Stream | None) -> _Stream:
        number = 1 if before is None else before.head.sequence + 1
        channel, schema = self._channels.of_service(service, GENERATION)
        return _Stream(Head(channel, schema, number, generation.head), generation, Encoder(generation.coded))

    def _add(self, channel: Channel, schema: Schema, sequence: int, time_ns: int, data: bytes) -> None:
        self._chunk.add(channel, schema, sequence, time_ns, data)
