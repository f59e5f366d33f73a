"""Memory for the frames of one reader, used again as soon as nobody has the frame any more.

New memory for every frame would have to be cleared, and found by a processor whose caches do not have it; with several
readers on a processor that makes the frames of all of them older.
"""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Callable
from sys import getrefcount
from types import SimpleNamespace
from typing import Any, Generic, cast

from skinware.memory.ring import Frame, FrameT

Memory = ctypes.Array[ctypes.c_char]
_Place = tuple[FrameT, bytearray, Memory]


class FramePool(Generic[FrameT]):
    """Frames to be filled by C. Not for several threads at once.

    Args:
        make: makes a frame in memory.
        size: bytes of a frame.
    """

    def __init__(self, make: Callable[[bytearray], FrameT], size: int) -> None:
        self._make, self._size = make, size
        self._memory_type = ctypes.c_char * size
        self._places = [self._place(), self._place()]  # a loop still has the frame before when it asks for the next
        self._turn = 0

    def free(self) -> _Place[FrameT]:
        """A frame that nobody has, its bytes, and the same for calls of C.

        Whoever has a frame has a reference to it, and whoever has an array of it one to its bytes.
        """
        self._turn = turn = 1 - self._turn
        place = self._places[turn]
        if getrefcount(place[0]) > _FRAME_ALONE or getrefcount(place[1]) > _BYTES_ALONE:
            place = self._places[turn] = self._place()
        return place

    def _place(self) -> _Place[FrameT]:
        data = bytearray(self._size)
        return self._make(data), data, self._memory_type.from_buffer(data)


def _alone() -> tuple[int, int]:
    """What ``getrefcount`` says of a frame and of its bytes that only a pool has."""
    if not getattr(sys, "_is_gil_enabled", lambda: True)():
        return 0, 0  # counts of other threads come late: nothing is used again
    ring = cast(Any, SimpleNamespace(columns={}, context=None, generation=0, period_ns=0))
    place = FramePool(lambda data: Frame(ring, data), 64)._places[0]  # noqa: SLF001
    return getrefcount(place[0]), getrefcount(place[1])


_FRAME_ALONE, _BYTES_ALONE = _alone()
