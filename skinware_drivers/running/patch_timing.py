"""How regularly patches deliver, and how old their data is when users get it: histograms, counted at publication."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from skinware.memory.statistics import BUCKETS
from skinware.structure import Structure


class PatchTiming:
    """Two histograms of every patch, with the buckets of :class:`skinware.memory.statistics.Histogram`.

    Attributes:
        intervals: (n_patches, BUCKETS) int64: time between two updates of a group that were shown in turn.
        ages: (n_patches, BUCKETS) int64: age of a group's update when it was published.
        both: (2, n_patches, BUCKETS) int64: one after the other.
        before_ns: (n_groups,) int64: stamps of what was shown before, 0: nothing.
    """

    def __init__(self, structure: Structure) -> None:
        self.both: npt.NDArray[np.int64] = np.zeros((2, structure.n_patches, BUCKETS), np.int64)
        self.intervals: npt.NDArray[np.int64] = self.both[0]
        self.ages: npt.NDArray[np.int64] = self.both[1]
        self._counts = self.both.reshape(-1)
        self._first_bucket = structure.group_patch.astype(np.intp) * BUCKETS
        self.before_ns = np.zeros(structure.n_groups, np.int64)

    def count(self, updated: npt.NDArray[np.bool_], group_time_ns: npt.NDArray[np.int64], time_ns: int) -> None:
        """Count what a frame shows for the first time.

        Args:
            updated: (n_groups,) bool.
            group_time_ns: (n_groups,) int64, stamps of what the frame shows.
            time_ns: when it is published.
        """
        again = np.flatnonzero(updated & (self.before_ns > 0))
        group = np.flatnonzero(updated)
        shown_ns = group_time_ns[group]
        times_ns = np.concatenate([group_time_ns[again] - self.before_ns[again], time_ns - shown_ns])
        # the exponent of a number of nanoseconds is its length in bits, which is its bucket
        bucket = np.frexp(np.maximum(times_ns, 0).astype(np.float64))[1].astype(np.intp)
        np.minimum(bucket, BUCKETS - 1, out=bucket)
        bucket[: len(again)] += self._first_bucket[again]
        bucket[len(again) :] += self._first_bucket[group] + self.ages.size
        self._counts += np.bincount(bucket, minlength=self._counts.size)
        self.before_ns[group] = shown_ns
