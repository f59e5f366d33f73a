"""What taxels read while nothing touches them: levels and noise, from a few seconds of which parts may be disturbed."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from skinware.realtime import NS_PER_S

_BLOCKS = 10
_FRAMES = 4
"""Least frames of a block, whatever the rate."""
_ENOUGH = 0.6
"""Of the blocks of a taxel must have its data."""
_MEDIAN_OF_VARIANCE = {4: 0.789, 5: 0.839, 6: 0.870, 7: 0.891, 8: 0.907, 9: 0.918, 10: 0.927}
"""Median of chi-square with m - 1 degrees of freedom, divided by m - 1."""


class Resting(NamedTuple):
    """What was found.

    Attributes:
        level: (n,) float32, NaN where there was not enough data.
        noise: (n,) float32, standard deviation from frame to frame.
        range: (n,) float32, between the highest and the lowest level of a tenth of the time.
    """

    level: npt.NDArray[np.float32]
    noise: npt.NDArray[np.float32]
    range: npt.NDArray[np.float32]


class RestingMeasurement:
    """Measures levels and noise of n taxels over some seconds, in a tenth of them at a time.

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
        self._levels: list[npt.NDArray[np.float32]] = []
        self._variances: list[npt.NDArray[np.float32]] = []

    @property
    def progress(self) -> float:
        """0 to 1: how much of it is done."""
        return len(self._levels) / _BLOCKS

    def add(self, time_ns: int, values: npt.NDArray[np.float32], usable: npt.NDArray[np.bool_]) -> bool:
        """Take a frame in.

        Args:
            time_ns: of the frame.
            values: (n,) finite where usable.
            usable: (n,) which of them count.

        Returns:
            Whether it was the last that is needed.
        """
        if self._first is None:
            self._first, self._begun_ns = np.where(usable, values, np.nan).astype(np.float32), time_ns
        np.copyto(self._first, values, where=usable & np.isnan(self._first))
        difference = np.where(usable, values - self._first, np.float32(0))  # small, so that its squares are exact
        self._count += usable
        self._sum += difference
        self._squares += difference * difference
        self._frames += 1
        if time_ns - self._begun_ns >= self._block_ns and self._frames >= _FRAMES:
            self._end_block(time_ns)
        return len(self._levels) == _BLOCKS

    def result(self) -> Resting:
        """What was found in the blocks that are over."""
        assert self._first is not None  # noqa: S101 - add() said so
        levels, variances = np.sort(self._levels, axis=0), np.sort(self._variances, axis=0)  # NaN comes last
        found = np.isfinite(levels).sum(axis=0)
        enough = found >= _ENOUGH * len(levels)
        taxel = np.arange(len(found))
        at = (np.maximum(found - 1, 0) // 2, taxel), (np.minimum(found // 2, len(levels) - 1), taxel)
        level = self._first + (levels[at[0]] + levels[at[1]]) / 2
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
