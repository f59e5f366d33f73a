"""What a YARP port says in its text carrier: lines that begin with ``d``, and lines of numbers; taken apart by twelve.

Source: YARP's manual, "YARP without YARP". The first line is ``d``, ``do`` or ``D``, by itself or with an envelope:
the number of the message and its time in seconds since 1970. The second is a list in text. A port of a skin sends the
numbers of a vector, with spaces between them; whatever else can stand in a list is refused. ``Welcome`` comes once.

The values of a message become frames of twelve, as triangles of a skin have them; the last one is filled up with 0.
A frame's identifier is ``kind << 8 | number``, where ``number`` is what the driver calls these twelve. Its body is the
sender's time in ms u32 and twelve float32, little-endian; of the kind ``PLAIN`` there was no time, and it is 0. A frame
of the kind ``LENGTH`` (number 0) tells how many values messages have, u32: now and then, and when three in a row had
another number than it knows of.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from skinware_drivers.serial.framing import Framed, Framer, Framing

LENGTH, PLAIN, TIMED = 0, 1, 2
"""Kinds of frames."""
VALUES_OF_A_FRAME = 12
MOST_VALUES = 3072
"""Of a message: sixteen boards of sixteen triangles."""
LONGEST_LINE = 1 << 16
_HEAD = re.compile(rb"[dD][oO]?(?:[ \t](?P<envelope>.*))?")
_ENVELOPE = re.compile(rb"\s*\d{1,10}\s+(?P<time>\d{1,11}(?:\.\d{1,9})?)\s*")
_NUMBERS = re.compile(rb"[0-9eEinfaINFA+. \t-]+")
"""What numbers are made of; ``float`` takes more than YARP writes, as 1_0."""
_SURE = 3
_TELL_EVERY = 64
_U32 = 0xFFFF_FFFF


@dataclass(frozen=True)
class YarpText(Framing):
    """The framing; only to be received.

    Args:
        length: values of a message; others are refused. 0: not known yet, so that there are frames ``LENGTH`` only.
        parts: (number, first value) of each twelve values that matter.
    """

    length: int = 0
    parts: tuple[tuple[int, int], ...] = ()
    maximum_body: int = field(default=4 + 4 * VALUES_OF_A_FRAME, init=False)

    def framer(self) -> Framer:
        """Takes messages apart."""
        return _Messages(self)

    def encode(self, identifier: int, payload: bytes) -> bytes:
        """Refuse: the port is told nothing.

        Raises:
            ValueError: always.
        """
        raise ValueError(f"a YARP port is only read ({identifier:#x}, {len(payload)} bytes)")


class _Messages(Framer):
    def __init__(self, framing: YarpText) -> None:
        super().__init__()
        self._length, self._parts = framing.length, framing.parts
        self._head: bytes | None = None  # the envelope, once the first line of a message has come
        self._is_cut = False  # the line is too long, and was given up
        self._last, self._times = 0, 0  # values of the last message, and of how many before it

    def _find(self, stream: bytes) -> tuple[list[Framed], int]:
        *lines, rest = stream.split(b"\n")
        found: list[Framed] = []
        done = 0
        for line in lines:
            done += len(line) + 1
            self._take(line, self._before + done, found)
        if len(rest) > LONGEST_LINE:  # no message, and nothing to hold back
            self._refuse(len(rest))
            self._is_cut = True
            done = len(stream)
        return found, done

    def _take(self, line: bytes, end: int, found: list[Framed]) -> None:
        """Count every byte of a line, once: of values, of what stands around them, or of neither."""
        counters, text = self.counters, line.strip()
        if self._is_cut:
            self._is_cut = False
            counters.skipped_bytes += len(line) + 1
        elif head := _HEAD.fullmatch(text):
            counters.refused += self._head is not None  # a message without values
            self._head = head["envelope"] or b""
            counters.idle_bytes += len(line) + 1
        elif self._head is None:
            if text and not text.startswith(b"Welcome "):
                self._refuse(len(line) + 1)
            else:
                counters.idle_bytes += len(line) + 1
        else:
            values, envelope = _values(text), self._head
            self._head = None
            if values is not None and self._fits(values, end, found):
                counters.frame_bytes += len(line) + 1
                self._cut_up(values, envelope, end, found)
            else:
                self._refuse(len(line) + 1)

    def _refuse(self, size: int) -> None:
        self._head = None
        self.counters.refused += 1
        self.counters.skipped_bytes += size

    def _fits(self, values: npt.NDArray[np.float32], end: int, found: list[Framed]) -> bool:
        """Whether a message has as many values as it should have; tells now and then how many it has."""
        self._times = self._times + 1 if len(values) == self._last else 1
        self._last = len(values)
        if self._times % _TELL_EVERY == (0 if len(values) == self._length else _SURE):
            found.append(Framed(LENGTH << 8, len(values).to_bytes(4, "little"), end))
        return self._length in (0, len(values))

    def _cut_up(self, values: npt.NDArray[np.float32], envelope: bytes, end: int, found: list[Framed]) -> None:
        if not self._parts:
            return
        time_ms = _time_ms(envelope)
        kind, stamp = (PLAIN, bytes(4)) if time_ms is None else (TIMED, time_ms.to_bytes(4, "little"))
        filled = values.tobytes().ljust(-(-len(values) // VALUES_OF_A_FRAME) * 4 * VALUES_OF_A_FRAME, b"\0")
        for number, first in self._parts:
            body = stamp + filled[4 * first : 4 * (first + VALUES_OF_A_FRAME)]
            found.append(Framed(kind << 8 | number, body, end))


def _values(text: bytes) -> npt.NDArray[np.float32] | None:
    """The numbers of a line; None if it is none of numbers, or of more than a skin has."""
    if not _NUMBERS.fullmatch(text):
        return None
    words = text.split()
    if not 1 <= len(words) <= MOST_VALUES:
        return None
    try:
        with np.errstate(over="ignore"):
            return np.array([float(word) for word in words]).astype("<f4")
    except ValueError:
        return None


def _time_ms(envelope: bytes) -> int | None:
    """When a message was sent, as far as 32 bits hold it; None if it does not say, or says 0."""
    match = _ENVELOPE.fullmatch(envelope)
    if match is None:
        return None
    return int(float(match["time"]) * 1e3) & _U32 or None


__all__ = ["LENGTH", "LONGEST_LINE", "MOST_VALUES", "PLAIN", "TIMED", "VALUES_OF_A_FRAME", "YarpText"]
