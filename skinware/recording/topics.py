"""The channels of a recording: their names, encodings and schemas."""

from __future__ import annotations

import json

from mcap.records import Channel, Schema

FORMAT = 1
ENCODING = f"skinware/{FORMAT}"
"""Encoding of samples and generations. A file with a higher number needs a newer version of this package."""
_FAMILY = "skinware/"
FRAME, GENERATION = "frame", "generation"
EVENTS, CLOCK = "/skin/events", "/skin/clock"
WIRE, ABOUT = "wire", "about"
WIRE_ENCODING = "skinware-wire/1"
"""Encoding of the frames and bytes of a wire."""

_EVENT = {
    "type": "object",
    "properties": {
        "event": {"type": "string", "description": "found, live, ... see Recordings in the documentation"},
        "service": {"type": "string"},
        "time_ns": {"type": "integer", "description": "CLOCK_MONOTONIC"},
        "count": {"type": "integer", "description": "missed: how many samples"},
        "before": {"type": "integer", "description": "missed: sequence of the sample after them"},
        "why": {"type": "string", "description": "unreadable: the reason"},
        "text": {"type": "string", "description": "mark: what a person marked"},
        "for_ns": {"type": "integer", "description": "suspended: for how long"},
        "by_ns": {"type": "integer", "description": "clock_stepped: by how much"},
    },
}
_CLOCK = {
    "type": "object",
    "properties": {
        "monotonic_ns": {"type": "integer", "description": "CLOCK_MONOTONIC, the time of frames"},
        "realtime_ns": {"type": "integer", "description": "CLOCK_REALTIME at the same moment"},
        "boottime_ns": {"type": "integer", "description": "CLOCK_BOOTTIME: monotonic_ns plus suspended time"},
        "boot": {"type": "string", "description": "identifies the start of the machine from which monotonic_ns counts"},
    },
}
_ABOUT = {
    "type": "object",
    "properties": {
        "driver_type": {"type": "string", "description": "as --driver takes it"},
        "listen_only": {"type": "boolean"},
        "versions": {"type": "object", "description": "versions of the programs that ran"},
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
What went over a wire: u8 generation, u8 sequence, i8 published_ns, u8 missed, little-endian; then pieces: u4 size,
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
    def __init__(self) -> None:
        self._channels: dict[str, Channel] = {}

    def of_service(self, name: str, what: str) -> tuple[Channel, Schema]:
        return self.of(f"/skin/{name}/{what}", ENCODING, SCHEMAS[what])

    def of_all(self, topic: str) -> tuple[Channel, Schema]:
        return self.of(topic, "json", SCHEMAS[topic])

    def of_wire(self, driver: str, bus: str) -> tuple[Channel, Schema]:
        return self.of(f"/wire/{driver}/{bus}", WIRE_ENCODING, SCHEMAS[WIRE], {"driver": driver, "bus": bus})

    def of_about(self, driver: str) -> tuple[Channel, Schema]:
        return self.of(f"/wire/{driver}", "json", SCHEMAS[ABOUT], {"driver": driver})

    def names(self) -> dict[int, str]:
        return {channel.id: topic for topic, channel in self._channels.items()}

    def of(
        self, topic: str, encoding: str, schema: Schema, metadata: dict[str, str] | None = None
    ) -> tuple[Channel, Schema]:
        channel = self._channels.get(topic)
        if channel is None:
            channel = Channel(len(self._channels) + 1, topic, encoding, metadata or {}, schema.id)
            self._channels[topic] = channel
        return channel, schema


def service_of(channel: Channel) -> tuple[str, str] | None:
    """Return (service, ``frame`` or ``generation``); None for a channel of another kind."""
    parts = channel.topic.split("/")
    if channel.message_encoding != ENCODING or len(parts) != 4 or parts[3] not in (FRAME, GENERATION):
        return None
    return parts[2], parts[3]


def wire_of(channel: Channel) -> tuple[str, str] | None:
    """Return (driver, bus) of a wire; None for a channel of another kind."""
    names = channel.metadata
    is_wire = channel.message_encoding == WIRE_ENCODING and "driver" in names and "bus" in names
    return (names["driver"], names["bus"]) if is_wire else None


def about_of(channel: Channel) -> str | None:
    """Return the driver that describes itself in a channel; None for a channel of another kind."""
    driver = channel.metadata.get("driver", "")
    return driver if driver and channel.topic == f"/wire/{driver}" else None


def newer_format(channel: Channel) -> str | None:
    """Return the encoding of a channel that needs a newer version of this package, or None."""
    encoding = channel.message_encoding
    number = encoding.removeprefix(_FAMILY)
    return encoding if encoding.startswith(_FAMILY) and number.isdigit() and int(number) > FORMAT else None
