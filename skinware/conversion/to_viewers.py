"""Recordings for Foxglove, Lichtblick and ROS 2: MCAP with messages that they know."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

from skinware.conversion import definitions, skin_messages
from skinware.conversion.showing import Message, Showing, in_topic
from skinware.conversion.tables import Source, Table
from skinware.conversion.timed_frames import TimedFrame, timed_frames
from skinware.conversion.viewers import Viewers
from skinware.driver_snapshot import DriverSnapshot
from skinware.errors import ConfigurationError
from skinware.recording.mcap_writing import McapFile, OpenChunk
from skinware.recording.topics import EVENTS, SCHEMAS, Channels
from skinware.structure import Structure
from skinware.transfer.generation import Generation

_CHUNK_BYTES = 4 << 20
_BAG_VERSION = 5
"""Of metadata.yaml: that of ROS 2 Humble, which later ones read."""


def write_foxglove(source: Source, path: Path) -> None:
    """Write what viewers show of drivers, at most 30 times a second, and what happened to them.

    Raises:
        ConfigurationError: no driver is in it.
        OSError: it cannot be written.
    """
    viewers = Viewers()
    writer = _Writer(path, "")
    try:
        for event in source.events:
            writer.add(Message(EVENTS, "json", SCHEMAS[EVENTS], json.dumps(event).encode()), event["log_time_ns"])
        for timed in timed_frames(_drivers(source)):
            for message in viewers.messages(timed.service, timed.generation, timed.frame, timed.time_ns):
                writer.add(message, timed.time_ns)
    finally:
        writer.finish()


def viewers_without(source: Source) -> list[str]:
    notes = []
    for table in source.tables:
        structure = table.structure
        if structure is None:
            notes.append(f"{table.name} is left out: it has no sensors")
        elif not Showing(table.service, structure).has_points:
            notes.append(f"{table.name}: no place of a sensor is known: images only, no points")
    return notes


def write_ros2(source: Source, folder: Path) -> None:
    """Write a bag of ROS 2 (rosbag2, storage mcap) into a folder, which is made: every frame, and what viewers show.

    Raises:
        ConfigurationError: no driver is in it.
        OSError: it cannot be written.
    """
    drivers = _drivers(source)
    folder.mkdir()
    name = f"{source.path.stem}_0.mcap"
    viewers = Viewers(json_state=False)
    writer = _Writer(folder / name, "ros2")
    told: set[Generation] = set()
    tables = {generation: table for table in drivers for generation in table.generations}
    try:
        for timed in timed_frames(drivers):
            if timed.generation not in told:
                told.add(timed.generation)
                writer.add(_sensors(timed, tables[timed.generation]), timed.time_ns)
            writer.add(_skin_frame(timed), timed.time_ns)
            for message in viewers.messages(timed.service, timed.generation, timed.frame, timed.time_ns):
                writer.add(message, timed.time_ns)
    finally:
        writer.finish()
    (folder / "metadata.yaml").write_text(writer.metadata(name), encoding="utf-8")


def ros2_without(source: Source) -> list[str]:
    return [*viewers_without(source), "counters, histograms and events are left out: ros2 does not hold them"]


def _drivers(source: Source) -> list[Table]:
    drivers = [table for table in source.tables if table.structure is not None]
    if not drivers:
        raise ConfigurationError(f"{source.path}: no driver is in it, and nothing else can be shown")
    return drivers


def _skin_frame(timed: TimedFrame) -> Message:
    data = skin_messages.skin_frame(DriverSnapshot(timed.generation, timed.frame.slot), timed.time_ns)
    return Message(f"/skin/{in_topic(timed.service)}/frame", "cdr", definitions.SKIN_FRAME, data)


def _sensors(timed: TimedFrame, table: Table) -> Message:
    structure = timed.generation.context
    assert isinstance(structure, Structure)  # noqa: S101, of a driver
    data = skin_messages.sensors(structure, table.sensor_names, timed.generation.generation, timed.time_ns)
    return Message(f"/skin/{in_topic(timed.service)}/sensors", "cdr", definitions.SENSORS, data)


class _Writer:
    """An MCAP file of messages in any order.

    Args:
        path: of the file.
        profile: of it.
    """

    def __init__(self, path: Path, profile: str) -> None:
        self._file = McapFile(path, profile)
        self._channels = Channels()
        self._chunk = OpenChunk()
        self._types: dict[int, tuple[str, str]] = {}
        self._begin_ns, self._end_ns = 1 << 63, 0

    def add(self, message: Message, time_ns: int) -> None:
        channel, schema = self._channels.of(message.topic, message.encoding, message.schema)
        self._types[channel.id] = message.topic, schema.name
        self._begin_ns, self._end_ns = min(self._begin_ns, time_ns), max(self._end_ns, time_ns)
        self._chunk.add(channel, schema, 0, time_ns, message.data)
        if self._chunk.size > _CHUNK_BYTES:
            self._close_chunk()

    def finish(self) -> None:
        try:
            self._close_chunk()
        finally:
            self._file.finish()

    def metadata(self, name: str) -> str:
        """What rosbag2 wants to know of the file, which has that name."""
        begin_ns = min(self._begin_ns, self._end_ns)
        times = [
            ("duration", f"{{nanoseconds: {self._end_ns - begin_ns}}}"),
            ("starting_time", f"{{nanoseconds_since_epoch: {begin_ns}}}"),
            ("message_count", str(self._file.counts.total())),
        ]
        lines = ["rosbag2_bagfile_information:", f"  version: {_BAG_VERSION}", "  storage_identifier: mcap"]
        lines += [f"  {key}: {value}" for key, value in times]
        lines += ["  topics_with_message_count:", *self._topics()]
        lines += [
            '  compression_format: ""',
            '  compression_mode: ""',
            "  relative_file_paths:",
            f"    - {_quoted(name)}",
        ]
        lines += ["  files:", f"    - path: {_quoted(name)}", *(f"      {key}: {value}" for key, value in times[::-1])]
        return "\n".join(lines) + "\n"

    def _topics(self) -> Iterator[str]:
        for channel, (topic, type_name) in self._types.items():
            yield f"    - topic_metadata: {{name: {_quoted(topic)}, type: {_quoted(type_name)},"
            yield '        serialization_format: cdr, offered_qos_profiles: ""}'
            yield f"      message_count: {self._file.counts[channel]}"

    def _close_chunk(self) -> None:
        if not self._chunk.is_empty:
            chunk, self._chunk = self._chunk, OpenChunk()
            self._file.add(chunk.close())


def _quoted(text: str) -> str:
    return json.dumps(text)
