"""Measure what taxels read at rest: their levels and their noise."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from skinware.realtime import NS_PER_S
from skinware.tactile.rule import BLOCK_FRAMES, BLOCKS, ENOUGH_BLOCKS, MOVED_SHARE, BaselineSettings

Floats = npt.NDArray[np.float32]
Flags = npt.NDArray[np.bool_]

_MEDIAN_OF_VARIANCE = {4: 0.789, 5: 0.839, 6: 0.870, 7: 0.891, 8: 0.907, 9: 0.918, 10: 0.927}
"""Median of chi-square with m - 1 degrees of freedom, divided by m - 1."""


class Rest:
    """The baselines of n taxels, and how each begins: with a measurement while nothing moves it.

    Attributes:
        ready: (n,) bool, which taxels have a baseline.
        level: (n,) float32, the baseline; NaN before it is known.
        noise: (n,) float32, standard deviation from frame to frame; NaN before it is known.
        refused_share: share of the taxels that have to wait for their baselines because they move.
    """

    def __init__(self, n: int) -> None:
        self.ready: Flags = np.zeros(n, bool)
        self.level: Floats = np.full(n, np.nan, np.float32)
        self.noise: Floats = np.full(n, np.nan, np.float32)
        self.refused_share = 0.0
        self._measurement: RestMeasurement | None = None

    def measure(
        self, time_ns: int, values: Floats, waiting: Flags, seen: Flags, minimum_on: float, settings: BaselineSettings
    ) -> bool:
        """Measure the taxels that wait for a baseline.

        Where many of them move, those that move go on waiting until they rest.

        Args:
            time_ns: time of the frame.
            values: (n,) values of the frame.
            waiting: (n,) taxels that have a value and no baseline.
            seen: (n,) taxels that have ever had a value.
            minimum_on: the least threshold of touch.
            settings: for its length and for thresholds.

        Returns:
            Whether a measurement ended, so that taxels may have a baseline now.
        """
        if self._measurement is None:
            self._measurement = RestMeasurement(len(values), settings.calibrate_s)
        if not self._measurement.add(time_ns, values, waiting):
            return False
        taxels = np.flatnonzero(~self.ready)
        found = self._measurement.result(taxels)
        measured = np.isfinite(found.level)
        moving = measured & (found.range > np.maximum(minimum_on, settings.on_sigma * found.noise))
        refused = int(moving.sum()) > max(1, MOVED_SHARE * measured.sum())
        self.refused_share = int(moving.sum()) / int(seen.sum()) if refused else 0.0
        begins = measured & ~moving if refused else measured
        if not refused:
            self._measurement = None  # a taxel that sends later starts a new one
        self.begin_at(taxels[begins], found.level[begins], found.noise[begins])
        return True

    def begin_at(self, taxels: npt.NDArray[np.intp], level: Floats, noise: Floats) -> None:
        """Give k taxels their (k,) levels and noise."""
        self.level[taxels] = level
        self.noise[taxels] = noise
        self.ready[taxels] = True
        if self.ready.all():
            self._measurement = None

    def forget(self, taxels: Flags) -> None:
        """Take the baselines of some taxels away."""
        self.ready &= ~taxels
        self.level[taxels] = np.nan


class Measured(NamedTuple):
    """The result for k taxels.

    Attributes:
        level: (k,) float32, NaN without enough data.
        noise: (k,) float32, standard deviation from frame to frame.
        range: (k,) float32, between the highest and the lowest level of a tenth of the time.
    """

    level: Floats
    noise: Floats
    range: Floats


class RestMeasurement:
    """Measures levels and noise of n taxels over the last seconds, in a tenth of them at a time.

    Level and noise are medians over the tenths: a touch of a third of the time moves neither, and medians of means are
    finer than the steps of the values, which medians of integers are not.

    Args:
        n: number of taxels.
        seconds: how long; longer if fewer than 4 frames come in a tenth of it.
    """

    def __init__(self, n: int, seconds: float) -> None:
        self._block_ns = round(seconds * NS_PER_S / BLOCKS)
        self._first: Floats = np.full(n, np.nan, np.float32)
        self._begun_ns: int | None = None
        self._frames = 0
        self._count, self._sum, self._squares = (np.zeros(n, np.float32) for _ in range(3))
        self._levels: deque[Floats] = deque(maxlen=BLOCKS)
        self._variances: deque[Floats] = deque(maxlen=BLOCKS)

    def add(self, time_ns: int, values: Floats, usable: Flags) -> bool:
        """Take a frame in.

        Args:
            time_ns: time of the frame.
            values: (n,) finite where usable.
            usable: (n,) which of them count.

        Returns:
            Whether there is a new result: after all the time, and again after each further tenth of it.
        """
        if self._begun_ns is None:
            self._begun_ns = time_ns
        np.copyto(self._first, values, where=usable & np.isnan(self._first))
        difference = np.where(usable, values - self._first, np.float32(0))  # small, so that its squares are exact
        self._count += usable
        self._sum += difference
        self._squares += difference * difference
        self._frames += 1
        if time_ns - self._begun_ns < self._block_ns or self._frames < BLOCK_FRAMES:
            return False
        self._end_block()
        self._begun_ns, self._frames = time_ns, 0
        return len(self._levels) == BLOCKS

    def result(self, taxels: npt.NDArray[np.intp]) -> Measured:
        """Return what (k,) taxels read in the last tenths."""
        blocks = (np.array([block[taxels] for block in of_taxels]) for of_taxels in (self._levels, self._variances))
        levels, variances = (np.sort(of_taxels, axis=0) for of_taxels in blocks)  # NaN comes last
        found = np.isfinite(levels).sum(axis=0)
        enough = found >= ENOUGH_BLOCKS * len(levels)
        taxel = np.arange(len(found))
        at = (np.maximum(found - 1, 0) // 2, taxel), (np.minimum(found // 2, len(levels) - 1), taxel)
        level = self._first[taxels] + (levels[at[0]] + levels[at[1]]) / 2
        noise = np.sqrt((variances[at[0]] + variances[at[1]]) / 2)
        spread = levels[np.maximum(found - 1, 0), taxel] - levels[0]
        return Measured(*(np.where(enough, array, np.nan).astype(np.float32) for array in (level, noise, spread)))

    def _end_block(self) -> None:
        count = np.where(self._count >= BLOCK_FRAMES, self._count, np.nan).astype(np.float32)
        mean = self._sum / count
        variance = np.maximum(self._squares / count - mean * mean, 0) * (count / (count - 1))
        typical = _MEDIAN_OF_VARIANCE.get(self._frames, 1 - 0.67 / (self._frames - 1))
        self._levels.append(mean)
        self._variances.append(variance / np.float32(typical))
        for total in (self._count, self._sum, self._squares):
            total[:] = 0
