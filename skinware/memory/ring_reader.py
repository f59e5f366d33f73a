"""The reader's end of a ring: copies, and samples that C takes, as long as nothing but samples comes."""

from __future__ import annotations

import ctypes
import os
import weakref
from collections.abc import Callable, Sequence
from itertools import accumulate
from typing import Any, ClassVar, Generic, NamedTuple

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
    RingWords,
    SampleT,
    slot_headers_of,
    slots_of,
)
from skinware.memory.segments import Segment

_copy = native.core().quick.skinware_native_copy
_take_now = native.core().quick.skinware_native_take_now
_take_next = native.core().waiting.skinware_native_take_next

NEWEST, NEWER, NEXT = 0, 1, 2
"""Kinds of takes: the newest sample, even if it was taken before; a newer one; or the next one in order."""
_NEWS, _NO_NEWS = 1, 0  # what take.c and library.c return
_NEVER_NS = (1 << 63) - 1
_ANY = ctypes.c_uint64(0)


class Turn(NamedTuple):
    """One turn of a loop that takes samples; ``cpu_ns`` of the thread at its end is 0 if it was not asked for."""

    acquired_ns: int
    taken_ns: int
    ended_ns: int
    cpu_ns: int


class Turns(NamedTuple):
    """The turns that C took since they were last settled, and the sequence of the last sample."""

    frames: int
    missed: int
    last: int
    over: list[Turn]


