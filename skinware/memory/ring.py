"""The ring: one writer that waits for nobody, any number of readers that cannot disturb it.

Slot protocol. Writer: sequence = 0; fence; fill; fence; sequence = n; latest = n; wake. Reader: load the sequence;
fence; copy the slot; fence; load it again: equal means that the copy is whole.
"""

from __future__ import annotations

import mmap
from typing import Any, Generic, TypeVar

import numpy as np
import numpy.typing as npt

from skinware.errors import Closed, Overrun
from skinware.memory import _futex, _layout
from skinware.memory._fences import fence
from skinware.memory._segment import Segment
from skinware.realtime import now_ns

_COPY_ATTEMPTS = 64
_LATEST = _layout.LATEST_OFFSET // 8
_MISSED_PERIODS = _layout.MISSED_PERIODS_OFFSET // 8
_WAKE_WORD = _layout.WAKE_WORD_OFFSET // 4
_STATE = _layout.STATE_OFFSET // 4
_SEQUENCE, _ACQUIRED, _PUBLISHED, _FLAGS = range(4)  # 8-byte words of a slot's header


class Frame:
    """One published frame: a private copy, or (from ``view``) the ring's own memory.

    Attributes:
        generation: which incarnation of the service it belongs to.
        sequence: 1, 2, 3 ... within the generation.
        acquired_ns: newest time stamp of the data in it, CLOCK_MONOTONIC ns.
        published_ns: when the writer handed it out, CLOCK_MONOTONIC ns.
        flags: bits for the service's own use.
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
        "published_ns",
        "sequence",
        "stale",
    )

    def __init__(
        self,
        data: npt.NDArray[np.uint8],
        words: memoryview,
        ring: RingReader[Any],
        sequence: int,
    ) -> None:
        self._data = data
        self._words = words
        self._columns = ring.columns
        self.context = ring.context
        self.generation = ring.generation
        self.sequence = sequence
        self.acquired_ns: int = words[_ACQUIRED]
        self.published_ns: int = words[_PUBLISHED]
        self.flags: int = words[_FLAGS]
        self.stale = False

    @property
    def position(self) -> tuple[int, int]:
        """(generation, sequence): what ``newer_than`` takes."""
        return self.generation, self.sequence

    @property
    def age_ns(self) -> int:
        """How old the newest data in it is now, ns."""
        return now_ns() - self.acquired_ns

    @property
    def valid(self) -> bool:
        """Whether the writer has left the memory alone so far; always True for a copy."""
        fence()
        return bool(self._words[_SEQUENCE] == self.sequence)

    def column(self, name: str) -> npt.NDArray[Any]:
        """One column of the frame, a view of its memory.

        Raises:
            KeyError: no column of that name.
        """
        column = self._columns[name]
        return self._data[column.offset : column.offset + column.dtype.itemsize * column.count].view(column.dtype)

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
        self.columns = {column.name: column for column in layout.slot}
        self.segment = segment
        self.generation = segment.generation
        self._words = memoryview(segment.data).cast("Q")  # type: ignore[arg-type]
        self._half_words = memoryview(segment.data).cast("I")  # type: ignore[arg-type]
        self._wake_address = segment.address(_layout.WAKE_WORD_OFFSET)
        self._count, self._first, self._stride = layout.slot_count, layout.slot_offset, layout.slot_stride

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

    def wake_word(self) -> tuple[int, int]:
        """(address, present value) of the futex word; take it before looking at ``latest``."""
        return self._wake_address, self._half_words[_WAKE_WORD]

    def copy(self, sequence: int | None = None) -> F | None:
        """A private copy of a frame.

        Args:
            sequence: which one; default: the newest.

        Returns:
            None if nothing was published yet, or the frame asked for is no longer in the ring.

        Raises:
            Overrun: the newest frame was overwritten while it was copied, 64 times in a row.
        """
        for _ in range(_COPY_ATTEMPTS):
            wanted = self.latest if sequence is None else sequence
            if wanted == 0:
                return None
            start = self._first + (wanted % self._count) * self._stride
            if self._words[start // 8] == wanted:
                fence()
                data = self.segment.data[start : start + self._stride].copy()
                fence()
                if self._words[start // 8] == wanted:
                    words = memoryview(data).cast("Q")  # type: ignore[arg-type]
                    return self._frame_class(data, words, self, wanted)
            if sequence is not None:
                return None
        raise Overrun(
            f"{self.segment.path}: the writer was faster {_COPY_ATTEMPTS} times in a row; "
            f"give the service more slots (it has {self._count}) or publish less often"
        )

    @property
    def missed_periods(self) -> int:
        """Periods that the writer missed."""
        return self._words[_MISSED_PERIODS]

    def publication_times_ns(self) -> list[int]:
        """When the frames that the ring still holds were published, oldest first."""
        times = []
        latest = self.latest
        for sequence in range(max(1, latest - self._count + 2), latest + 1):
            word = (self._first + sequence % self._count * self._stride) // 8
            time_ns = self._words[word + _PUBLISHED]
            fence()
            if self._words[word] == sequence:
                times.append(time_ns)
        return times

    def view(self) -> F | None:
        """The newest frame in place, without a copy; ask ``frame.valid`` after using it."""
        for _ in range(_COPY_ATTEMPTS):
            wanted = self.latest
            if wanted == 0:
                return None
            start = self._first + (wanted % self._count) * self._stride
            words = self._words[start // 8 : (start + _layout.SLOT.itemsize) // 8]
            frame = self._frame_class(self.segment.data[start : start + self._stride], words, self, wanted)
            if frame.valid:
                return frame
        raise Overrun(f"{self.segment.path}: the writer was faster {_COPY_ATTEMPTS} times in a row")


class RingWriter:
    """The writer's end of one generation. Not for several threads at once."""

    def __init__(self, segment: Segment) -> None:
        layout = segment.layout
        self.segment = segment
        self._words = memoryview(segment.data).cast("Q")  # type: ignore[arg-type]
        self._half_words = memoryview(segment.data).cast("I")  # type: ignore[arg-type]
        self._wake_address = segment.address(_layout.WAKE_WORD_OFFSET)
        self._count, self._first, self._stride = layout.slot_count, layout.slot_offset, layout.slot_stride
        self._columns = [
            {
                column.name: segment.view(self._first + i * self._stride + column.offset, column.dtype, column.count)
                for column in layout.slot
            }
            for i in range(self._count)
        ]
        self.sequence = 0
        for page in range(0, layout.file_size, mmap.PAGESIZE):
            segment.data[page] = segment.data[page]  # touch every page now, not in the middle of a period

    def begin(self) -> dict[str, npt.NDArray[Any]]:
        """The columns of the next slot, to be filled; they hold an old frame.

        Until ``commit``, readers of that old frame are told that it is gone.
        """
        if self.segment.descriptor.fd < 0:
            raise Closed(f"{self.segment.path}: this writer was closed, or belongs to the process before a fork")
        slot = (self.sequence + 1) % self._count
        self._words[(self._first + slot * self._stride) // 8] = 0
        fence()
        return self._columns[slot]

    def commit(self, acquired_ns: int, flags: int = 0) -> int:
        """Publish what was filled in since ``begin`` and wake all readers with one system call.

        Args:
            acquired_ns: newest time stamp of the data, CLOCK_MONOTONIC ns.
            flags: bits for the service's own use.

        Returns:
            The frame's sequence.
        """
        sequence = self.sequence + 1
        words = self._words
        word = (self._first + sequence % self._count * self._stride) // 8
        words[word + _ACQUIRED] = acquired_ns
        words[word + _PUBLISHED] = now_ns()
        words[word + _FLAGS] = flags
        fence()
        words[word] = sequence
        words[_LATEST] = sequence
        self.sequence = sequence
        self.wake()
        return sequence

    def wake(self) -> None:
        """Wake everybody who waits for this generation."""
        self._half_words[_WAKE_WORD] = (self._half_words[_WAKE_WORD] + 1) & 0xFFFF_FFFF
        fence()
        _futex.wake_all(self._wake_address)

    def count_missed_periods(self, count: int) -> None:
        """Add to the number of periods that this writer missed, for everybody to see."""
        self._words[_MISSED_PERIODS] += count

    def set_state(self, state: int) -> None:
        """Replace the ``STATE_*`` bits and wake everybody."""
        self._half_words[_STATE] = state
        self.wake()
