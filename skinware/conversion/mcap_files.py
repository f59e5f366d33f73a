"""Write MCAP files from tables: recordings, files for Foxglove, bags of ROS 2."""

from __future__ import annotations

import heapq
import json
from collections.abc import Iterator, Sequence
from functools import partial
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from skinware.conversion import ros_messages
from skinware.conversion.showing import Showing, ViewerMessage, Viewers, in_topic
from skinware.conversion.tables import COLUMNS, TIME, Table, TableSource
from skinware.driver_snapshot import DriverSnapshot
from skinware.errors import ConfigurationError
from skinware.memory.file_layout import SLOT
from skinware.recording.files import CHUNK_NS, Head, PendingChunk, RecordingFile, SampleStream
from skinware.recording.mcap_writing import McapFile, OpenChunk
from skinware.recording.topics import CLOCK, EVENTS, FRAME, GENERATION, SCHEMAS, Channels
from skinware.structure import Structure
from skinware.transfer.codec import FrameEncoder
from skinware.transfer.generation import Generation, RecordedSample, frame_of


class TimedFrame(NamedTuple):
    """A frame of a table.

    Attributes:
        time_ns: when it was published, on the axis of the recording.
    """

    time_ns: int
    service: str
    generation: Generation
    frame: RecordedSample


def timed_frames(tables: Sequence[Table]) -> Iterator[TimedFrame]:
    return heapq.merge(*map(_of_table, tables), key=lambda each: each.time_ns)


def _of_table(table: Table) -> Iterator[TimedFrame]:
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
        numbers, times = block["frames/generation"].tolist(), block[TIME].tolist()
        for slot, number, time_ns in zip(slots, numbers, times, strict=True):
            generation = generations[number]
            yield TimedFrame(time_ns, table.service, generation, frame_of(generation, slot))


def write_recording(source: TableSource, path: Path) -> None:
    file = RecordingFile(path)
    writer = _RecordingWriter(file)
    items = [
        ((each.time_ns, partial(writer.add_frame, each)) for each in timed_frames(source.tables)),
        ((each["log_time_ns"], partial(writer.add_json, EVENTS, each)) for each in source.events),
        ((each["log_time_ns"], partial(writer.add_json, CLOCK, each)) for each in source.clock),
    ]
    begun_ns = 0
    try:
        for time_ns, add in heapq.merge(*items, key=itemgetter(0)):
            if writer.pending.is_large or time_ns >= begun_ns + CHUNK_NS:
                writer.close_chunk()
                begun_ns = time_ns
            add()
        writer.close_chunk()
    finally:
        file.finish()


class _RecordingWriter:
    def __init__(self, file: RecordingFile) -> None:
        self._file = file
        self._channels = Channels()
        self._streams: dict[str, SampleStream] = {}
        self.pending = PendingChunk()

    def add_frame(self, timed: TimedFrame) -> None:
        stream = self._streams.get(timed.service)
        if stream is None or stream.generation is not timed.generation:
            number = 1 if stream is None else stream.head.sequence + 1
            channel, schema = self._channels.of_service(timed.service, GENERATION)
            head = Head(channel, schema, number, timed.generation.head)
            stream = SampleStream(head, FrameEncoder(timed.generation.coded), timed.generation)
            self._streams[timed.service] = stream
        channel, schema = self._channels.of_service(timed.service, FRAME)
        self.pending.add_sample(channel, schema, timed.frame, timed.time_ns, stream)

    def add_json(self, topic: str, entry: dict[str, Any]) -> None:
        channel, schema = self._channels.of_all(topic)
        data = {name: value for name, value in entry.items() if name != "log_time_ns"}
        self.pending.chunk.add(channel, schema, 0, entry["log_time_ns"], json.dumps(data).encode())

    def close_chunk(self) -> None:
        self.pending.move_to(self._file)


_MESSAGE_CHUNK_BYTES = 4 << 20
_BAG_VERSION = 5
"""Version of metadata.yaml: that of ROS 2 Humble, which later ones read."""


def write_foxglove(source: TableSource, path: Path) -> None:
    """Write the pictures and states of drivers, at most 30 times a second, and their events."""
    viewers = Viewers()
    writer = _MessageWriter(path, "")
    try:
        for event in source.events:
            writer.add(ViewerMessage(EVENTS, "json", SCHEMAS[EVENTS], json.dumps(event).encode()), event["log_time_ns"])
        for timed in timed_frames(_drivers(source)):
            for message in viewers.messages(timed.service, timed.generation, timed.frame, timed.time_ns):
                writer.add(message, timed.time_ns)
    finally:
        writer.finish()