class ReaderState(RingWords):
    """``skinware_native_reader`` of take.c."""

    _fields_: ClassVar = [
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


class _Memory(np.ndarray[tuple[int], np.dtype[np.uint8]]):
    """Bytes of samples; arrays of a view of them keep that view, not only these bytes."""


class _Piece:
    """Memory that is lent to the samples of one take, and given back when nothing uses them or their arrays any more.

    Attributes:
        lease: returns the view that those samples have; None once it is given back.
    """

    def __init__(self, size: int, starts: Sequence[int]) -> None:
        self.bytes = np.zeros(size, np.uint8).view(_Memory)
        self.in_c = (ctypes.c_char * size).from_buffer(self.bytes.data)
        self.headers = [self.bytes.data[start:].cast("Q") for start in starts]
        self.lease: Callable[[], object] = lambda: None


class Take(Generic[SampleT]):
    """Take the samples of some rings in C. Not for several threads at once.

    Args:
        rings: 1 to :data:`skinware.memory.futex.MAX_WORDS`.
        is_loop: it is the loop of one reader, whose turn ends with the next call.
    """

    def __init__(self, rings: Sequence[RingReader[SampleT]], *, is_loop: bool) -> None:
        self.rings = rings
        *self._starts, self._size = accumulate((ring.segment.layout.slot_stride for ring in rings), initial=0)
        self._pieces = [_Piece(self._size, self._starts) for _ in range(2)]  # a loop still has the one before
        self._turn = 0
        self._state_of_one = rings[0].state_in_c if is_loop else None
        self._words = rings[0].words
        self.state_in_c = TakeState(len(rings), is_loop, NEWER, 0, _NEVER_NS, 0, 0, os.getpid())
        self._state_at = ctypes.byref(self.state_in_c)
        self._wanted, self._timeout_ns = NEWER, 0
        for place, ring, start in zip(self.state_in_c.places, rings, self._starts, strict=False):
            place.reader, place.start = ctypes.addressof(ring.state_in_c), start

    def free(self) -> _Piece:
        """Return memory that no sample uses."""
        self._turn = turn = 1 - self._turn
        piece = self._pieces[turn]
        if piece.lease() is not None:
            piece = self._pieces[turn] = _Piece(self._size, self._starts)
        return piece

    def samples_in(self, piece: _Piece) -> tuple[SampleT, ...]:
        """Return the samples that C has written into a piece of memory, one of each ring."""
        lent: Any = piece.bytes.view()
        piece.lease, ring = weakref.ref(lent), self.rings[0]
        first = ring.frame_class(ring, lent, 0, None, piece.headers[0])
        if len(self.rings) == 1:
            return (first,)
        parts = zip(self.rings[1:], self._starts[1:], piece.headers[1:], strict=True)
        return first, *[ring.frame_class(ring, lent, start, None, header) for ring, start, header in parts]

    def next(self, wanted: int, timeout_ns: int) -> tuple[SampleT, ...] | None:
        """Return one sample of every ring, each a private copy.

        The call lets go of the interpreter lock only if it has to sleep: other threads may keep the lock for long.

        Args:
            wanted: ``NEWEST``, ``NEWER`` or ``NEXT``.
            timeout_ns: longest wait for something newer; 0 or less: do not wait. It may be shorter.

        Returns:
            () if there is nothing new; None if Python has something else to do, and nothing was taken.
        """
        piece = self.free()
        if wanted != self._wanted or timeout_ns != self._timeout_ns:
            self._wanted = self.state_in_c.wanted = wanted
            self._timeout_ns = self.state_in_c.timeout_ns = timeout_ns
        one = self._state_of_one
        if one is not None and self._words[LATEST] == one.last:
            result = _NO_NEWS
        else:
            result = _take_now(self._state_at, piece.in_c)
        if result == _NO_NEWS and timeout_ns > 0:
            result = _take_next(self._state_at, piece.in_c)
        if result == _NEWS:
            return self.samples_in(piece)
        return () if result == _NO_NEWS else None


class RingReader(Generic[SampleT]):
    """The reader's end of one generation: it reads only, takes no lock, and the writer does not know it."""

    def __init__(self, segment: Segment, frame_class: type[SampleT], context: object = None) -> None:
        self.frame_class = frame_class
        self.context = context
        self.columns: dict[str, tuple[tuple[int, ...], np.dtype[Any], int]] = segment.slot_formats()
        self.segment = segment
        self.generation: int = segment.generation
        self.period_ns: int = int(segment.header["period_ns"])
        self.words = segment.data.data.cast("Q")
        self._half_words = segment.data.data.cast("I")
        self.wake_word: futex.Word = futex.Word(segment.data, file_layout.WAKE_WORD_OFFSET)
        self._slots = slots_of(segment)
        self.slot_count: int = len(self._slots)
        self._slot_words = slot_headers_of(segment)
        self.state_in_c = ReaderState.of(segment)
        self.state_in_c.descriptor, self.state_in_c.writer = segment.descriptor.fd, segment.maker.fd_for_c
        self._state_at = ctypes.byref(self.state_in_c)
        self.take = Take([self], is_loop=True)

    @property
    def latest(self) -> int:
        """Sequence of the newest sample, 0 before the first."""
        return self.words[LATEST]

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
        """Return a copy of the newest sample, or of another; None if there is none, or it is no longer in the ring."""
        piece = self.take.free()
        result = _copy(self._state_at, _ANY if sequence is None else ctypes.c_uint64(sequence), piece.in_c)
        if result == _NEWS:
            return self.take.samples_in(piece)[0]
        if result == _NO_NEWS:
            return None
        raise self._overrun()

    def _overrun(self) -> Overrun:
        if not self.segment.writer_lives():
            return Overrun(
                f"{self.segment.path}: its writer is dead, and its newest sample is not whole; start it again"
            )
        return Overrun(
            f"{self.segment.path}: the writer was faster {COPY_ATTEMPTS} times in a row; "
            f"give the service more slots (it has {self.slot_count}) or publish less often"
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
        self.take.state_in_c.until_ns = until_ns

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
        """Return (sequence, ``PUBLISHED`` or ``ACQUIRED`` time) of the samples in the ring, oldest first."""
        times = []
        latest = self.latest
        for sequence in range(max(1, latest - self.slot_count + 2), latest + 1):
            words = self._slot_words[sequence % self.slot_count]
            time_ns = words[word]
            fence()
            if words[SEQUENCE] == sequence:
                times.append((sequence, time_ns))
        return times

    def view(self, sequence: int | None = None) -> SampleT | None:
        """As ``copy``, but in place, without a copy; ask ``frame.valid`` after using it."""
        for _ in range(COPY_ATTEMPTS if sequence is None else 1):
            wanted = self.latest if sequence is None else sequence
            if wanted == 0:
                return None
            slot = wanted % self.slot_count
            frame = self.frame_class(self, self._slots[slot], in_ring=self._slot_words[slot])
            if frame.sequence == wanted and frame.valid:
                return frame
        if sequence is not None:
            return None
        raise self._overrun()
