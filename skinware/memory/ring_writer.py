"""The writer's end of a ring: it fills the next slot, and waits for nobody (:mod:`skinware.memory.ring`)."""

from __future__ import annotations

import mmap
import operator
import time
from typing import Any

import numpy as np
import numpy.typing as npt

from skinware.errors import Closed, ServiceError
from skinware.memory import file_layout, futex
from skinware.memory.futex import fence
from skinware.memory.ring import (
    ACQUIRED,
    AHEAD,
    FLAGS,
    LATEST,
    MISSED_PERIODS,
    PUBLISHED,
    SEQUENCE,
    STATE,
    WAKE_WORD,
    slot_headers_of,
    slots_of,
)
from skinware.memory.segments import Segment
from skinware.memory.statistics import bucket_of
from skinware.realtime import now_ns
from skinware.status import AHEAD_NS

_STATISTICS = slice(file_layout.STATISTICS_OFFSET // 8, file_layout.COLUMN_OFFSET // 8)
# words of the statistics: a count, two times (best, worst, total), another count, histograms
_TIMED, _WALL, _CPU, _BEFORE_BOOT, _AGE = 0, 1, 4, 7, 8
_LATENESS = _AGE + file_layout.HISTOGRAM_BUCKETS
_MOST_NS, _ALL_FLAGS = (1 << 63) - 1, (1 << 64) - 1


class RingWriter:
    """The writer's end of one generation. Not for several threads at once.

    Attributes:
        native_address: of its ``skinware_ring_writer``, for C code that publishes through it; None: Python publishes.
    """

    native_address: int | None = None

    def __init__(self, segment: Segment) -> None:
        layout = segment.layout
        self.segment = segment
        self._words = segment.data.data.cast("Q")
        self._half_words = segment.data.data.cast("I")
        self._wake_word = futex.Word(segment.data, file_layout.WAKE_WORD_OFFSET)
        self._count = layout.slot_count
        self._slot_words = slot_headers_of(segment)
        self._columns = [
            {name: np.ndarray(*where[:2], slot, where[2]) for name, where in segment.slot_formats().items()}
            for slot in slots_of(segment)
        ]
        self._contents = [slot[file_layout.SLOT.itemsize :] for slot in slots_of(segment)]
        self._statistics = self._words[_STATISTICS]
        self._begun_ns, self._cpu_ns = 0, time.thread_time_ns()
        self._skipped = 0
        for page in range(0, layout.file_size, mmap.PAGESIZE):
            segment.data[page] = segment.data[page]  # touch every page now, not in the middle of a period

    @property
    def sequence(self) -> int:
        """Sequence of the newest frame, 0 before the first."""
        return self._words[LATEST]

    def begin(
        self, *, from_last: bool = False, skip: int = 0, contents: memoryview | None = None
    ) -> dict[str, npt.NDArray[Any]]:
        """The columns of the next slot, to be filled; they hold an old frame.

        Until ``commit``, readers of that old frame are told that it is gone.

        Args:
            from_last: copy the newest frame into it first, for writers that change parts only.
            skip: sequences before its own that are left out; readers count them as lost. It is one more where the slot
                would be that of the newest frame, which stays readable meanwhile.
            contents: a whole slot of the same layout, to be copied into it first.
        """
        if self.segment.descriptor.fd < 0:
            raise Closed(f"{self.segment.path}: this writer was closed, or belongs to the process before a fork")
        latest = self.sequence
        self._skipped = skip + (latest > 0 and (skip + 1) % self._count == 0)
        slot = self._next % self._count
        self._take_next()
        if from_last and latest:
            self._contents[slot][:] = self._contents[latest % self._count]
        elif contents is not None:
            self._contents[slot][:] = contents[file_layout.SLOT.itemsize :]
        return self._columns[slot]

    @property
    def _next(self) -> int:
        return self.sequence + 1 + self._skipped

    def _take_next(self) -> None:
        """Take the next slot: tell the readers of the frame in it that it is gone."""
        self._begun_ns = now_ns()
        self._slot_words[self._next % self._count][SEQUENCE] = 0
        fence()

    def commit(self, acquired_ns: int, flags: int = 0) -> int:
        """Publish what was filled in since ``begin`` and wake all readers with one system call.

        If it raises, nothing has changed: the newest frame is the one before, and the one begun may be committed still.
        An exception from outside in the middle of it (Ctrl-C) leaves the frame published, or not at all.

        Args:
            acquired_ns: newest time stamp of the data, CLOCK_MONOTONIC ns. Below 0 (a device's stamp from before this
                machine booted) it counts as 0, and in ``WriterStatistics.before_boot``. More than 0.2 s in the future
                it stays as it is, is fresh for nobody, and counts in ``WriterStatistics.ahead``.
            flags: bits for the service's own use.

        Returns:
            The frame's sequence.

        Raises:
            Closed: this writer was closed since ``begin``, or belongs to the process before a fork.
            ServiceError: there was no ``begin`` before it: the slot holds an old frame.
            TypeError: ``acquired_ns`` or ``flags`` is no integer.
            ValueError: ``acquired_ns`` does not fit 63 bits, or ``flags`` 64.
        """
        if self.segment.descriptor.fd < 0:
            raise Closed(f"{self.segment.path}: this writer was closed, or belongs to the process before a fork")
        if not self._has_begun():
            raise ServiceError(f"{self.segment.path}: commit without begin would publish an old frame as a new one")
        acquired_ns, flags = operator.index(acquired_ns), operator.index(flags)
        if acquired_ns > _MOST_NS or not 0 <= flags <= _ALL_FLAGS:
            raise ValueError(f"{self.segment.path}: a frame has 63 bits for acquired_ns ({acquired_ns}), 64 for flags")
        return self._publish(acquired_ns, flags)

    def _has_begun(self) -> bool:
        return self._begun_ns != 0

    def _publish(self, acquired_ns: int, flags: int) -> int:
        if acquired_ns < 0:
            acquired_ns = 0
            self._statistics[_BEFORE_BOOT] += 1
        sequence = self._next
        words = self._slot_words[sequence % self._count]
        published_ns = now_ns()
        words[ACQUIRED] = acquired_ns
        words[PUBLISHED] = published_ns
        words[FLAGS] = flags
        fence()
        words[SEQUENCE] = sequence
        begun_ns, self._begun_ns, self._skipped = self._begun_ns, 0, 0
        self._words[LATEST] = sequence  # from now on it is published: this word alone says so
        self.wake()
        self._note(begun_ns, published_ns, acquired_ns)
        return sequence

    def wake(self) -> None:
        fence()  # who sees the new word sees what it is about; the system call itself orders the word
        self._half_words[WAKE_WORD] = (self._half_words[WAKE_WORD] + 1) & 0xFFFF_FFFF
        self._wake_word.wake_all()

    def count_missed_periods(self, count: int) -> None:
        """Add to the number of periods that this writer missed, for everybody to see."""
        self._words[MISSED_PERIODS] += count

    def count_lateness(self, late_ns: int) -> None:
        """Tell how late a period began."""
        self._statistics[_LATENESS + bucket_of(late_ns)] += 1

    def _note(self, begun_ns: int, published_ns: int, acquired_ns: int) -> None:
        """Statistics of one publication, after the readers have been woken."""
        words = self._statistics
        if acquired_ns - published_ns > AHEAD_NS:
            self._words[AHEAD] += 1
        words[_AGE + bucket_of(published_ns - acquired_ns)] += 1
        words[_TIMED] = timed = words[_TIMED] + 1
        cpu_ns = time.thread_time_ns()
        passed_ns = max(0, cpu_ns - self._cpu_ns)  # below 0 if another thread publishes now
        self._cpu_ns = cpu_ns
        for first, value_ns in ((_WALL, published_ns - begun_ns), (_CPU, passed_ns)):
            if value_ns < words[first] or timed == 1:
                words[first] = value_ns
            if value_ns > words[first + 1]:
                words[first + 1] = value_ns
            words[first + 2] += value_ns

    def set_state(self, bits: int, on: bool = True) -> None:
        state = self._half_words[STATE]
        self._half_words[STATE] = state | bits if on else state & ~bits
        self.wake()
