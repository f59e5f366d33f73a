"""Frames that tell of several modules at once, divided into a frame for each: a layout's frame is of one module."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from skinware_drivers.serial.framing import Framed

_MOST_OF_A_STRANGER = 64
"""Bytes of a frame that is not divided, which are enough to see what it is."""


@dataclass(frozen=True)
class Part:
    """What is of one module.

    Attributes:
        identifier: of the frame that it becomes.
        start: its first byte in the body of the whole frame.
        stop: one past its last.
    """

    identifier: int
    start: int
    stop: int


@dataclass(frozen=True)
class Parts:
    """How the bodies of one kind of frame are divided.

    Attributes:
        whole: identifier of these frames.
        size: bytes of their bodies.
        parts: one for each module.
        shared: so many bytes at the beginning of the body come first in every part, too.
        strange: identifier under which frames of another size are handed on: cut to 64 bytes, but not divided.
    """

    whole: int
    size: int
    parts: tuple[Part, ...]
    shared: int
    strange: int

    def of(self, frames: Iterable[Framed]) -> list[Framed]:
        """The parts of these frames, and the frames that are of another kind, in the order of the stream."""
        found: list[Framed] = []
        for frame in frames:
            if frame.identifier != self.whole:
                found.append(frame)
            elif len(frame.body) != self.size:
                found.append(Framed(self.strange, frame.body[:_MOST_OF_A_STRANGER], frame.end))
            else:
                body, shared = frame.body, frame.body[: self.shared]
                found += [Framed(p.identifier, shared + body[p.start : p.stop], frame.end) for p in self.parts]
        return found


__all__ = ["Part", "Parts"]
