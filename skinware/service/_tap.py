"""What this package's own loops over many readers need of each, and programs do not."""

from __future__ import annotations

from typing import Any

from skinware.errors import Overrun
from skinware.memory.futex import Word
from skinware.memory.ring import FrameT, RingReader
from skinware.realtime import now_ns
from skinware.service._attachment import GENERATION_ENDED
from skinware.service._reader import ServiceReader


def wake_word_of(reader: ServiceReader[Any]) -> tuple[Word, int]:
    """The futex that every publication wakes, and its present value; take it before looking for what is new."""
    ring = reader._ring  # noqa: SLF001
    return ring.wake_word, ring.wake_count


class Tap(ServiceReader[FrameT]):
    """A reader whose owner looks for new generations and for the dead, and waits for many readers at once."""

    @property
    def moved_on(self) -> bool:
        """Whether the writer closed the generation at hand or went over to another; who was killed tells nothing."""
        return bool(self._ring.state & GENERATION_ENDED)

    @property
    def inode(self) -> tuple[int, int]:
        """Device and number of the file that is being read."""
        return self._ring.segment.inode

    @property
    def period_ns(self) -> int:
        """The writer's nominal period, 0 if it has none."""
        return self._ring.period_ns

    def ring_in_c(self) -> RingReader[FrameT]:
        """The ring, whose next turns are left to C, where there is C."""
        if not self._turns_in_c:
            self._go_round_in_c()
        return self._ring

    def tell(self) -> None:
        """Add up what was taken in C and tell everybody, if that is due."""
        if now_ns() >= self._accounts.due_ns:
            self._settle()
            self._accounts.end_turn(None)

    def newest(self) -> FrameT:
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

    def nearest(self, time_ns: int) -> FrameT:
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
