"""Recorded frames: those that programs know, at the time at which they were."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from skinware.driver_snapshot import DriverSnapshot
from skinware.memory.ring import Sample
from skinware.snapshot import Snapshot
from skinware.transfer.codec import Run
from skinware.transfer.generation import Generation


class RecordedSample(Sample):
    """A recorded frame of a service. Its age is the one that it had when it was published."""

    __slots__ = ()

    @property
    def age_ns(self) -> int:
        """How old the newest data in it was when it was published, ns."""
        return self.published_ns - self.acquired_ns


class RecordedDriverFrame(RecordedSample, DriverSnapshot):
    """A recorded frame of a driver."""

    __slots__ = ()

    def fresh(
        self, type_name: str, *, max_age_s: float | None = None, at_ns: int | None = None
    ) -> npt.NDArray[np.bool_]:
        """As of a live frame, at the moment at which it was published."""
        return super().fresh(type_name, max_age_s=max_age_s, at_ns=self.published_ns if at_ns is None else at_ns)


@dataclass(frozen=True, eq=False)
class RecordedSnapshot(Snapshot):
    """The newest frame of every driver at one moment of a recording.

    Attributes:
        at_ns: the moment: when the newest of them was published, CLOCK_MONOTONIC of the machine that recorded.
        time_s: the same, s since the recording began.
    """

    at_ns: int
    time_s: float

    def fresh(
        self, type_name: str, *, max_age_s: float | None = None, at_ns: int | None = None
    ) -> npt.NDArray[np.bool_]:
        """As of a live snapshot, at its moment."""
        return super().fresh(type_name, max_age_s=max_age_s, at_ns=self.at_ns if at_ns is None else at_ns)


def frames_of(generation: Generation, run: Run) -> Iterator[RecordedSample]:
    """The frames of a run; they share one piece of memory."""
    for slot in run.decode_slots(generation.slot_stride):
        yield frame_of(generation, slot)


def frame_of(generation: Generation, slot: npt.NDArray[np.uint8]) -> RecordedSample:
    """The frame that stands in (stride,) bytes, as it was in the ring."""
    return (RecordedDriverFrame if generation.is_driver else RecordedSample)(generation, memoryview(slot.data))
