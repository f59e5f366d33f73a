"""Call the ring's code in C: take samples, sleep until the next one, and reuse their memory."""

from __future__ import annotations

import ctypes
import os
import sys
import time
from collections.abc import Sequence
from itertools import accumulate
from sys import getrefcount
from typing import Generic

from skinware import native
from skinware.memory import futex
from skinware.memory.ring import LATEST, RingReader, SampleT, Turn, Turns
from skinware.memory.ring_writer import RingWriter
from skinware.memory.segments import Segment

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


_NEVER_NS = (1 << 63) - 1
_COPIED, _NOTHING = 1, 0  # what library.c answers
_NEWEST = ctypes.c_uint64(0)


def ring_reader(segment: Segment, frame_class: type[SampleT], context: object = None) -> RingReader[SampleT]:
    """A reader's end of a generation, native where that is possible."""
    library = native.core()
    if library is None:
        return RingReader(segment, frame_class, context)
    return NativeRingReader(segment, frame_class, context, library)


def ring_writer(segment: Segment) -> RingWriter:
    """The writer's end of a generation, native where that is possible."""
    library = native.core()
    return RingWriter(segment) if library is None else NativeRingWriter(segment, library)


class _Ring(ctypes.Structure):
    """``skinware__ring`` of skinware.h, with which the others begin."""

    _fields_ = [
        ("map", ctypes.c_void_p),
        ("slot_offset", ctypes.c_uint64),
        ("slot_stride", ctypes.c_uint64),
        ("slot_count", ctypes.c_uint64),
    ]


class _Request(_Ring):
    """``skinware_native_request`` of library.c."""

    _fields_ = [
        ("wake_count", ctypes.c_uint64),
        ("known", ctypes.c_uint64),
        ("wanted", ctypes.c_uint64),
        ("timeout_ns", ctypes.c_int64),
    ]


class _TurnsState(_Ring):
    """``skinware_native_turns`` of turns.h."""

    _fields_ = [
        ("last", ctypes.c_uint64),
        ("in_order", ctypes.c_uint64),
        ("until_ns", ctypes.c_int64),
        ("timeout_ns", ctypes.c_int64),
        ("begun_ns", ctypes.c_int64),
        ("descriptor", ctypes.c_int64),
        ("writer", ctypes.c_int64),
        ("process", ctypes.c_int64),
        ("frames", ctypes.c_uint64),
        ("lost", ctypes.c_uint64),
        ("acquired_ns", ctypes.c_int64),
        ("taken_ns", ctypes.c_int64),
        ("noted", ctypes.c_uint64),
        ("turns", (ctypes.c_int64 * 4) * 256),
    ]


class NativeRingReader(RingReader[SampleT]):
    """A reader's end whose waits and copies are calls of C."""

    def __init__(self, segment: Segment, frame_class: type[SampleT], context: object, library: native.Library) -> None:
        super().__init__(segment, frame_class, context)
        self._pool = FramePool([self])
        self._copy_call = library.quick.skinware_native_copy
        self._wait_call = library.waiting.skinware_native_wait
        self._turn_call = library.waiting.skinware_native_turn
        self._turn_at_once = library.quick.skinware_native_turn
        self._request = _Request(*_ring_words(segment))
        self._request_at = ctypes.byref(self._request)
        self._turns = _TurnsState(*_ring_words(segment))
        self._turns_at = ctypes.byref(self._turns)
        self._turns.descriptor, self._turns.writer = segment.descriptor.fd, segment.maker.fd_for_c
        self._turns.process = os.getpid()
        self._turns.timeout_ns = _NEVER_NS
        self._timeout_ns: int | None = None
        self._in_order = False

    @property
    def turns_address(self) -> int:
        return ctypes.addressof(self._turns)

    def copy(self, sequence: int | None = None) -> SampleT | None:
        (frame,), _, memory = self._pool.free()
        wanted = _NEWEST if sequence is None else ctypes.c_uint64(sequence)
        return self._copied(self._copy_call(self._request_at, wanted, memory), frame)

    def wait(self, wake_count: int, latest: int, timeout_ns: int, sequence: int | None = None) -> SampleT | None:
        (frame,), _, memory = self._pool.free()
        request = self._request
        request.wake_count, request.known = wake_count, latest
        request.wanted, request.timeout_ns = sequence or 0, timeout_ns
        return self._copied(self._wait_call(self._request_at, memory), frame)

    def _copied(self, result: int, frame: SampleT) -> SampleT | None:
        if result == _COPIED:
            frame.stale = False
            return frame
        if result == _NOTHING:
            return None
        raise self._overrun()

    def next_turn(self, timeout_ns: int | None, in_order: bool) -> SampleT | None:
        """One call of C, which lets go of the interpreter lock only if it has to sleep: others may keep it for long."""
        (frame,), _, memory = self._pool.free()
        frame.stale = False
        state = self._turns
        if timeout_ns != self._timeout_ns or in_order != self._in_order:
            self._timeout_ns, self._in_order = timeout_ns, in_order
            state.timeout_ns, state.in_order = _NEVER_NS if timeout_ns is None else timeout_ns, in_order
        turn = self._turn_call if self._words[LATEST] == state.last else self._turn_at_once
        return frame if turn(self._turns_at, memory) else None

    @property
    def begun_ns(self) -> int:
        return int(self._turns.begun_ns)

    def resume_turns(self, last: int, until_ns: int, turn: tuple[int, int] | None) -> bool:
        state = self._turns
        state.last, state.until_ns = last, until_ns
        state.acquired_ns, state.taken_ns = turn or (0, 0)
        return True

    def settle_turns(self) -> Turns | None:
        state = self._turns
        if not (state.frames or state.noted):
            return None
        told = Turns(state.frames, state.lost, state.last, [Turn(*turn) for turn in state.turns[: state.noted]])
        state.frames = state.lost = state.noted = 0
        return told

    def end_turn(self) -> tuple[int, int] | None:
        state = self._turns
        taken_ns, state.taken_ns, state.last = state.taken_ns, 0, 0
        return (state.acquired_ns, taken_ns) if taken_ns else None


