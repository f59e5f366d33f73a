"""Take samples of one ring or several in C: one call looks, sleeps and copies, as long as nothing but samples comes."""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Sequence
from itertools import accumulate
from sys import getrefcount
from typing import TYPE_CHECKING, Generic, NamedTuple

from skinware import native
from skinware.memory import futex
from skinware.memory.ring import LATEST, SampleT
from skinware.memory.segments import Segment

if TYPE_CHECKING:
    from skinware.memory.ring_reader import RingReader

_take_now = native.core().quick.skinware_native_take_now
_take_next = native.core().waiting.skinware_native_take_next

NEWEST, NEWER, NEXT = 0, 1, 2
"""Kinds of takes: the newest sample, even if it was taken before; a newer one; or the next one in order."""
_NEWS, _NO_NEWS = 1, 0  # what take.c returns
_NEVER_NS = (1 << 63) - 1
_COUNTS_COME_LATE = not getattr(sys, "_is_gil_enabled", lambda: True)()  # those of other threads

Memory = ctypes.Array[ctypes.c_char]
_Place = tuple[tuple[SampleT, ...], bytearray, Memory]


class Turn(NamedTuple):
    """One turn of a loop that takes samples.

    Attributes:
        cpu_ns: CPU time of the thread at the end; 0 if it was not asked for.
    """

    acquired_ns: int
    taken_ns: int
    ended_ns: int
    cpu_ns: int


class RingWords(ctypes.Structure):
    """``skinware__ring`` of skinware.h, with which the structures of readers and writers begin."""

    _fields_ = [
        ("map", ctypes.c_void_p),
        ("slot_offset", ctypes.c_uint64),
        ("slot_stride", ctypes.c_uint64),
        ("slot_count", ctypes.c_uint64),
    ]

    @classmethod
    def of(cls, segment: Segment) -> RingWords:
        layout = segment.layout
        return cls(segment.data.ctypes.data, layout.slot_offset, layout.slot_stride, layout.slot_count)


class ReaderState(RingWords):
    """``skinware_native_reader`` of take.c."""

    _fields_ = [
        ("last", ctypes.c_uint64),
        ("descriptor", ctypes.c_int64),
        ("writer", ctypes.c_int64),
        ("frames", ctypes.c_uint64),
        ("missed", ctypes.c_uint64),
        ("acquired_ns", ctypes.c_int64),
        ("taken_ns", ctypes.c_int64),
        ("noted", ctypes.c_uint64),
        ("turns", (ctypes.c_int64 * 4) * 256),
    ]


class ReaderPlace(ctypes.Structure):
    """``place`` of take.c."""

    _fields_ = [("reader", ctypes.c_void_p), ("start", ctypes.c_uint64)]


class TakeState(ctypes.Structure):
    """``skinware_native_take`` of take.c."""

    _fields_ = [
        ("count", ctypes.c_uint64),
        ("is_loop", ctypes.c_uint64),
        ("wanted", ctypes.c_uint64),
        ("timeout_ns", ctypes.c_int64),
        ("until_ns", ctypes.c_int64),
        ("begun_ns", ctypes.c_int64),
        ("asked_ns", ctypes.c_int64),
        ("process", ctypes.c_int64),
        ("places", ReaderPlace * futex.MAX_WORDS),
        ("words", (ctypes.c_uint64 * 3) * futex.MAX_WORDS),
    ]


class FramePool(Generic[SampleT]):
    """Samples to be filled by C: one of each ring, all in one piece of memory. Not for several threads at once.

    Attributes:
        starts: where each sample begins in the memory, bytes.
    """

    def __init__(self, rings: Sequence[RingReader[SampleT]]) -> None:
        *self.starts, self._size = accumulate((ring.segment.layout.slot_stride for ring in rings), initial=0)
        self._rings = rings
        self._memory_type = ctypes.c_char * self._size
        self._places = [self._place(), self._place()]  # a loop still has the one before when it asks for the next
        self._unused = -1 if _COUNTS_COME_LATE else None  # references to a place that is not in use
        self._turn = 0

    def free(self) -> _Place[SampleT]:
        """Return samples that nothing refers to, their bytes, and the same for calls of C.

        A user of a sample has a reference to it or to all of them; a user of an array of it, to the bytes.
        """
        self._turn = turn = 1 - self._turn
        place = self._places[turn]
        frames, data, _ = place
        references = getrefcount(frames) + getrefcount(data)
        for frame in frames:
            references += getrefcount(frame)
        if references != self._unused:
            if self._unused is None:  # the first call
                self._unused = references
            else:
                place = self._places[turn] = self._place()
        return place

    def _place(self) -> _Place[SampleT]:
        data = bytearray(self._size)
        frames = tuple([ring.frame_in(data, start) for ring, start in zip(self._rings, self.starts, strict=True)])
        return frames, data, self._memory_type.from_buffer(data)


class Take(Generic[SampleT]):
    """Take the samples of some rings, whose readers have left their turns to C.

    Args:
        rings: 1 to :data:`skinware.memory.futex.MAX_WORDS`.
        is_loop: it is the loop of one reader, whose turn ends with the next call.
    """

    def __init__(self, rings: Sequence[RingReader[SampleT]], pool: FramePool[SampleT], *, is_loop: bool) -> None:
        self.rings = rings
        self._pool = pool
        self._state_of_one = rings[0].state_in_c if is_loop else None
        self._words = rings[0].words
        self._state = TakeState(len(rings), is_loop, NEWER, 0, _NEVER_NS, 0, 0, os.getpid())
        self._state_at = ctypes.byref(self._state)
        self._wanted, self._timeout_ns = NEWER, 0
        for place, ring, start in zip(self._state.places, rings, pool.starts, strict=False):
            place.reader, place.start = ctypes.addressof(ring.state_in_c), start

    @property
    def begun_ns(self) -> int:
        """When the last ``next`` began, CLOCK_MONOTONIC ns."""
        return int(self._state.begun_ns)

    def leave_until(self, until_ns: int) -> None:
        """Set when Python has something to do at the latest, CLOCK_MONOTONIC ns."""
        self._state.until_ns = until_ns

    def next(self, wanted: int, timeout_ns: int) -> tuple[SampleT, ...] | None:
        """Return one sample of every ring, each a private copy.

        The call lets go of the interpreter lock only if it has to sleep: other threads may keep the lock for long.

        Args:
            wanted: ``NEWEST``, ``NEWER`` or ``NEXT``.
            timeout_ns: longest wait for something newer; 0 or less: do not wait. It may be shorter.

        Returns:
            () if there is nothing new; None if Python has something else to do, and nothing was taken.
        """
        frames, _, memory = self._pool.free()
        for frame in frames:
            frame.stale = False
        if wanted != self._wanted or timeout_ns != self._timeout_ns:
            self._wanted = self._state.wanted = wanted
            self._timeout_ns = self._state.timeout_ns = timeout_ns
        one = self._state_of_one
        if one is not None and self._words[LATEST] == one.last:
            result = _NO_NEWS
        else:
            result = _take_now(self._state_at, memory)
        if result == _NO_NEWS and timeout_ns > 0:
            result = _take_next(self._state_at, memory)
        if result == _NEWS:
            return frames
        return () if result == _NO_NEWS else None


def take_of(rings: Sequence[RingReader[SampleT]]) -> Take[SampleT] | None:
    """Return a take of some rings; None where there are none, or too many for one system call."""
    return Take(rings, FramePool(rings), is_loop=False) if 1 <= len(rings) <= futex.MAX_WORDS else None
