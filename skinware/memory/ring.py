"""The ring: one writer that waits for nobody, any number of readers that cannot disturb it.

Slot protocol. Writer: sequence = 0; fence; fill; fence; sequence = n; latest = n; fence; bump the wake word; wake.
Reader: load the sequence; fence; copy the slot; fence; load it again: equal means that the copy is whole. Before it
sleeps: load the wake word; fence; look at latest and state. docs/reference/shared-memory.md has all of it.
"""

from __future__ import annotations

import mmap
import time
from typing import Any, Generic, TypeVar

import numpy as np
import numpy.typing as npt

from skinware.errors import Closed, Overrun, ServiceError
from skinware.memory import _futex, _layout
from skinware.memory._fences import fence
from skinware.memory._segment import Segment
from skinware.memory.statistics import bucket_of
from skinware.realtime import now_ns

COPY_ATTEMPTS = 64
"""How often a reader tries again while the writer overwrites what it copies."""
_LATEST = _layout.LATEST_OFFSET // 8
_MISSED_PERIODS = _layout.MISSED_PERIODS_OFFSET // 8
_WAKE_WORD = _layout.WAKE_WORD_OFFSET // 4
_STATE = _layout.STATE_OFFSET // 4
_SEQUENCE, _ACQUIRED, _PUBLISHED, _FLAGS = range(4)  # 8-byte words of a slot's header
_HEADER_WORDS = _layout.SLOT.itemsize // 8
_STATISTICS = slice(_layout.STATISTICS_OFFSET // 8, _layout.COLUMN_OFFSET // 8)
_TIMED, _WALL, _CPU, _AGE = 0, 1, 4, 8  # words of the statistics: count, two times (best, worst, total), histograms
_LATENESS = _AGE + _layout.HISTOGRAM_BUCKETS


class Frame:
    """One published frame: a private copy, or (from ``view``) the ring's own memory.

    Attributes:
        generation: which incarnation of the service it belongs to.
        sequence: 1, 2, 3 ... within the generation.
        acquired_ns: newest time stamp of the data in it, CLOCK_MONOTONIC ns.
        published_ns: when the writer handed it out, CLOCK_MONOTONIC ns.
        flags: bits for the service's own use.
        period_ns: the writer's nominal period, 0 if it has none.
        stale: the writer was dead when the frame was taken: this is its last word.
        context: what the reader knows of the service (for a driver: its structure).
    """

    __slots__ = (
        "_columns",
        "_data",
        "_words",
        "acquired_ns",
        "context",
        "flags",
        "generation",
        "period_ns",
        "published_ns",
        "sequence",
        "stale",
    )

    def __init__(
        self,
        ring: RingReader[Any],
        data: bytearray | memoryview,
        sequence: int,
        words: memoryview,
    ) -> None:
        self._data = data
        self._words = words if type(data) is memoryview else None
        self._columns = ring.columns
        self.context: object = ring.context
        self.generation: int = ring.generation
        self.period_ns: int = ring.period_ns
        self.sequence: int = sequence
        self.acquired_ns: int = words[_ACQUIRED]
        self.published_ns: int = words[_PUBLISHED]
        self.flags: int = words[_FLAGS]
        self.stale: bool = False

    @property
    def position(self) -> tuple[int, int]:
        """Generation and sequence, as ``newer_than`` takes them."""
        return self.generation, self.sequence

    @property
    def age_ns(self) -> int:
        """How old the newest data in it is now, ns."""
        return now_ns() - self.acquired_ns

    @property
    def valid(self) -> bool:
        """Whether the writer has left the memory alone so far; always True for a copy."""
        if self._words is None:
            return True
        fence()
        return bool(self._words[_SEQUENCE] == self.sequence)

    def column(self, name: str) -> npt.NDArray[Any]:
        """One column of the frame, a view of its memory.

        Raises:
            KeyError: no column of that name.
        """
        try:
            shape, dtype, offset = self._columns[name]
        except KeyError:
            raise KeyError(f"no column {name!r}; there are {', '.join(self._columns)}") from None
        return np.ndarray(shape, dtype, self._data, offset)

    def __repr__(self) -> str:
        age_ms = self.age_ns / 1e6
        return f"<{type(self).__name__} {self.sequence} of generation {self.generation}, {age_ms:.1f} ms old>"


F = TypeVar("F", bound=Frame)


class RingReader(Generic[F]):
    """A reader's end of one generation: reads only, takes no lock, is not known to the writer.

    Args:
        segment: the attached generation.
        frame_class: class of the frames it hands out.
        context: what every frame carries as ``context``.
    """

    def __init__(self, segment: Segment, frame_class: type[F], context: object = None) -> None:
        layout = segment.layout
        self._frame_class = frame_class
        self.context = context
        self.columns: dict[str, tuple[tuple[int, ...], np.dtype[Any], int]] = segment.slot_formats()
        self.segment = segment
        self.generation: int = segment.generation
        self.period_ns: int = int(segment.header["period_ns"])
        self._words = memoryview(segment.data).cast("Q")  # type: ignore[arg-type]
        self._half_words = memoryview(segment.data).cast("I")  # type: ignore[arg-type]
        self.wake_word: _futex.Word = _futex.Word(segment.data, _layout.WAKE_WORD_OFFSET)
        self._count = layout.slot_count
        self._slots = _slots(segment)
        self._slot_words = _slot_headers(segment)

    @property
    def latest(self) -> int:
        """Sequence of the newest frame, 0 before the first."""
        return self._words[_LATEST]

    @property
    def slot_count(self) -> int:
        """Slots in the ring."""
        return self._count

    @property
    def state(self) -> int:
        """``STATE_*`` bits."""
        return self._half_words[_STATE]

    @property
    def wake_count(self) -> int:
        """Present value of the futex word; take it before looking at ``latest`` or ``state``."""
        count = self._half_words[_WAKE_WORD]
        fence()
        return count

    def sleep(self, wake_count: int, latest: int, timeout_ns: int) -> bool:
        """Sleep until the futex word is another than ``wake_count``, or the time is up; may return early.

        Returns:
            Whether the newest frame is another than ``latest`` now.
        """
        self.wake_word.wait(wake_count, timeout_ns)
        return self._words[_LATEST] != latest

    def copy(self, sequence: int | None = None) -> F | None:
        """A private copy of a frame.

        Args:
            sequence: which one; default: the newest.

        Returns:
            None if nothing was published yet, or the frame asked for is no longer in the ring.

        Raises:
            Overrun: the newest frame was overwritten while it was copied, 64 times in a row.
        """
        if sequence is not None:
            return self._copy(sequence)
        for _ in range(COPY_ATTEMPTS):
            latest = self.latest
            if latest == 0:
                return None
            frame = self._copy(latest)
            if frame is not None:
                return frame
        raise Overrun(
            f"{self.segment.path}: the writer was faster {COPY_ATTEMPTS} times in a row; "
            f"give the service more slots (it has {self._count}) or publish less often"
        )

    def _copy(self, sequence: int) -> F | None:
        slot = sequence % self._count
        words = self._slot_words[slot]
        if words[_SEQUENCE] != sequence:
            return None
        fence()
        frame = self._frame_class(self, bytearray(self._slots[slot]), sequence, words)
        fence()
        return frame if words[_SEQUENCE] == sequence else None

    @property
    def missed_periods(self) -> int:
        """Periods that the writer missed."""
        return self._words[_MISSED_PERIODS]

    def publication_times_ns(self) -> list[int]:
        """When the frames that the ring still holds were published, oldest first."""
        return [time_ns for _, time_ns in self._times_ns(_PUBLISHED)]

    def acquisition_times_ns(self) -> list[tuple[int, int]]:
        """(sequence, ``acquired_ns``) of the frames that the ring still holds, oldest first."""
        return self._times_ns(_ACQUIRED)

    def _times_ns(self, word: int) -> list[tuple[int, int]]:
        times = []
        latest = self.latest
        for sequence in range(max(1, latest - self._count + 2), latest + 1):
            words = self._slot_words[sequence % self._count]
            time_ns = words[word]
            fence()
            if words[_SEQUENCE] == sequence:
                times.append((sequence, time_ns))
        return times

    def view(self) -> F | None:
        """The newest frame in place, without a copy; ask ``frame.valid`` after using it."""
        for _ in range(COPY_ATTEMPTS):
            wanted = self.latest
            if wanted == 0:
                return None
            slot = wanted % self._count
            frame = self._frame_class(self, self._slots[slot], wanted, self._slot_words[slot])
            if frame.valid:
                return frame
        raise Overrun(f"{self.segment.path}: the writer was faster {COPY_ATTEMPTS} times in a row")


class RingWriter:
    """The writer's end of one generation. Not for several threads at once."""

    def __init__(self, segment: Segment) -> None:
        layout = segment.layout
        self.segment = segment
        self._words = memoryview(segment.data).cast("Q")  # type: ignore[arg-type]
        self._half_words = memoryview(segment.data).cast("I")  # type: ignore[arg-type]
        self._wake_word = _futex.Word(segment.data, _layout.WAKE_WORD_OFFSET)
        self._count = layout.slot_count
        self._slot_words = _slot_headers(segment)
        self._columns = [
            {name: np.ndarray(*where[:2], slot, where[2]) for name, where in segment.slot_formats().items()}
            for slot in _slots(segment)
        ]
        self._contents = [slot[_layout.SLOT.itemsize :] for slot in _slots(segment)]
        self._statistics = self._words[_STATISTICS]
        self._begun_ns, self._cpu_ns = 0, time.thread_time_ns()
        self.sequence: int = 0
        for page in range(0, layout.file_size, mmap.PAGESIZE):
            segment.data[page] = segment.data[page]  # touch every page now, not in the middle of a period

    def begin(self, *, from_last: bool = False) -> dict[str, npt.NDArray[Any]]:
        """The columns of the next slot, to be filled; they hold an old frame.

        Until ``commit``, readers of that old frame are told that it is gone.

        Args:
            from_last: copy the newest frame into it first, for writers that change parts only.
        """
        if self.segment.descriptor.fd < 0:
            raise Closed(f"{self.segment.path}: this writer was closed, or belongs to the process before a fork")
        slot = (self.sequence + 1) % self._count
        self._begun_ns = now_ns()
        self._slot_words[slot][_SEQUENCE] = 0
        fence()
        if from_last and self.sequence:
            self._contents[slot][:] = self._contents[self.sequence % self._count]
        return self._columns[slot]

    def commit(self, acquired_ns: int, flags: int = 0) -> int:
        """Publish what was filled in since ``begin`` and wake all readers with one system call.

        Args:
            acquired_ns: newest time stamp of the data, CLOCK_MONOTONIC ns.
            flags: bits for the service's own use.

        Returns:
            The frame's sequence.

        Raises:
            Closed: this writer was closed since ``begin``, or belongs to the process before a fork.
            ServiceError: there was no ``begin`` before it: the slot holds an old frame.
        """
        if self.segment.descriptor.fd < 0:
            raise Closed(f"{self.segment.path}: this writer was closed, or belongs to the process before a fork")
        if not self._begun_ns:
            raise ServiceError(f"{self.segment.path}: commit without begin would publish an old frame as a new one")
        sequence = self.sequence + 1
        words = self._slot_words[sequence % self._count]
        published_ns = now_ns()
        words[_ACQUIRED] = acquired_ns
        words[_PUBLISHED] = published_ns
        words[_FLAGS] = flags
        fence()
        words[_SEQUENCE] = sequence
        self._words[_LATEST] = sequence
        self.sequence = sequence
        self.wake()
        self._note(published_ns, acquired_ns)
        return sequence

    def wake(self) -> None:
        """Wake everybody who waits for this generation."""
        fence()  # who sees the new word sees what it is about; the system call itself orders the word
        self._half_words[_WAKE_WORD] = (self._half_words[_WAKE_WORD] + 1) & 0xFFFF_FFFF
        self._wake_word.wake_all()

    def count_missed_periods(self, count: int) -> None:
        """Add to the number of periods that this writer missed, for everybody to see."""
        self._words[_MISSED_PERIODS] += count

    def count_lateness(self, late_ns: int) -> None:
        """Tell how late a period began."""
        self._statistics[_LATENESS + bucket_of(late_ns)] += 1

    def _note(self, published_ns: int, acquired_ns: int) -> None:
        """Statistics of one publication, after the readers have been woken."""
        words = self._statistics
        words[_AGE + bucket_of(published_ns - acquired_ns)] += 1
        words[_TIMED] = timed = words[_TIMED] + 1
        cpu_ns = time.thread_time_ns()
        passed_ns = max(0, cpu_ns - self._cpu_ns)  # below 0 if another thread publishes now
        self._cpu_ns = cpu_ns
        wall_ns, self._begun_ns = published_ns - self._begun_ns, 0
        for first, value_ns in ((_WALL, wall_ns), (_CPU, passed_ns)):
            if value_ns < words[first] or timed == 1:
                words[first] = value_ns
            if value_ns > words[first + 1]:
                words[first + 1] = value_ns
            words[first + 2] += value_ns

    def set_state(self, state: int) -> None:
        """Replace the ``STATE_*`` bits and wake everybody."""
        self._half_words[_STATE] = state
        self.wake()


def _slots(segment: Segment) -> list[memoryview]:
    """The bytes of every slot, its header and its columns, in place."""
    layout = segment.layout
    starts = range(layout.slot_offset, layout.slot_offset + layout.slot_count * layout.slot_stride, layout.slot_stride)
    return [memoryview(segment.data)[start : start + layout.slot_stride] for start in starts]  # type: ignore[arg-type]


def _slot_headers(segment: Segment) -> list[memoryview]:
    """The 8-byte words of every slot's header, in place."""
    return [slot.cast("Q")[:_HEADER_WORDS] for slot in _slots(segment)]