class _WriterState(_Ring):
    """``skinware_ring_writer`` of ring.h."""

    _fields_ = [
        ("begun_ns", ctypes.c_int64),
        ("cpu_ns", ctypes.c_int64),
    ]


class NativeRingWriter(RingWriter):
    """The writer's end whose publication is a call of C; but not of frames before which some are left out."""

    def __init__(self, segment: Segment, library: native.Library) -> None:
        super().__init__(segment)
        self._begin_call = library.quick.skinware_native_begin
        self._commit_call = library.quick.skinware_native_commit
        self._commit_call.argtypes = ctypes.c_void_p, ctypes.c_int64, ctypes.c_uint64
        self._commit_call.restype = ctypes.c_uint64
        self._wake_call = library.quick.skinware_native_wake
        self._state = _WriterState(*_ring_words(segment), 0, time.thread_time_ns())
        self._state_at = ctypes.byref(self._state)
        self.native_address = ctypes.addressof(self._state)

    def wake(self) -> None:
        self._wake_call(self._state_at)

    def _take_next(self) -> None:
        if self._skipped:
            self._state.begun_ns = 0
            super()._take_next()
        else:
            self._begin_call(self._state_at)

    def _has_begun(self) -> bool:
        return super()._has_begun() if self._skipped else bool(self._state.begun_ns)

    def _publish(self, acquired_ns: int, flags: int) -> int:
        if self._skipped:
            return super()._publish(acquired_ns, flags)
        return int(self._commit_call(self._state_at, acquired_ns, flags))


def _ring_words(segment: Segment) -> tuple[int, int, int, int]:
    layout = segment.layout
    return segment.data.ctypes.data, layout.slot_offset, layout.slot_stride, layout.slot_count


_NEWS, _NO_NEWS = 1, 0  # what look.c answers


class PythonsTurn(Exception):
    """Something else than frames is to be done, for which there is no C."""


class _SeenRing(ctypes.Structure):
    """``seen_ring`` of look.c."""

    _fields_ = [("turns", ctypes.c_void_p), ("start", ctypes.c_uint64)]


class _LookState(ctypes.Structure):
    """``skinware_native_look`` of look.c."""

    _fields_ = [
        ("count", ctypes.c_uint64),
        ("news_only", ctypes.c_uint64),
        ("until_ns", ctypes.c_int64),
        ("asked_ns", ctypes.c_int64),
        ("rings", _SeenRing * futex.MAX_WORDS),
        ("words", (ctypes.c_uint64 * 3) * futex.MAX_WORDS),
    ]


class Look(Generic[SampleT]):
    """A look at several rings whose readers have left their turns to C.

    Args:
        rings: 1 to :data:`skinware.memory.futex.MAX_WORDS`.
        library: with their C.
    """

    def __init__(self, rings: Sequence[NativeRingReader[SampleT]], library: native.Library) -> None:
        self.rings = rings
        self._at_once = library.quick.skinware_native_newest
        self._with_sleep = library.waiting.skinware_native_newest
        self._state = _LookState(len(rings))
        self._state_at = ctypes.byref(self._state)
        self._pool = FramePool(rings)
        for seen, ring, start in zip(self._state.rings, rings, self._pool.starts, strict=False):
            seen.turns, seen.start = ring.turns_address, start

    def newest(self, until_ns: int | None) -> tuple[SampleT, ...] | None:
        """The newest frame of every ring, each a private copy.

        Args:
            until_ns: wait for another frame than those of the last look, at most until then (CLOCK_MONOTONIC ns), and
                maybe not as long. None: take what is there.

        Returns:
            None if there is nothing new.

        Raises:
            PythonsTurn: nothing was taken, and the readers have to look.
        """
        frames, _, memory = self._pool.free()
        for frame in frames:
            frame.stale = False
        state = self._state
        state.news_only, state.until_ns = until_ns is not None, 0
        result = self._at_once(self._state_at, memory)  # which keeps the interpreter lock: others may have it for long
        if result == _NO_NEWS:
            state.until_ns = until_ns
            result = self._with_sleep(self._state_at, memory)
        if result == _NEWS:
            return frames
        if result == _NO_NEWS:
            return None
        raise PythonsTurn


def look_at(rings: Sequence[RingReader[SampleT]]) -> Look[SampleT] | None:
    library = native.core()
    natives = [ring for ring in rings if isinstance(ring, NativeRingReader)]
    if library is None or len(natives) < len(rings) or not 1 <= len(rings) <= futex.MAX_WORDS:
        return None
    return Look(natives, library)
