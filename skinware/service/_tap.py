"""What this package's own loops over many readers need of each, and programs do not."""

from __future__ import annotations

from typing import Any

from skinware.errors import Overrun, ServiceTimeout
from skinware.memory.futex import Word
from skinware.memory.ring import SampleT
from skinware.memory.ring_reader import RingReader
from skinware.realtime import now_ns
from skinware.service._attachment import GENERATION_ENDED
from skinware.service._reader import ServiceReader
from skinware.service._taking import Position


def wake_word_of(reader: ServiceReader[Any]) -> tuple[Word, int]:
    """The futex that every publication wakes, and its present value; take it before looking for what is new."""
    ring = reader._ring  # noqa: SLF001
    return ring.wake_word, ring.wake_count


class Tap(ServiceReader[SampleT]):
    """A reader whose owner looks for new generations and for the dead, and waits for many readers at once."""

    @property
    def moved_on(self) -> bool:
        """Whether the writer closed the generation at hand or went over to another; who was killed tells nothing."""
        return bool(self._ring.state & GENERATION_ENDED)

    @property
    def head(self) -> bytes:
        """Of the file that is being read: all up to its slots."""
        return self._ring.segment.head

    @property
    def inode(self) -> tuple[int, int]:
        """Device and number of the file that is being read."""
        return self._ring.segment.inode

    @property
    def period_ns(self) -> int:
        """The writer's nominal period, 0 if it has none."""
        return self._ring.period_ns

    @property
    def slack_ns(self) -> int:
        """How long it takes the writer to go round its ring at its nominal rate, 0 if it has none."""
        return self._ring.period_ns * self._ring.slot_count

    def ring_in_c(self) -> RingReader[SampleT]:
        if not self._turns_in_c:
            self._leave_to_c()
        return self._ring

    def tell(self) -> None:
        """Add up what was taken in C and tell everybody, if that is due."""
        if now_ns() >= self._accounts.due_ns:
            self._settle()
            self._accounts.end_turn(None)

    @property
    def last_taken(self) -> Position | None:
        return self._last

    def begin_in_order(self, *, with_first: bool) -> None:
        """Read in order from now on.

        Args:
            with_first: begin with the first frame of the generation at hand, otherwise with the one that is its newest
                now. What is overwritten before it is taken is lost.
        """
        self._accounts.begin_loop("in order")
        self._last = (self._ring.generation, 0 if with_first else max(0, self._ring.latest - 1))

    def next_in_order(self) -> SampleT | None:
        """The frame after the one that was taken last, over generations; None if it is not there yet. Never waits.

        Raises:
            StructureChanged, Overrun, Closed: as ``in_order``.
        """
        try:
            return self._read_in_order(0)
        except ServiceTimeout:
            return None

    def newest(self) -> SampleT:
        """A copy of the newest frame of the generation at hand.

        Raises:
            ServiceTimeout: nothing was published yet.
            Overrun: the writer is too fast for this number of slots.
        """
        return self._newest_now(self._ring.copy, True)

    def newest_acquired_ns(self) -> int:
        """``acquired_ns`` of the newest frame.

        Raises:
            Overrun: it was overwritten meanwhile, or nothing was published yet.
        """
        return self._acquisitions()[-1][1]

    def nearest(self, time_ns: int) -> SampleT:
        """A copy of the frame, among those that the ring still holds, whose ``acquired_ns`` is nearest to a time.

        Raises:
            Overrun: it was overwritten meanwhile, or nothing was published yet.
        """
        sequence, _ = min(self._acquisitions(), key=lambda frame: abs(frame[1] - time_ns))
        frame = self._ring.copy(sequence)
        if frame is None:
            raise Overrun(f"service {self.name!r}: frame {sequence} was overwritten before it was copied")
        before = self._last
        taken = self._newest_now(lambda: frame, True)
        if before is not None and before > taken.position:  # it came before, and is not lost again
            self._last = before
        return taken

    def _acquisitions(self) -> list[tuple[int, int]]:
        times = self._ring.acquisition_times_ns()
        if not times:
            raise Overrun(f"service {self.name!r}: no frame could be read")
        return times
