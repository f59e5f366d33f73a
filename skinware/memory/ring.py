"""The ring: one writer that waits for nobody, any number of readers that cannot disturb it.

Slot protocol. Writer: sequence = 0; fence; fill; fence; sequence = n; latest = n; fence; bump the wake word; wake.
Reader: load the sequence; fence; copy the slot; fence; load it again: equal means that the copy is whole. Before it
sleeps: load the wake word; fence; look at latest and state. docs/reference/shared-memory.md has all of it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Generic, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from skinware.errors import Overrun
from skinware.memory import file_layout, futex
from skinware.memory.futex import fence
from skinware.memory.segments import Segment
from skinware.realtime import now_ns

COPY_ATTEMPTS = 64
"""How often a reader tries again while the writer overwrites what it copies."""
LATEST = file_layout.LATEST_OFFSET // 8
MISSED_PERIODS = file_layout.MISSED_PERIODS_OFFSET // 8
AHEAD = file_layout.AHEAD_OFFSET // 8
WAKE_WORD = file_layout.WAKE_WORD_OFFSET // 4
STATE = file_layout.STATE_OFFSET // 4
SEQUENCE, ACQUIRED, PUBLISHED, FLAGS = range(4)  # 8-byte words of a slot's header
_HEADER_WORDS = file_layout.SLOT.itemsize // 8


class FrameSource(Protocol):
    """What a frame is of: a generation that is read live, or one that was recorded."""

    context: object

    @property
    def columns(self) -> dict[str, tuple[tuple[int, ...], np.dtype[Any], int]]:
        """(shape, dtype, offset in the slot) of every column, by name."""

    @property
    def generation(self) -> int:
        """Its number."""

    @property
    def period_ns(self) -> int:
        """The writer's nominal period, 0 if it has none."""


class Sample:
    """One published frame: a private copy, or (from ``view``) the ring's own memory.

    Copies that were made in one look share a piece of memory, which lives as long as any of them or of their arrays.

    Attributes:
        generation: which incarnation of the service it belongs to.
        period_ns: the writer's nominal period, 0 if it has none.
        stale: the writer was dead when the frame was taken: this is its last word.
        context: what the reader knows of the service (for a driver: its structure).
    """

    __slots__ = ("_columns", "_data", "_header", "_in_ring", "_start", "context", "generation", "period_ns", "stale")

    def __init__(
        self,
        source: FrameSource,
        data: bytearray | memoryview,
        in_ring: memoryview | None = None,
        start: int = 0,
    ) -> None:
        self._data = data
        self._start = start
        self._in_ring = in_ring
        self._header = memoryview(data)[start:].cast("Q") if in_ring is None else in_ring.tolist()
        self._columns = source.columns
        self.context: object = source.context
        self.generation: int = source.generation
        self.period_ns: int = source.period_ns
        self.stale: bool = False

    @property
    def sequence(self) -> int:
        """1, 2, 3 ... within the generation."""
        return self._header[SEQUENCE]

    @property
    def acquired_ns(self) -> int:
        """Newest time stamp of the data in it, CLOCK_MONOTONIC ns."""
        return self._header[ACQUIRED]

    @property
    def published_ns(self) -> int:
        """When the writer handed it out, CLOCK_MONOTONIC ns."""
        return self._header[PUBLISHED]

    @property
    def flags(self) -> int:
        """Bits for the service's own use."""
        return self._header[FLAGS]

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
        if self._in_ring is None:
            return True
        fence()
        return bool(self._in_ring[SEQUENCE] == self.sequence)

    @property
    def slot(self) -> memoryview:
        """Its bytes as they stand in the ring: the slot's header and its columns."""
        return memoryview(self._data)[self._start :]

    def column(self, name: str) -> npt.NDArray[Any]:
        """One column of the frame, a view of its memory.

        Raises:
            KeyError: no column of that name.
        """
        try:
            shape, dtype, offset = self._columns[name]
        except KeyError:
            raise KeyError(f"no column {name!r}; there are {', '.join(self._columns)}") from None
        return np.ndarray(shape, dtype, self._data, self._start + offset)

    def __repr__(self) -> str:
        age_ms = self.age_ns / 1e6
        return f"<{type(self).__name__} {self.sequence} of generation {self.generation}, {age_ms:.1f} ms old>"


if TYPE_CHECKING:
    from typing_extensions import TypeVar

    SampleT = TypeVar("SampleT", bound=Sample, default=Sample)  # so that a reader of plain frames needs no annotation
else:
    from typing import TypeVar

    SampleT = TypeVar("SampleT", bound=Sample)


class Turn(NamedTuple):
    """One turn of a loop that takes frames.

    Attributes:
        acquired_ns: of its frame.
        taken_ns: when that was handed out.
        ended_ns: when the loop came back.
        cpu_ns: CPU time of the thread then; 0 if it was not asked for.
    """

    acquired_ns: int
    taken_ns: int
    ended_ns: int
    cpu_ns: int


