"""The channels of a recording: their names, encodings and schemas."""

from __future__ import annotations

import json

from mcap.records import Channel, Schema

FORMAT = 1
ENCODING = f"skinware/{FORMAT}"
"""Of messages with frames and with generations. A file with a higher number needs a newer version of this package."""
_FAMILY = "skinware/"
FRAME, GENERATION = "frame", "generation"
EVENTS, CLOCK = "/skin/events", "/skin/clock"
WIRE, ABOUT = "wire", "about"
WIRE_ENCODING = "skinware-wire/1"
"""Of messages with what went over a wire."""

_EVENT = {
    "type": "object",
    "properties": {
        "event": {"type": "string", "description": "found, live, ... see Recordings in the documentation"},
        "service": {"type": "string"},
        "time_ns": {"type": "integer", "description": "CLOCK_MONOTONIC"},
        "count": {"type": "integer", "description": "of lost: how many frames"},
        "before": {"type": "integer", "description": "of lost: sequence of the frame after them"},
        "why": {"type": "string", "description": "of unreadable"},
        "for_ns": {"type": "integer", "description": "of suspended: how long the machine was"},
        "by_ns": {"type": "integer", "description": "of clock_stepped: by how much the wall clock was set"},
    },
}
_CLOCK = {
    "type": "object",
    "properties": {
        "monotonic_ns": {"type": "integer", "description": "CLOCK_MONOTONIC, the time of frames"},
        "realtime_ns": {"type": "integer", "description": "CLOCK_REALTIME at the same moment"},
        "boottime_ns": {"type": "integer", "description": "CLOCK_BOOTTIME, likewise: monotonic_ns and suspended time"},
        "boot": {"type": "string", "description": "which start of the machine the first one counts from"},
    },
}
_ABOUT = {
    "type": "object",
    "properties": {
        "driver_type": {"type": "string", "description": "as --driver takes it"},
        "listen_only": {"type": "boolean"},
        "versions": {"type": "object", "description": "of the programs that ran"},
        "buses": {
            "type": "object",
            "description": "by name: medium, and the options of the driver for it",
        },
    },
}
_FRAME_TEXT = b"""\
One frame: u8 generation, u8 sequence, i8 acquired_ns, i8 published_ns, u8 flags, u8 after, little-endian; a byte for
each column, how it is coded; u4 of each, its size; what changed in each since frame `after`."""
_WIRE_TEXT = b"""\
What went over a wire: u8 generation, u8 sequence, i8 published_ns, u8 lost, little-endian; then pieces: u4 size,
u4 count, u1 form (1: struct can_frame, 2: struct canfd_frame, 3: bytes), u1 is_sent, 6 bytes; i8 time_ns of each frame,
or one of all bytes; the frames, or bytes up to a multiple of 8."""
_GENERATION_TEXT = b"""\
The file of a service in shared memory (version 1.0), up to its slots: header, column table, static columns."""

SCHEMAS = {
    FRAME: Schema(1, _FRAME_TEXT, ENCODING, "skinware.Frame"),
    GENERATION: Schema(2, _GENERATION_TEXT, ENCODING, "skinware.Generation"),
    EVENTS: Schema(3, json.dumps(_EVENT).encode(), "jsonschema", "skinware.Event"),
    CLOCK: Schema(4, json.dumps(_CLOCK).encode(), "jsonschema", "skinware.Clock"),
    WIRE: Schema(5, _WIRE_TEXT, WIRE_ENCODING, "skinware.Wire"),
    ABOUT: Schema(6, json.dumps(_ABOUT).encode(), "jsonschema", "skinware.About"),
}


class Channels:
    """The channels of a file, numbered as they are needed."""

    def __init__(self) -> None:
        self._channels: dict[str, Channel] = {}

    def of_service(self, name: str, what: str) -> tuple[Channel, Schema]:
        """The channel of a service's frames, or of its generations."""
        return self.of(f"/skin/{name}/{what}", ENCODING, SCHEMAS[what])

    def of_all(self, topic: str) -> tuple[Channel, Schema]:
        return self.of(topic, "json", SCHEMAS[topic])

    def of_wire(self, driver: str, bus: str) -> tuple[Channel, Schema]:
        return self.of(f"/wire/{driver}/{bus}", WIRE_ENCODING, SCHEMAS[WIRE], {"driver": driver, "bus": bus})

    def of_about(self, driver: str) -> tuple[Channel, Schema]:
        """The channel of what a driver says of itself beside its wires."""
        return self.of(f"/wire/{driver}", "json", SCHEMAS[ABOUT], {"driver": driver})

    def names(self) -> dict[int, str]:
        return {channel.id: topic for topic, channel in self._channels.items()}

    def of(
        self, topic: str, encoding: str, schema: Schema, metadata: dict[str, str] | None = None
    ) -> tuple[Channel, Schema]:
        """The channel of a topic; the schema is given back."""
        channel = self._channels.get(topic)
        if channel is None:
            channel = Channel(len(self._channels) + 1, topic, encoding, metadata or {}, schema.id)
            self._channels[topic] = channel
        return channel, schema


def service_of(channel: Channel) -> tuple[str, str] | None:
    """(name of the service, what of it) of a channel of ours; None of any other."""
    parts = channel.topic.split("/")
    if channel.message_encoding != ENCODING or len(parts) != 4 or parts[3] not in (FRAME, GENERATION):
        return None
    return parts[2], parts[3]


def wire_of(channel: Channel) -> tuple[str, str] | None:
    """(driver, name of its bus) of a channel with what went over a wire; None of any other."""
    told = channel.metadata
    is_wire = channel.message_encoding == WIRE_ENCODING and "driver" in told and "bus" in told
    return (told["driver"], told["bus"]) if is_wire else None


def about_of(channel: Channel) -> str | None:
    """The driver of a channel with what it says of itself beside its wires; None of any other."""
    driver = channel.metadata.get("driver", "")
    return driver if driver and channel.topic == f"/wire/{driver}" else None


def newer_format(channel: Channel) -> str | None:
    """The encoding of a channel that needs a newer version of this package; None of any other."""
    encoding = channel.message_encoding
    number = encoding.removeprefix(_FAMILY)
    return encoding if encoding.startswith(_FAMILY) and number.isdigit() and int(number) > FORMAT else None
