"""Measure what taxels read at rest: their levels, their noise, and their gains to what their patch has in common."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from skinware.realtime import NS_PER_S
from skinware.tactile.baseline import BaselineSettings
from tests.specification.baseline.numbers import (
    BLOCK_FRAMES,
    BLOCKS,
    ENOUGH_BLOCKS,
    FEW_TAXELS,
    GAIN_SPREAD2,
    MOVED_SHARE,
    RESTLESS,
)
from tests.specification.baseline.offsets import Grouping

Floats = npt.NDArray[np.float32]
Flags = npt.NDArray[np.bool_]
Rows = npt.NDArray[np.intp]

_MEDIAN_OF_VARIANCE = {4: 0.789, 5: 0.839, 6: 0.870, 7: 0.891, 8: 0.907, 9: 0.918, 10: 0.927}
"""Median of chi-square with m - 1 degrees of freedom, divided by m - 1."""


class Measured(NamedTuple):
    """The result for k taxels that begin.

    Attributes:
        taxels: (k,) which.
        level: (k,) float32, offsets at the last frame.
        noise2: (k,) float32, variances from frame to frame.
        gain: (k,) float32, to the common mode.
        gain_variance: (k,) float32.
    """

    taxels: Rows
    level: Floats
    noise2: Floats
    gain: Floats
    gain_variance: Floats


class Rest:
    """Measures n taxels over the last seconds, in a tenth of them at a time, beside what their patch has in common.

    Level and noise are medians over the tenths: a touch of a third of the time moves neither, and medians of means are
    finer than the steps of the values, which medians of integers are not.

    Args:
        patches: the patches of the taxels.
        least_noise2: returns the least noise2 of taxels at (k,) levels.

    Attributes:
        refused_share: share of the taxels that have to wait because they move.
        moves2: (n_patches,) by how much the common modes move from frame to frame, squared.
    """

    def __init__(self, patches: Grouping, least_noise2: Callable[[Floats], Floats | np.float32]) -> None:
        self._least_noise2 = least_noise2
        self.refused_share = 0.0
        self.moves2 = np.zeros(patches.n)
        self._patches = patches
        self._clear()

    def _clear(self) -> None:
        n = len(self._patches.group)
        self._first: Floats = np.full(n, np.nan, np.float32)
        self._begun_ns: int | None = None
        self._frames = 0
        self._sums = np.zeros((6, n), np.float32)
        """Sums of frames, deviations d from the first value, common modes c, d * d, d * c and c * c."""
        self._blocks: deque[Floats] = deque(maxlen=int(BLOCKS))
        self._common: Floats = np.zeros(self._patches.n, np.float32)

    def measure(
        self, time_ns: int, values: Floats, waiting: Flags, seen: Flags, minimum_on: float, settings: BaselineSettings
    ) -> Measured | None:
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
            Those that begin, if a measurement ended.
        """
        if not self._add(time_ns, values, waiting, round(settings.calibrate_s * NS_PER_S / BLOCKS)):
            return None
        taxels = np.flatnonzero(np.isfinite(self._first))
        level, found, moves = self._result(taxels)
        measured = np.isfinite(level)
        moving = measured & (moves > np.maximum(minimum_on, settings.on_sigma * np.sqrt(found.noise2)))
        refused = int(moving.sum()) > max(1, MOVED_SHARE * measured.sum())
        self.refused_share = int(moving.sum()) / int(seen.sum()) if refused else 0.0
        begins = measured & ~moving if refused else measured
        for block in self._blocks:
            block[0, taxels[begins]] = 0  # else they would begin again while others wait
        if not refused:
            self._clear()  # a taxel that sends later starts a new one
        return Measured(found.taxels[begins], *(array[begins] for array in found[1:]))

    def _add(self, time_ns: int, values: Floats, usable: Flags, block_ns: int) -> bool:
        """Take a frame in; return whether a tenth ended, and there are ten of them."""
        if self._begun_ns is None:
            self._begun_ns = time_ns
        np.copyto(self._first, values, where=usable & np.isnan(self._first))
        difference = np.where(usable, values - self._first, np.float32(0))  # small, so that its squares are exact
        before, median = self._common, self._patches.median(difference, usable)
        self._common = median * (self._patches.size > FEW_TAXELS)
        if self._frames:
            self.moves2 += ((self._common - before) ** 2 - self.moves2) / 20
        common = self._patches.spread(self._common) * usable
        pairs = (usable, difference, common, difference * difference, difference * common, common * common)
        for total, of_frame in zip(self._sums, pairs, strict=True):
            total += of_frame
        self._frames += 1
        values_of = self._sums[0]
        if time_ns - self._begun_ns < block_ns or values_of.sum() < BLOCK_FRAMES * (values_of > 0).sum():
            return False
        self._blocks.append(self._sums)
        self._sums = np.zeros_like(self._sums)
        self._begun_ns, self._frames = time_ns, 0
        return len(self._blocks) == BLOCKS

    def now(self) -> tuple[Flags, Floats, Floats]:
        """Where there are enough values for it: what each taxel reads now, and the square of its noise."""
        n = len(self._first)
        known, level, typical = np.zeros(n, bool), np.zeros(n, np.float32), np.ones(n, np.float32)
        parts = [*self._blocks, *([self._sums] if self._frames else [])][-int(BLOCKS) :]
        noises2 = np.full((len(parts), n), np.nan, np.float32)
        for noise2, sums in zip(noises2, parts, strict=True):
            of = sums[0] >= BLOCK_FRAMES
            count, d, c, dd, dc, cc = sums[:, of]
            level[of] = self._first[of] + self._patches.spread(self._common)[of] + (d - c) / count
            noise2[of] = (dd - 2 * dc + cc - (d - c) * (d - c) / count) / (count - 1)
            typical[of] = [_MEDIAN_OF_VARIANCE.get(int(each), 1.0) for each in count]
            known |= of
        return known, level, np.maximum(_median(noises2) / typical, 0) if parts else level

    def _result(self, taxels: Rows) -> tuple[Floats, Measured, Floats]:
        """Levels, NaN without enough data; what was measured; and how far each moved from tenth to tenth."""
        blocks = np.array([block[:, taxels] for block in self._blocks])
        blocks = np.where(blocks[:, :1] >= BLOCK_FRAMES, blocks, np.float32(np.nan))
        count, d, c, dd, dc, cc = (blocks[:, row] for row in range(6))
        found = np.isfinite(count).sum(axis=0)
        enough = found >= ENOUGH_BLOCKS * BLOCKS
        typical = _MEDIAN_OF_VARIANCE.get(_lower_median(count), 1.0)
        own, mode = dd - d * d / count, cc - c * c / count
        both = dc - d * c / count
        noise2 = _median((own - 2 * both + mode) / (count - 1)) / np.float32(typical)
        mean_c = np.nansum(c, axis=0) / np.maximum(np.nansum(count, axis=0), 1)
        power = np.nansum(cc, axis=0) - mean_c * np.nansum(c, axis=0)
        beside = np.nansum(dc, axis=0) - mean_c * np.nansum(d, axis=0) - power
        prior = noise2 / np.float32(GAIN_SPREAD2) + np.float32(1e-12)
        gain = (1 + beside / (power + prior)).astype(np.float32)
        parts = (own - 2 * gain * both + gain * gain * mode) / (count - 1)
        noise2 = _median(parts) / np.float32(typical)
        levels = (d - gain * c) / count
        level = _median(levels) + self._first[taxels] + gain * self._common[self._patches.group[taxels]]
        moves = np.nanmax(np.where(enough, levels, 0), axis=0) - np.nanmin(np.where(enough, levels, 0), axis=0)
        level = np.where(enough, level, np.float32(np.nan))
        quietest = np.maximum(np.nanmin(np.where(enough, parts, 0), axis=0), self._least_noise2(level))
        moves = np.where(noise2 > RESTLESS * quietest, np.float32(np.inf), moves)
        variance = np.maximum(noise2, 1e-12) / (power + prior)
        return (
            level,
            Measured(taxels, *(a.astype(np.float32) for a in (level, np.maximum(noise2, 0), gain, variance))),
            moves,
        )


def _lower_median(count: Floats) -> int:
    known = np.sort(count[np.isfinite(count)])
    return int(known[(len(known) - 1) // 2]) if len(known) else 0


def _median(blocks: Floats) -> Floats:
    """(k,) medians over (BLOCKS, k), NaN left out."""
    ordered = np.sort(blocks, axis=0)  # NaN comes last
    found = np.isfinite(blocks).sum(axis=0)
    each = np.arange(blocks.shape[1])
    low, high = np.maximum(found - 1, 0) // 2, np.minimum(found // 2, len(blocks) - 1)
    middle: Floats = (ordered[low, each] + ordered[high, each]) / 2
    return middle
