"""Messages of XELA's server: JSON, one message a line; taken apart into one frame for each sensor.

A frame has the number of its sensor as identifier, and as body the time in ms u32, then x, y and z of each taxel,
float32, all little-endian. Where the server tells forces they are these; where it does not, the raw counts, and the
identifier has the bit ``RAW``. Whenever a sensor is new, or is not what it was, and now and then, a frame with the
identifier 0 tells all that were seen so far, as JSON: ``{number: [model, taxels, whether forces are told]}``.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass, field
from typing import Any

import msgspec

from skinware_drivers.serial.framing import Framed, Framer, Framing

MOST_TAXELS = 1024
MOST_SENSORS = 128
RAW = 0x400
_AXES = 3
_MOST_TEXT = 64
_LONGEST = 1 << 17
_TELL_EVERY = 256
_U16 = 0xFFFF
_U32 = 0xFFFF_FFFF

Seen = dict[str, tuple[str, int, bool]]
"""By number of the sensor: model, taxels, whether it tells forces."""


@dataclass(frozen=True)
class XelaMessages(Framing):
    """The framing; only to be received."""

    maximum_body: int = field(default=4 + 4 * _AXES * MOST_TAXELS, init=False)

    def framer(self) -> Framer:
        return _Messages()

    def encode(self, identifier: int, payload: bytes) -> bytes:
        """Refuse: the server is told nothing.

        Raises:
            ValueError: always.
        """
        raise ValueError(f"XELA's server is only read ({identifier:#x}, {len(payload)} bytes)")


class _Messages(Framer):
    def __init__(self) -> None:
        super().__init__()
        self._seen: Seen = {}
        self._untold = 0  # messages since it was last told what was seen

    def _find(self, stream: bytes) -> tuple[list[Framed], int]:
        *lines, rest = stream.split(b"\n")
        found: list[Framed] = []
        done = 0
        for line in lines:
            done += len(line) + 1
            self._count(line, self._take_apart(line, self._before + done, found))
        if len(rest) > _LONGEST:  # no message, and nothing to hold back
            self.counters.refused += 1
            self.counters.skipped_bytes += len(rest)
            done = len(stream)
        return found, done

    def _count(self, line: bytes, is_good: bool | None) -> None:
        """Every byte of a line, once: of a message with values, of one without, or of none."""
        counters = self.counters
        if is_good:
            counters.frame_bytes += len(line) + 1
        elif is_good is None:
            counters.idle_bytes += len(line) + 1
        else:
            counters.refused += 1
            counters.skipped_bytes += len(line) + 1

    def _take_apart(self, line: bytes, end: int, found: list[Framed]) -> bool | None:
        """Find the frames of a message; None: it is in order and has no sensor, as the first one of a connection."""
        try:
            message = msgspec.json.decode(line)
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
            return False
        if not isinstance(message, dict):
            return False
        numbers = [key for key in message if key.isascii() and key.isdecimal()]
        if not numbers:
            return None if "message" in message else False
        if len(numbers) > MOST_SENSORS:
            return False
        frames, is_news, is_good = [], False, True
        for number in numbers:
            sensor = _sensor(number, message[number], message.get("time"))
            if sensor is None:
                is_good = False
                continue
            identifier, seen, body = sensor
            frames.append(Framed(identifier, body, end))
            if self._seen.get(number) != seen:
                is_news, self._seen[number] = True, seen
        self._untold += 1
        if frames and (is_news or self._untold >= _TELL_EVERY) and len(self._seen) <= MOST_SENSORS:
            self._untold = 0
            found.append(Framed(0, msgspec.json.encode(self._seen), end))
        found += frames
        return is_good or bool(frames)


def _sensor(key: str, sensor: Any, time: Any) -> tuple[int, tuple[str, int, bool], bytes] | None:
    """Identifier, what the sensor is, and body; None if it makes no sense."""
    if not isinstance(sensor, dict) or not 1 <= (number := int(key[:9])) <= 255 or key != str(number):
        return None
    model, taxels, time = sensor.get("model"), sensor.get("taxels"), sensor.get("time", time)
    if not isinstance(model, str) or len(model) > _MOST_TEXT or not isinstance(time, int | float):
        return None
    if type(taxels) is not int or not 1 <= taxels <= MOST_TAXELS or not math.isfinite(time):
        return None
    forces = sensor.get("calibrated")
    values = forces or _counts(sensor)
    if not isinstance(values, list) or len(values) != _AXES * taxels:
        return None
    try:
        body = struct.pack(f"<I{len(values)}f", int(time * 1e3) & _U32, *values)
    except (struct.error, OverflowError, TypeError):
        return None
    return number | (0 if forces else RAW), (model, taxels, bool(forces)), body


def _counts(sensor: dict[str, Any]) -> list[int] | None:
    """Raw counts: hexadecimal numbers with commas between them, or (newer servers also) a list."""
    data = sensor.get("data")
    try:
        values = [int(text, 16) for text in data.split(",")] if isinstance(data, str) else sensor.get("integer")
        fit = values is not None and all(type(value) is int and 0 <= value <= _U16 for value in values)
    except (TypeError, ValueError):
        return None
    return values if fit else None
