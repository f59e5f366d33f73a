"""The slot protocol once more, in Python: the ring in C is compared with it, and it can be stopped at every line."""

from __future__ import annotations

import os
import time
from typing import Any

import numpy.typing as npt
import pytest

from skinware.errors import ServiceError
from skinware.memory import file_layout, futex
from skinware.memory.futex import fence
from skinware.memory.ring import (
    ACQUIRED,
    AHEAD,
    COPY_ATTEMPTS,
    FLAGS,
    LATEST,
    PUBLISHED,
    SEQUENCE,
    WAKE_WORD,
    SampleT,
    slot_headers_of,
)
from skinware.memory.ring_reader import RingReader, TakeState
from skinware.memory.ring_writer import RingWriter
from skinware.memory.segments import Segment
from skinware.memory.statistics import bucket_of
from skinware.realtime import now_ns
from skinware.service import _attachment, _ownership
from skinware.status import AHEAD_NS

VARIABLE = "SKINWARE_TESTED_RING"
_STATISTICS = slice(file_layout.STATISTICS_OFFSET // 8, file_layout.COLUMN_OFFSET // 8)
_TIMED, _WALL, _CPU, _BEFORE_BOOT, _AGE = 0, 1, 4, 7, 8


class NothingInC:
    """In the place of C: each turn is Python's."""

    def __init__(self) -> None:
        self.state_in_c = TakeState()

    def next(self, wanted: int, timeout_ns: int) -> None:
        self.state_in_c.begun_ns = now_ns()


class SpecifiedReader(RingReader[SampleT]):
    """A reader that copies, waits and goes round in Python."""

    def __init__(self, segment: Segment, frame_class: type[SampleT], context: object = None) -> None:
        super().__init__(segment, frame_class, context)
        self.take: Any = NothingInC()

    def copy(self, sequence: int | None = None) -> SampleT | None:
        if sequence is not None:
            return self._copy(sequence)
        for _ in range(COPY_ATTEMPTS):
            latest = self.latest
            if latest == 0:
                return None
            sample = self._copy(latest)
            if sample is not None:
                return sample
        raise self._overrun()

    def _copy(self, sequence: int) -> SampleT | None:
        slot = sequence % len(self._slots)
        words = self._slot_words[slot]
        if words[SEQUENCE] != sequence:
            return None
        fence()
        sample = self.frame_class(self, bytearray(self._slots[slot]))
        fence()
        return sample if words[SEQUENCE] == sequence else None


class SpecifiedWriter(RingWriter):
    """A writer that publishes in Python."""

    def __init__(self, segment: Segment) -> None:
        super().__init__(segment)
        self._slot_words = slot_headers_of(segment)
        self._wake_word = futex.Word(segment.data, file_layout.WAKE_WORD_OFFSET)
        self._statistics = self._words[_STATISTICS]
        self._begun_ns, self._cpu_ns, self._skipped = 0, time.thread_time_ns(), 0

    @property
    def _next(self) -> int:
        return self.sequence + 1 + self._skipped

    def begin(
        self, *, from_last: bool = False, skip: int = 0, contents: memoryview | None = None
    ) -> dict[str, npt.NDArray[Any]]:
        columns = super().begin(from_last=from_last, skip=skip, contents=contents)
        self._skipped = skip + (self.sequence > 0 and (skip + 1) % self._count == 0)
        self._begun_ns = now_ns()
        return columns

    def commit(self, acquired_ns: int, flags: int = 0) -> int:
        if not self._begun_ns:
            raise ServiceError("commit without begin")
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
        self._words[LATEST] = sequence
        self.wake()
        self._note(begun_ns, published_ns, acquired_ns)
        return sequence

    def wake(self) -> None:
        fence()
        self._half_words[WAKE_WORD] = (self._half_words[WAKE_WORD] + 1) & 0xFFFF_FFFF
        self._wake_word.wake_all()

    def _note(self, begun_ns: int, published_ns: int, acquired_ns: int) -> None:
        words = self._statistics
        if acquired_ns - published_ns > AHEAD_NS:
            self._words[AHEAD] += 1
        words[_AGE + bucket_of(published_ns - acquired_ns)] += 1
        words[_TIMED] = timed = words[_TIMED] + 1
        cpu_ns = time.thread_time_ns()
        passed_ns = max(0, cpu_ns - self._cpu_ns)
        self._cpu_ns = cpu_ns
        for first, value_ns in ((_WALL, published_ns - begun_ns), (_CPU, passed_ns)):
            if value_ns < words[first] or timed == 1:
                words[first] = value_ns
            if value_ns > words[first + 1]:
                words[first + 1] = value_ns
            words[first + 2] += value_ns


def use_specification(patch: pytest.MonkeyPatch) -> None:
    """Make readers and writers of services use the ring in Python, also in processes that a test starts."""
    patch.setenv(VARIABLE, "specification")
    patch.setattr(_attachment, "RingReader", SpecifiedReader)
    patch.setattr(_ownership, "RingWriter", SpecifiedWriter)


def use_ring_of_environment() -> None:
    """In a process that a test started: use the ring that the test uses."""
    specified = os.environ.get(VARIABLE) == "specification"
    vars(_attachment)["RingReader"] = SpecifiedReader if specified else RingReader
    vars(_ownership)["RingWriter"] = SpecifiedWriter if specified else RingWriter
