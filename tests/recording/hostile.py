"""Recordings whose checksums fit and whose contents are hostile. tools/fuzz makes more of them."""

from __future__ import annotations

import contextlib
import random
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import skinware.recording
from skinware.errors import SkinwareError
from skinware.recording.files import recover
from skinware.recording.mcap_reading import McapSource
from skinware.recording.mcap_writing import McapFile, OpenChunk
from skinware.recording.topics import GENERATION

_ODD = (0, 1, 0xFF, 0xFFFF, 0x7FFF_FFFF, 0xFFFF_FFFF, (1 << 62) - 1, 1 << 62, (1 << 63) - 1, 1 << 63, (1 << 64) - 1)
_TEXTS = (b"[" * 5000, b'{"a":' * 5000, b'"x"', b"1e400", b"NaN", b"-1", b"null", b"9" * 400, b"{}", b'"\\ud800"')


class _Message(NamedTuple):
    channel: int
    sequence: int
    time_ns: int
    data: bytes


class Forger:
    """Makes recordings like one, in which some messages are others.

    Args:
        file: the recording.
        most: chunks of it that are taken.
    """

    def __init__(self, file: Path, most: int = 6) -> None:
        with McapSource(file) as source:
            contents = [source.contents(place) for place in source.chunks[:most]]
        self._channels = {number: channel for each in contents for number, channel in each.channels.items()}
        self._schemas = {number: schema for each in contents for number, schema in each.schemas.items()}
        self._chunks = [
            [_Message(each.channel_id, each.sequence, each.time_ns, bytes(each.data)) for each in one.messages]
            for one in contents
        ]

    def forge(self, generator: random.Random, path: Path) -> None:
        """Write another one.

        Args:
            generator: decides what is other in it.
            path: of the file, which is replaced.
        """
        path.unlink(missing_ok=True)
        file = McapFile(path)
        share = generator.choice((0.02, 0.1, 0.5))
        heads = generator.random() < 0.3
        for messages in self._chunks:
            chunk = OpenChunk()
            for message in messages:
                channel = self._channels[message.channel]
                is_head = channel.topic.endswith(f"/{GENERATION}")
                if generator.random() < share or (is_head and heads):
                    message = _forged(message, generator, is_json=channel.message_encoding == "json")
                schema = self._schemas[channel.schema_id]
                chunk.add(channel, schema, message.sequence, message.time_ns, message.data)
            if not chunk.is_empty:
                file.add(chunk.close())
        file.finish()


def _forged(message: _Message, generator: random.Random, *, is_json: bool) -> _Message:
    if generator.random() < 0.1:
        return message._replace(time_ns=generator.choice([*_ODD, max(0, message.time_ns - 10**12)]))
    if is_json:
        return message._replace(data=_other_json(message.data, generator))
    data = message.data
    for _ in range(generator.choice((1, 1, 2, 5))):
        data = _other_bytes(data, generator)
    return message._replace(data=data)


def _other_json(text: bytes, generator: random.Random) -> bytes:
    value = generator.choice(_TEXTS)
    colons = [place for place, byte in enumerate(text) if byte == ord(":")]
    if not colons or generator.random() < 0.3:
        return value
    begin = generator.choice(colons) + 1
    ends = [place for place in range(begin, len(text)) if text[place] in b",}"]
    return text[:begin] + value + text[ends[0] if ends else len(text) :]


def _other_bytes(data: bytes, generator: random.Random) -> bytes:
    """Bytes that differ in a bit, a number, or their length; more often near the beginning, where numbers are."""
    if not data:
        return data
    at = generator.randrange(min(len(data), generator.choice((64, 1024, len(data)))))
    match generator.randrange(5):
        case 0:
            return data[:at] + bytes([data[at] ^ 1 << generator.randrange(8)]) + data[at + 1 :]
        case 1:
            width = generator.choice((1, 2, 4, 8))
            number = generator.choice(_ODD) & ((1 << 8 * width) - 1)
            at -= at % width
            return data[:at] + number.to_bytes(width, "little") + data[at + width :]
        case 2:
            return data[:at]
        case 3:
            return data[:at] + bytes(generator.randrange(1, 64)) + data[at:]
        case _:
            return data[:at] + data[at + generator.randrange(1, 32) :]


def use(file: Path, beside: Path) -> Sequence[str]:
    """Read everything of a recording in every way; what is wrong with it, as it says.

    Args:
        file: the recording.
        beside: a file that is made of it, and removed.
    """
    try:
        with skinware.recording.open(file) as opened:
            _read(opened)
            problems = opened.problems
    except SkinwareError as error:
        return [str(error)]
    with contextlib.suppress(SkinwareError):
        recover(file, beside)
    beside.unlink(missing_ok=True)
    return problems


def _read(opened: skinware.recording.Recording) -> None:
    assert opened.missed >= 0
    assert all(isinstance(event["time_s"], float) for event in [*opened.events, *opened.clock])
    for name in opened.services:
        for part in opened[name].parts:
            list(part.samples())
            part.read()
    for snapshot in opened.snapshots():
        for sensor_type in {kind.name for structure in snapshot.layout.structures for kind in structure.types}:
            snapshot.physical(sensor_type)
            snapshot.fresh(sensor_type)
    timeline = opened.timeline()
    timeline.seek(opened.duration_s / 2)
    timeline.back()
    timeline.so_far(opened.services)
    for wire in opened.wires:
        wire.frames()
        list(wire.items())
        assert wire.missed >= 0
    for driver in opened.drivers:
        opened.about(driver)
