"""The reader's end of a ring: copies, waits and the turns of loops, each a call of C."""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Sequence
from itertools import accumulate
from sys import getrefcount
from typing import Any, Generic, NamedTuple

import numpy as np

from skinware import native
from skinware.errors import Overrun
from skinware.memory import file_layout, futex
from skinware.memory.futex import fence
from skinware.memory.ring import (
    ACQUIRED,
    COPY_ATTEMPTS,
    LATEST,
    MISSED_PERIODS,
    PUBLISHED,
    SEQUENCE,
    STATE,
    WAKE_WORD,
    SampleT,
    slot_headers_of,
    slots_of,
)
from skinware.memory.segments import Segment

_copy = native.core().quick.skinware_native_copy
_wait = native.core().waiting.skinware_native_wait
_turn = native.core().waiting.skinware_native_turn
_turn_at_once = native.core().quick.skinware_native_turn

_NEVER_NS = (1 << 63) - 1
_COPIED, _NOTHING = 1, 0  # what library.c returns
_NEWEST = ctypes.c_uint64(0)

Memory = ctypes.Array[ctypes.c_char]
_Place = tuple[tuple[SampleT, ...], bytearray, Memory]

_COUNTS_COME_LATE = not getattr(sys, "_is_gil_enabled", lambda: True)()  # those of other threads


class Turn(NamedTuple):
    """One turn of a loop that takes samples.

    Attributes:
        acquired_ns: of its sample.
        taken_ns: when that was handed out.
        ended_ns: when the loop came back.
        cpu_ns: CPU time of the thread then; 0 if it was not asked for.
    """

    acquired_ns: int
    taken_ns: int
    ended_ns: int
    cpu_ns: int


class Turns(NamedTuple):
    """The turns that C took since they were last settled.

    Attributes:
        frames: samples taken.
        lost: samples missed.
        last: sequence of the last sample taken.
        over: the turns that are over.
    """

    frames: int
    lost: int
    last: int
    over: list[Turn]


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


class RingWords(ctypes.Structure):
    """``skinware__ring`` of skinware.h, with which the others begin."""

    _fields_ = [
        ("map", ctypes.c_void_p),
        ("slot_offset", ctypes.c_uint64),
        ("slot_stride", ctypes.c_uint64),
        ("slot_count", ctypes.c_uint64),
    ]


class _Request(RingWords):
    """``skinware_native_request`` of library.c."""

    _fields_ = [
        ("wake_count", ctypes.c_uint64),
        ("known", ctypes.c_uint64),
        ("wanted", ctypes.c_uint64),
        ("timeout_ns", ctypes.c_int64),
    ]


class _TurnsState(RingWords):
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