def viewers_without(source: TableSource) -> list[str]:
    notes = []
    for table in source.tables:
        structure = table.structure
        if structure is None:
            notes.append(f"{table.name} is left out: it has no sensors")
        elif not Showing(table.service, structure).has_points:
            notes.append(f"{table.name}: no place of a sensor is known: images only, no points")
    return notes


def write_ros2(source: TableSource, folder: Path) -> None:
    """Write a bag of ROS 2 (rosbag2, storage mcap) into a new folder: every sample, and pictures for viewers."""
    drivers = _drivers(source)
    folder.mkdir()
    name = f"{source.path.stem}_0.mcap"
    viewers = Viewers(json_state=False)
    writer = _MessageWriter(folder / name, "ros2")
    described: set[Generation] = set()
    tables = {generation: table for table in drivers for generation in table.generations}
    try:
        for timed in timed_frames(drivers):
            if timed.generation not in described:
                described.add(timed.generation)
                writer.add(_sensors(timed, tables[timed.generation]), timed.time_ns)
            data = ros_messages.skin_frame(DriverSnapshot(timed.generation, timed.frame.slot), timed.time_ns)
            topic = f"/skin/{in_topic(timed.service)}/frame"
            writer.add(ViewerMessage(topic, "cdr", ros_messages.SKIN_FRAME, data), timed.time_ns)
            for message in viewers.messages(timed.service, timed.generation, timed.frame, timed.time_ns):
                writer.add(message, timed.time_ns)
    finally:
        writer.finish()
    (folder / "metadata.yaml").write_text(writer.metadata(name), encoding="utf-8")


def ros2_without(source: TableSource) -> list[str]:
    return [*viewers_without(source), "counters, histograms and events are left out: ros2 does not hold them"]


def _drivers(source: TableSource) -> list[Table]:
    drivers = [table for table in source.tables if table.structure is not None]
    if not drivers:
        raise ConfigurationError(f"{source.path}: no driver is in it, and nothing else can be shown")
    return drivers


def _sensors(timed: TimedFrame, table: Table) -> ViewerMessage:
    structure = timed.generation.context
    assert isinstance(structure, Structure)  # noqa: S101, of a driver
    data = ros_messages.sensors(structure, table.sensor_names, timed.generation.generation, timed.time_ns)
    return ViewerMessage(f"/skin/{in_topic(timed.service)}/sensors", "cdr", ros_messages.SENSORS, data)


class _MessageWriter:
    """An MCAP file of messages in any order."""

    def __init__(self, path: Path, profile: str) -> None:
        self._file = McapFile(path, profile)
        self._channels = Channels()
        self._chunk = OpenChunk()
        self._types: dict[int, tuple[str, str]] = {}
        self._begin_ns, self._end_ns = 1 << 63, 0

    def add(self, message: ViewerMessage, time_ns: int) -> None:
        channel, schema = self._channels.of(message.topic, message.encoding, message.schema)
        self._types[channel.id] = message.topic, schema.name
        self._begin_ns, self._end_ns = min(self._begin_ns, time_ns), max(self._end_ns, time_ns)
        self._chunk.add(channel, schema, 0, time_ns, message.data)
        if self._chunk.size > _MESSAGE_CHUNK_BYTES:
            self._close_chunk()

    def finish(self) -> None:
        try:
            self._close_chunk()
        finally:
            self._file.finish()

    def metadata(self, name: str) -> str:
        topics = []
        for channel, (topic, type_name) in self._types.items():
            topics += [
                f"    - topic_metadata: {{name: {_quoted(topic)}, type: {_quoted(type_name)},",
                '        serialization_format: cdr, offered_qos_profiles: ""}',
                f"      message_count: {self._file.counts[channel]}",
            ]
        begin_ns = min(self._begin_ns, self._end_ns)
        times = [
            ("duration", f"{{nanoseconds: {self._end_ns - begin_ns}}}"),
            ("starting_time", f"{{nanoseconds_since_epoch: {begin_ns}}}"),
            ("message_count", str(self._file.counts.total())),
        ]
        lines = ["rosbag2_bagfile_information:", f"  version: {_BAG_VERSION}", "  storage_identifier: mcap"]
        lines += [f"  {key}: {value}" for key, value in times]
        lines += ["  topics_with_message_count:", *topics]
        lines += [
            '  compression_format: ""',
            '  compression_mode: ""',
            "  relative_file_paths:",
            f"    - {_quoted(name)}",
        ]
        lines += ["  files:", f"    - path: {_quoted(name)}", *(f"      {key}: {value}" for key, value in times[::-1])]
        return "\n".join(lines) + "\n"

    def _close_chunk(self) -> None:
        if not self._chunk.is_empty:
            chunk, self._chunk = self._chunk, OpenChunk()
            self._file.add(chunk.close())


def _quoted(text: str) -> str:
    return json.dumps(text)
