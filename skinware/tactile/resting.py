"""Measure what taxels read at rest: levels, noise, and the time at an end of their range."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from skinware.realtime import NS_PER_S
from skinware.tactile.calm import Calm

_BLOCKS = 10
_FRAMES = 4
"""Least frames of a block, whatever the rate."""
_ENOUGH = 0.6
"""Of the blocks of a taxel must have its data."""
_MEDIAN_OF_VARIANCE = {4: 0.789, 5: 0.839, 6: 0.870, 7: 0.891, 8: 0.907, 9: 0.918, 10: 0.927}
"""Median of chi-square with m - 1 degrees of freedom, divided by m - 1."""


class Resting(NamedTuple):
    """What was found of k taxels.

    Attributes:
        level: (k,) float32, NaN where there was not enough data.
        noise: (k,) float32, standard deviation from frame to frame.
        range: (k,) float32, between the highest and the lowest level of a tenth of the time.
    """

    level: npt.NDArray[np.float32]
    noise: npt.NDArray[np.float32]
    range: npt.NDArray[np.float32]


class RestingMeasurement:
    """Measures levels and noise of n taxels over the last seconds, in a tenth of them at a time.

    Level and noise are medians of those of the tenths: a touch of a third of the time moves neither, and medians of
    means are finer than the steps of the values, which medians of integers are not.

    Args:
        n: number of taxels.
        seconds: how long; longer if fewer than 4 frames come in a tenth of it.
    """

    def __init__(self, n: int, seconds: float) -> None:
        self._block_ns = round(seconds * NS_PER_S / _BLOCKS)
        self._first: npt.NDArray[np.float32] | None = None
        self._begun_ns = 0
        self._frames = 0
        self._count = np.zeros(n, np.float32)
        self._sum = np.zeros(n, np.float32)
        self._squares = np.zeros(n, np.float32)
        self._levels: deque[npt.NDArray[np.float32]] = deque(maxlen=_BLOCKS)
        self._variances: deque[npt.NDArray[np.float32]] = deque(maxlen=_BLOCKS)

    def add(self, time_ns: int, values: npt.NDArray[np.float32], usable: npt.NDArray[np.bool_]) -> bool:
        """Take a frame in.

        Args:
            time_ns: of the frame.
            values: (n,) finite where usable.
            usable: (n,) which of them count.

        Returns:
            Whether there is something to be found that was not there before: once after all the time, and then again
            after each tenth of it.
        """
        if self._first is None:
            self._first, self._begun_ns = np.where(usable, values, np.nan).astype(np.float32), time_ns
        np.copyto(self._first, values, where=usable & np.isnan(self._first))
        difference = np.where(usable, values - self._first, np.float32(0))  # small, so that its squares are exact
        self._count += usable
        self._sum += difference
        self._squares += difference * difference
        self._frames += 1
        if time_ns - self._begun_ns < self._block_ns or self._frames < _FRAMES:
            return False
        self._end_block(time_ns)
        return len(self._levels) == _BLOCKS

    def result(self, taxels: npt.NDArray[np.intp]) -> Resting:
        """What was found of some taxels in the last tenths.

        Args:
            taxels: (k,) their numbers.
        """
        assert self._first is not None  # noqa: S101 - add() said so
        blocks = (np.array([block[taxels] for block in of_taxels]) for of_taxels in (self._levels, self._variances))
        levels, variances = (np.sort(of_taxels, axis=0) for of_taxels in blocks)  # NaN comes last
        found = np.isfinite(levels).sum(axis=0)
        enough = found >= _ENOUGH * len(levels)
        taxel = np.arange(len(found))
        at = (np.maximum(found - 1, 0) // 2, taxel), (np.minimum(found // 2, len(levels) - 1), taxel)
        level = self._first[taxels] + (levels[at[0]] + levels[at[1]]) / 2
        noise = np.sqrt((variances[at[0]] + variances[at[1]]) / 2)
        spread = levels[np.maximum(found - 1, 0), taxel] - levels[0]
        return Resting(*(np.where(enough, array, np.nan).astype(np.float32) for array in (level, noise, spread)))

    def _end_block(self, time_ns: int) -> None:
        count = np.where(self._count >= _FRAMES, self._count, np.nan).astype(np.float32)
        mean = self._sum / count
        variance = np.maximum(self._squares / count - mean * mean, 0) * (count / (count - 1))
        typical = _MEDIAN_OF_VARIANCE.get(self._frames, 1 - 0.67 / (self._frames - 1))
        self._levels.append(mean)
        self._variances.append(variance / np.float32(typical))
        for total in (self._count, self._sum, self._squares):
            total[:] = 0
        self._begun_ns, self._frames = time_ns, 0


_ENOUGH_FRAMES = 100
"""At least, away from touches, to tell a noise; with fewer its measurement goes on."""
_GROWTH = 1.2
"""So many times a noise may grow from one measurement to the next."""

Floats = npt.NDArray[np.float32]
Flags = npt.NDArray[np.bool_]


class Noise:
    """Measures n taxels again and again, by the differences from frame to frame.

    What presses nearby makes differences too: the least of some measurements counts. What lets go of a taxel whose
    baseline was taken under it (at the start, or by a tare) makes one as large as its load: the taxel falls far below
    its baseline, which follows it there soon. What the taxel did in between does not count.

    Args:
        n: number of taxels.
        measured_s: how long one measurement takes.

    Attributes:
        deviation: (n,) float32, standard deviation, in the unit of the values; NaN before it is known.
        at_end: (n,) float32, share of the time at an end of the range; NaN before it is known.
    """

    def __init__(self, n: int, measured_s: float) -> None:
        self.deviation: Floats = np.full(n, np.nan, np.float32)
        self.at_end: Floats = np.full(n, np.nan, np.float32)
        self._measured_s = measured_s
        self._begun_s = 0.0
        self._was_free = np.zeros(n, bool)
        self._sums: Floats = np.zeros((3, n), np.float32)
        """Of squared differences, of frames, and of those at an end of the range."""
        self._low = np.zeros(n, bool)
        self._stays_low = np.zeros(n, bool)
        """Low since before the last measurement ended: nothing will follow these."""
        self._before_low: Floats = np.zeros((3, n), np.float32)
        """The sums when each taxel fell."""

    def add(self, now_s: float, difference: Floats, at_end: Flags, low: Flags, calm: Calm) -> bool:
        """Take the next frame in.

        Args:
            now_s: its time.
            difference: (n,) of the values from those of the frame before.
            at_end: (n,) which are at an end of the range.
            low: (n,) which are far below their baselines.
            calm: what the baseline made of the frame.

        Returns:
            Whether a measurement ends with it.
        """
        self._note_low(low, calm)
        free = calm.usable & ~calm.touched
        both = free & self._was_free
        self._was_free = free
        difference = np.where(both, difference, np.float32(0))
        squares, frames, ends = self._sums
        squares += difference * difference
        frames += both
        ends += both & at_end
        if now_s - self._begun_s < self._measured_s:
            return False
        self._begun_s = now_s
        self._conclude()
        return True

    def _note_low(self, low: Flags, calm: Calm) -> None:
        """Follow who is low; forget what those did meanwhile whose baselines have followed them."""
        changed = np.flatnonzero((low != self._low) & calm.usable)
        if not len(changed):
            return
        fell = low[changed]
        fallen, back = changed[fell], changed[~fell]
        followed = back[calm.forced[back]]
        self._before_low[:, fallen] = self._sums[:, fallen]
        self._sums[:, followed] = self._before_low[:, followed]
        self._low[changed] = fell
        self._stays_low[back] = False

    def _conclude(self) -> None:
        """Tell what was measured, and begin anew; for those that fell only now it is what was before that."""
        counted = np.where(self._low & ~self._stays_low, self._before_low, self._sums)
        squares, frames, ends = counted
        enough = frames >= _ENOUGH_FRAMES
        noise = np.sqrt(squares[enough] / (2 * frames[enough]))
        self.deviation[enough] = np.fmin(noise, _GROWTH * self.deviation[enough])
        self.at_end[enough] = ends[enough] / frames[enough]
        self._sums[:, enough] -= counted[:, enough]
        self._before_low[:, enough] = 0
        self._stays_low[:] = self._low