class RingReader(Generic[SampleT]):
    """The reader's end of one generation: it reads only, takes no lock, and the writer does not know it.

    Args:
        segment: the attached generation.
        frame_class: class of the frames it hands out.
        context: what every frame carries as ``context``.
    """

    def __init__(self, segment: Segment, frame_class: type[SampleT], context: object = None) -> None:
        self._frame_class = frame_class
        self.context = context
        self.columns: dict[str, tuple[tuple[int, ...], np.dtype[Any], int]] = segment.slot_formats()
        self.segment = segment
        self.generation: int = segment.generation
        self.period_ns: int = int(segment.header["period_ns"])
        self._words = segment.data.data.cast("Q")
        self._half_words = segment.data.data.cast("I")
        self.wake_word: futex.Word = futex.Word(segment.data, file_layout.WAKE_WORD_OFFSET)
        self._slots = slots_of(segment)
        self._slot_words = slot_headers_of(segment)
        self._pool = FramePool([self])
        self._request = _Request(*ring_words(segment))
        self._request_at = ctypes.byref(self._request)
        self.turns: ctypes.Structure = _TurnsState(*ring_words(segment))
        self._turns_at = ctypes.byref(self.turns)
        self.turns.descriptor, self.turns.writer = segment.descriptor.fd, segment.maker.fd_for_c
        self.turns.process = os.getpid()
        self._timeout_ns, self._in_order = 0, False

    @property
    def latest(self) -> int:
        """Sequence of the newest frame, 0 before the first."""
        return self._words[LATEST]

    @property
    def frame_size(self) -> int:
        return self.segment.layout.slot_stride

    def frame_in(self, data: bytearray, start: int) -> SampleT:
        """A frame in memory of which it takes ``frame_size`` bytes, a multiple of 64, from ``start`` on."""
        return self._frame_class(self, data, start=start)

    @property
    def slot_count(self) -> int:
        return len(self._slots)

    @property
    def state(self) -> int:
        return self._half_words[STATE]

    @property
    def wake_count(self) -> int:
        """Present value of the futex word; take it before looking at ``latest`` or ``state``."""
        count = self._half_words[WAKE_WORD]
        fence()
        return count

    def copy(self, sequence: int | None = None) -> SampleT | None:
        """Return a private copy of a sample.

        Args:
            sequence: which one; default: the newest.

        Returns:
            None if nothing was published yet, or the sample asked for is no longer in the ring.

        Raises:
            Overrun: the newest sample was overwritten while it was copied, 64 times in a row.
        """
        (frame,), _, memory = self._pool.free()
        wanted = _NEWEST if sequence is None else ctypes.c_uint64(sequence)
        return self._copied(_copy(self._request_at, wanted, memory), frame)

    def wait(self, wake_count: int, latest: int, timeout_ns: int, sequence: int | None = None) -> SampleT | None:
        """Sleep until the futex word is another than ``wake_count``, or the time is up; may return early.

        Returns:
            A copy, as of ``copy(sequence)``, if the newest sample is another than ``latest`` then.

        Raises:
            Overrun: as ``copy``.
        """
        (frame,), _, memory = self._pool.free()
        request = self._request
        request.wake_count, request.known = wake_count, latest
        request.wanted, request.timeout_ns = sequence or 0, timeout_ns
        return self._copied(_wait(self._request_at, memory), frame)

    def _copied(self, result: int, frame: SampleT) -> SampleT | None:
        if result == _COPIED:
            frame.stale = False
            return frame
        if result == _NOTHING:
            return None
        raise self._overrun()

    def _overrun(self) -> Overrun:
        if not self.segment.writer_lives():
            return Overrun(
                f"{self.segment.path}: its writer is dead, and its newest frame is not whole; start it again"
            )
        return Overrun(
            f"{self.segment.path}: the writer was faster {COPY_ATTEMPTS} times in a row; "
            f"give the service more slots (it has {len(self._slots)}) or publish less often"
        )

    def next_turn(self, timeout_ns: int | None, in_order: bool) -> SampleT | None:
        """Return the next sample of a loop; None if something else is to be done first, in Python.

        The call lets go of the interpreter lock only if it has to sleep: others may keep the lock for long.

        Args:
            timeout_ns: longest wait; None for no limit.
            in_order: return the sample after the last one, not the newest.
        """
        (frame,), _, memory = self._pool.free()
        frame.stale = False
        state = self.turns
        until_ns = _NEVER_NS if timeout_ns is None else timeout_ns
        if until_ns != self._timeout_ns or in_order != self._in_order:
            self._timeout_ns, self._in_order = until_ns, in_order
            state.timeout_ns, state.in_order = until_ns, in_order
        turn = _turn if self._words[LATEST] == state.last else _turn_at_once
        return frame if turn(self._turns_at, memory) else None

    @property
    def begun_ns(self) -> int:
        """When the wait of the last ``next_turn`` began, CLOCK_MONOTONIC ns."""
        return int(self.turns.begun_ns)

    def resume_turns(self, last: int, until_ns: int, turn: tuple[int, int] | None) -> None:
        """Begin to take turns in C.

        Args:
            last: sequence of the sample that was taken last.
            until_ns: when Python has something to do at the latest.
            turn: ``acquired_ns`` of that sample and when it was handed out; None if its turn is over.
        """
        state = self.turns
        state.last, state.until_ns = last, until_ns
        state.acquired_ns, state.taken_ns = turn or (0, 0)

    def settle_turns(self) -> Turns | None:
        """Return the turns taken in C since the last call; None if there were none."""
        state = self.turns
        if not (state.frames or state.noted):
            return None
        settled = Turns(state.frames, state.lost, state.last, [Turn(*turn) for turn in state.turns[: state.noted]])
        state.frames = state.lost = state.noted = 0
        return settled

    def end_turn(self) -> tuple[int, int] | None:
        """Return ``acquired_ns`` of the sample that C handed out last and when that was; None if its turn is over."""
        state = self.turns
        taken_ns, state.taken_ns, state.last = state.taken_ns, 0, 0
        return (state.acquired_ns, taken_ns) if taken_ns else None

    @property
    def missed_periods(self) -> int:
        return self._words[MISSED_PERIODS]

    def publication_times_ns(self) -> list[int]:
        """When the frames that the ring still holds were published, oldest first."""
        return [time_ns for _, time_ns in self._times_ns(PUBLISHED)]

    def acquisition_times_ns(self) -> list[tuple[int, int]]:
        """(sequence, ``acquired_ns``) of the frames that the ring still holds, oldest first."""
        return self._times_ns(ACQUIRED)

    def _times_ns(self, word: int) -> list[tuple[int, int]]:
        times = []
        latest = self.latest
        for sequence in range(max(1, latest - len(self._slots) + 2), latest + 1):
            words = self._slot_words[sequence % len(self._slots)]
            time_ns = words[word]
            fence()
            if words[SEQUENCE] == sequence:
                times.append((sequence, time_ns))
        return times

    def view(self) -> SampleT | None:
        """The newest frame in place, without a copy; ask ``frame.valid`` after using it."""
        for _ in range(COPY_ATTEMPTS):
            wanted = self.latest
            if wanted == 0:
                return None
            slot = wanted % len(self._slots)
            frame = self._frame_class(self, self._slots[slot], self._slot_words[slot])
            if frame.sequence == wanted and frame.valid:
                return frame
        raise self._overrun()


def ring_words(segment: Segment) -> tuple[int, int, int, int]:
    """The fields of :class:`RingWords`."""
    layout = segment.layout
    return segment.data.ctypes.data, layout.slot_offset, layout.slot_stride, layout.slot_count