class Turns(NamedTuple):
    """What came of turns in C.

    Attributes:
        frames: that were taken.
        lost: frames that were not taken.
        last: sequence of the last one.
        over: the turns that are over.
    """

    frames: int
    lost: int
    last: int
    over: list[Turn]


class RingReader(Generic[SampleT]):
    """A reader's end of one generation: reads only, takes no lock, is not known to the writer.

    Args:
        segment: the attached generation.
        frame_class: class of the frames it hands out.
        context: what every frame carries as ``context``.
    """

    def __init__(self, segment: Segment, frame_class: type[SampleT], context: object = None) -> None:
        layout = segment.layout
        self._frame_class = frame_class
        self.context = context
        self.columns: dict[str, tuple[tuple[int, ...], np.dtype[Any], int]] = segment.slot_formats()
        self.segment = segment
        self.generation: int = segment.generation
        self.period_ns: int = int(segment.header["period_ns"])
        self._words = segment.data.data.cast("Q")
        self._half_words = segment.data.data.cast("I")
        self.wake_word: futex.Word = futex.Word(segment.data, file_layout.WAKE_WORD_OFFSET)
        self._count = layout.slot_count
        self._slots = slots_of(segment)
        self._slot_words = slot_headers_of(segment)

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
        return self._count

    @property
    def state(self) -> int:
        return self._half_words[STATE]

    @property
    def wake_count(self) -> int:
        """Present value of the futex word; take it before looking at ``latest`` or ``state``."""
        count = self._half_words[WAKE_WORD]
        fence()
        return count

    def wait(self, wake_count: int, latest: int, timeout_ns: int, sequence: int | None = None) -> SampleT | None:
        """Sleep until the futex word is another than ``wake_count``, or the time is up; may return early.

        Returns:
            A copy, as of ``copy(sequence)``, if the newest frame is another than ``latest`` then.

        Raises:
            Overrun: as ``copy``.
        """
        self.wake_word.wait(wake_count, timeout_ns)
        return self.copy(sequence) if self.latest != latest else None

    def copy(self, sequence: int | None = None) -> SampleT | None:
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
        raise self._overrun()

    def _overrun(self) -> Overrun:
        if not self.segment.writer_lives():
            return Overrun(
                f"{self.segment.path}: its writer is dead, and its newest frame is not whole; start it again"
            )
        return Overrun(
            f"{self.segment.path}: the writer was faster {COPY_ATTEMPTS} times in a row; "
            f"give the service more slots (it has {self._count}) or publish less often"
        )

    def _copy(self, sequence: int) -> SampleT | None:
        slot = sequence % self._count
        words = self._slot_words[slot]
        if words[SEQUENCE] != sequence:
            return None
        fence()
        frame = self._frame_class(self, bytearray(self._slots[slot]))
        fence()
        return frame if words[SEQUENCE] == sequence else None

    # -- turns of a loop -------------------------------------------------------------------------------------------
    # Where there is C, a loop that takes frames as they come goes round there, as long as nothing happens but frames.

    def next_turn(self, timeout_ns: int | None, in_order: bool) -> SampleT | None:  # noqa: ARG002, not here
        """The next frame; None if whatever is to be done now has to be done here, as always without C.

        Args:
            timeout_ns: how long the wait for it may take; None: for ever.
            in_order: the one after the one before, not the newest.
        """
        return None

    @property
    def begun_ns(self) -> int:
        """When the wait of the last ``next_turn`` began, CLOCK_MONOTONIC ns; 0 without C."""
        return 0

    def resume_turns(self, last: int, until_ns: int, turn: tuple[int, int] | None) -> bool:  # noqa: ARG002, not here
        """Begin to take turns in C, where there is C.

        Args:
            last: sequence of the frame that was taken last.
            until_ns: when something else is to be done at the latest.
            turn: ``acquired_ns`` of that frame and when it was handed out; None if its turn is over.

        Returns:
            Whether there is C.
        """
        return False

    def settle_turns(self) -> Turns | None:
        """What came of turns in C since the last call, None if there were none."""
        return None

    def end_turn(self) -> tuple[int, int] | None:
        """``acquired_ns`` of the frame that C handed out last and when that was; None if its turn is over."""
        return None

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
        for sequence in range(max(1, latest - self._count + 2), latest + 1):
            words = self._slot_words[sequence % self._count]
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
            slot = wanted % self._count
            frame = self._frame_class(self, self._slots[slot], self._slot_words[slot])
            if frame.sequence == wanted and frame.valid:
                return frame
        raise self._overrun()


def slots_of(segment: Segment) -> list[memoryview]:
    """The bytes of every slot, its header and its columns, in place."""
    layout = segment.layout
    starts = range(layout.slot_offset, layout.slot_offset + layout.slot_count * layout.slot_stride, layout.slot_stride)
    return [segment.data.data[start : start + layout.slot_stride] for start in starts]


def slot_headers_of(segment: Segment) -> list[memoryview]:
    """The 8-byte words of every slot's header, in place."""
    return [slot.cast("Q")[:_HEADER_WORDS] for slot in slots_of(segment)]
