"""The reader's end of a ring: copies, and the turns of loops that C takes."""

from __future__ import annotations

import ctypes
from typing import Any, Generic, NamedTuple

import numpy as np

from skinware import native
from skinware.errors import Overrun
from skinware.memory import file_layout, futex
from skinware.memory.futex import fence
from skinware.memory.ring import (
    COPY_ATTEMPTS,
    LATEST,
    MISSED_PERIODS,
    SEQUENCE,
    STATE,
    WAKE_WORD,
    SampleT,
    slot_headers_of,
    slots_of,
)
from skinware.memory.segments import Segment
from skinware.memory.take import FramePool, ReaderState, Take, Turn

_copy = native.core().quick.skinware_native_copy
_COPIED, _NOTHING = 1, 0  # what library.c returns
_NEWEST = ctypes.c_uint64(0)


class Turns(NamedTuple):
    """The turns that C took since they were last settled.

    Attributes:
        last: sequence of the last sample taken.
    """

    frames: int
    missed: int
    last: int
    over: list[Turn]


class RingReader(Generic[SampleT]):
    """The reader's end of one generation: it reads only, takes no lock, and the writer does not know it.

    Args:
        context: what every sample carries as ``context``.
    """

    def __init__(self, segment: Segment, frame_class: type[SampleT], context: object = None) -> None:
        self._frame_class = frame_class
        self.context = context
        self.columns: dict[str, tuple[tuple[int, ...], np.dtype[Any], int]] = segment.slot_formats()
        self.segment = segment
        self.generation: int = segment.generation
        self.period_ns: int = int(segment.header["period_ns"])
        self.words = segment.data.data.cast("Q")
        self._half_words = segment.data.data.cast("I")
        self.wake_word: futex.Word = futex.Word(segment.data, file_layout.WAKE_WORD_OFFSET)
        self._slots = slots_of(segment)
        self._slot_words = slot_headers_of(segment)
        self.state_in_c = ReaderState.of(segment)
        self.state_in_c.descriptor, self.state_in_c.writer = segment.descriptor.fd, segment.maker.fd_for_c
        self._state_at = ctypes.byref(self.state_in_c)
        self._pool = FramePool([self])
        self.take = Take([self], self._pool, is_loop=True)

    @property
    def latest(self) -> int:
        """Sequence of the newest sample, 0 before the first."""
        return self.words[LATEST]

    def frame_in(self, data: bytearray, start: int) -> SampleT:
        """Return a sample in memory of which it takes ``slot_stride`` bytes, a multiple of 64, from ``start`` on."""
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
        result = _copy(self._state_at, wanted, memory)
        if result == _COPIED:
            frame.stale = False
            return frame
        if result == _NOTHING:
            return None
        raise self._overrun()

    def _overrun(self) -> Overrun:
        if not self.segment.writer_lives():
            return Overrun(
                f"{self.segment.path}: its writer is dead, and its newest sample is not whole; start it again"
            )
        return Overrun(
            f"{self.segment.path}: the writer was faster {COPY_ATTEMPTS} times in a row; "
            f"give the service more slots (it has {len(self._slots)}) or publish less often"
        )

    def resume_turns(self, last: int, until_ns: int, turn: tuple[int, int] | None) -> None:
        """Begin to take turns in C.

        Args:
            last: sequence of the sample that was taken last.
            until_ns: when Python has something to do at the latest.
            turn: ``acquired_ns`` of that sample and when it was handed out; None if its turn is over.
        """
        state = self.state_in_c
        state.last = last
        state.acquired_ns, state.taken_ns = turn or (0, 0)
        self.take.leave_until(until_ns)

    def settle_turns(self) -> Turns | None:
        """Return the turns taken in C since the last call; None if there were none."""
        state = self.state_in_c
        if not (state.frames or state.noted):
            return None
        settled = Turns(state.frames, state.missed, state.last, [Turn(*turn) for turn in state.turns[: state.noted]])
        state.frames = state.missed = state.noted = 0
        return settled

    def end_turn(self) -> tuple[int, int] | None:
        """Return ``acquired_ns`` of the sample that C handed out last and when that was; None if its turn is over."""
        state = self.state_in_c
        taken_ns, state.taken_ns, state.last = state.taken_ns, 0, 0
        return (state.acquired_ns, taken_ns) if taken_ns else None

    @property
    def missed_periods(self) -> int:
        return self.words[MISSED_PERIODS]

    def times_ns(self, word: int) -> list[tuple[int, int]]:
        """Return (sequence, time) of the samples that the ring still holds, oldest first.

        Args:
            word: ``PUBLISHED`` or ``ACQUIRED``.
        """
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
        """Return the newest sample in place, without a copy; ask ``frame.valid`` after using it."""
        for _ in range(COPY_ATTEMPTS):
            wanted = self.latest
            if wanted == 0:
                return None
            slot = wanted % len(self._slots)
            frame = self._frame_class(self, self._slots[slot], self._slot_words[slot])
            if frame.sequence == wanted and frame.valid:
                return frame
        raise self._overrun()
