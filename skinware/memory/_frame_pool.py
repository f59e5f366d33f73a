"""Memory for the frames of one reader, or of several at once, used again as soon as nobody has them any more.

New memory for every frame would have to be cleared, and found by a processor whose caches do not have it; with several
readers on a processor that makes the frames of all of them older.
"""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Sequence
from itertools import accumulate
from sys import getrefcount
from typing import Generic

from skinware.memory.ring import RingReader, SampleT

Memory = ctypes.Array[ctypes.c_char]
_Place = tuple[tuple[SampleT, ...], bytearray, Memory]

_COUNTS_COME_LATE = not getattr(sys, "_is_gil_enabled", lambda: True)()  # those of other threads


class FramePool(Generic[SampleT]):
    """Frames to be filled by C: one of each ring, all in one piece of memory. Not for several threads at once.

    Args:
        rings: whose frames.

    Attributes:
        starts: where each frame begins in the memory, bytes.
    """

    def __init__(self, rings: Sequence[RingReader[SampleT]]) -> None:
        *self.starts, self._size = accumulate((ring.frame_size for ring in rings), initial=0)
        self._rings = rings
        self._memory_type = ctypes.c_char * self._size
        self._places = [self._place(), self._place()]  # a loop still has the frames before when it asks for the next
        self._references = _references_of_one if len(rings) == 1 else _references
        self._references_of_nobody = -1 if _COUNTS_COME_LATE else self._references(self._places[0])
        self._turn = 0

    def free(self) -> _Place[SampleT]:
        """Frames that nobody has, their bytes, and the same for calls of C.

        Whoever has a frame has a reference to it or to all of them, and whoever has an array of one, to the bytes.
        """
        self._turn = turn = 1 - self._turn
        place = self._places[turn]
        if self._references(place) != self._references_of_nobody:
            place = self._places[turn] = self._place()
        return place

    def _place(self) -> _Place[SampleT]:
        data = bytearray(self._size)
        frames = tuple([ring.frame_in(data, start) for ring, start in zip(self._rings, self.starts, strict=True)])
        return frames, data, self._memory_type.from_buffer(data)


def _references_of_one(place: _Place[SampleT]) -> int:
    """The same where there is one frame, in as few steps as can be: a loop asks in every turn."""
    frames, data, _ = place
    return getrefcount(frames) + getrefcount(data) + getrefcount(frames[0])


def _references(place: _Place[SampleT]) -> int:
    """How many there are to the frames of a place and to its bytes."""
    frames, data, _ = place
    return getrefcount(frames) + getrefcount(data) + sum(map(getrefcount, frames))
