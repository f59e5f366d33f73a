"""The writer's end of a ring: it fills the next slot, publishes it in C, and never waits."""

from __future__ import annotations

import ctypes
import mmap
import operator
import time
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from skinware import native
from skinware.errors import Closed, ServiceError
from skinware.memory import file_layout
from skinware.memory.ring import LATEST, MISSED_PERIODS, STATE, RingWords, slots_of
from skinware.memory.segments import Segment
from skinware.memory.statistics import bucket_of

_begin = native.core().quick.skinware_native_begin
_commit = native.core().quick.skinware_native_commit
_commit.argtypes = ctypes.c_void_p, ctypes.c_int64, ctypes.c_uint64
_commit.restype = ctypes.c_uint64
_wake = native.core().quick.skinware_native_wake

_LATENESS = (file_layout.STATISTICS_OFFSET + file_layout.STATISTICS.fields["lateness"][1]) // 8  # type: ignore[index]
_MOST_NS, _ALL_FLAGS = (1 << 63) - 1, (1 << 64) - 1


class WriterState(RingWords):
    """``skinware_ring_writer`` of ring.h."""

    _fields_: ClassVar = [
        ("begun_ns", ctypes.c_int64),
        ("cpu_ns", ctypes.c_int64),
        ("skipped", ctypes.c_uint64),
    ]


class RingWriter:
    """The writer's end of one generation. Not for several threads at once.

    Attributes:
        native_address: of its ``skinware_ring_writer``, for C code that publishes through it.
    """

    def __init__(self, segment: Segment) -> None:
        layout = segment.layout
        self.segment = segment
        self._words = segment.data.data.cast("Q")
        self._half_words = segment.data.data.cast("I")
        self._count = layout.slot_count
        self._columns = [
            {name: np.ndarray(*where[:2], slot, where[2]) for name, where in segment.slot_formats().items()}
            for slot in slots_of(segment)
        ]
        self._contents = [slot[file_layout.SLOT.itemsize :] for slot in slots_of(segment)]
        self._state = WriterState.of(segment)
        self._state.cpu_ns = time.thread_time_ns()
        self._state_at = ctypes.byref(self._state)
        self.native_address: int = ctypes.addressof(self._state)
        for page in range(0, layout.file_size, mmap.PAGESIZE):
            segment.data[page] = segment.data[page]  # touch every page now, not in the middle of a period

    @property
    def sequence(self) -> int:
        """Sequence of the newest sample, 0 before the first."""
        return self._words[LATEST]

    def begin(
        self, *, from_last: bool = False, skip: int = 0, contents: memoryview | None = None
    ) -> dict[str, npt.NDArray[Any]]:
        """Return the columns of the next slot, to be filled; they hold an old sample, or the newest or ``contents``.

        Until ``commit``, readers of that old sample find that it is gone.

        Args:
            skip: sequences before its own that are left out; readers count them as missed. It is one more where the
                slot would be that of the newest sample, which stays readable meanwhile.
        """
        if self.segment.descriptor.fd < 0:
            raise Closed(f"{self.segment.path}: this writer was closed, or belongs to the process before a fork")
        latest = self.sequence
        skipped = skip + (latest > 0 and (skip + 1) % self._count == 0)
        slot = (latest + 1 + skipped) % self._count
        _begin(self._state_at, ctypes.c_uint64(skipped))
        if from_last and latest:
            self._contents[slot][:] = self._contents[latest % self._count]
        elif contents is not None:
            self._contents[slot][:] = contents[file_layout.SLOT.itemsize :]
        return self._columns[slot]

    def commit(self, acquired_ns: int, flags: int = 0) -> int:
        """Publish what was filled in since ``begin``, as :meth:`skinware.service.Writer.commit` says.

        If it raises, nothing has changed: the newest sample is the one before; the one begun may still be committed.
        An exception from outside in the middle of it (Ctrl-C) leaves the sample published, or not at all.
        """
        if self.segment.descriptor.fd < 0:
            raise Closed(f"{self.segment.path}: this writer was closed, or belongs to the process before a fork")
        if not self._state.begun_ns:
            raise ServiceError(f"{self.segment.path}: commit without begin would publish an old sample as a new one")
        acquired_ns, flags = operator.index(acquired_ns), operator.index(flags)
        if acquired_ns > _MOST_NS or not 0 <= flags <= _ALL_FLAGS:
            raise ValueError(f"{self.segment.path}: a frame has 63 bits for acquired_ns ({acquired_ns}), 64 for flags")
        return int(_commit(self._state_at, acquired_ns, flags))

    def wake(self) -> None:
        _wake(self._state_at)

    def count_missed_periods(self, count: int) -> None:
        self._words[MISSED_PERIODS] += count

    def count_lateness(self, late_ns: int) -> None:
        """Add to the histogram of how late periods begin."""
        self._words[_LATENESS + bucket_of(late_ns)] += 1

    def set_state(self, bits: int, on: bool = True) -> None:
        state = self._half_words[STATE]
        self._half_words[STATE] = state | bits if on else state & ~bits
        self.wake()
