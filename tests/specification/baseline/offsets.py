"""Predict what each taxel reads at rest, and how uncertain that is: a Kalman filter per taxel, one common mode a patch.

A value is ``offset + noise + load``. Between two frames the offset of a taxel moves by its gain times the move of the
common mode of its patch, and by a drift of its own. Offset and gain are estimated together while nothing touches the
taxel; meanwhile their uncertainty shrinks. While something touches it the offset is predicted, and its uncertainty
grows by what the gain may be wrong, and by the drift that was measured at rest.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from tests.specification.baseline.numbers import (
    DRIFT_SIGMA,
    FEW_TAXELS,
    FEWEST,
    FIRST_DRIFT,
    GAIN_LASTS_S,
    GAIN_SPREAD2,
    LEAST_DRIFT,
    LEAST_GAIN,
    MATCH_S,
    MOST_DRIFT,
    MOST_GAIN,
    NOISE_S,
    QUIET,
    RATE_S,
    SLOW_S,
    TICK_S,
    WANDER_S,
)

Floats = npt.NDArray[np.float32]
Flags = npt.NDArray[np.bool_]
Rows = npt.NDArray[np.intp]
Doubles = npt.NDArray[np.float64]

_MEDIAN = 0.455
"""Median of the square of a standard normal deviate."""
_GAIN_PER_S = GAIN_SPREAD2 / GAIN_LASTS_S


class Grouping:
    """Sums n values by group.

    Args:
        group: (n,) int, the group of each value, 0 or more.

    Attributes:
        n: number of groups.
        size: (n_groups,) how many values each has.
    """

    def __init__(self, group: Rows) -> None:
        self.group = group
        self.n = int(group.max(initial=-1)) + 1
        self.size = self.sum(np.ones(len(group), bool))

    def sum(self, values: npt.NDArray[np.bool_ | np.integer[Any] | np.floating[Any]]) -> Doubles:
        """Return (n_groups,) the sums of (n,) values, one after the other."""
        return np.bincount(self.group, values, self.n).astype(np.float64)

    def median(self, values: Floats, counts: Flags) -> Floats:
        """Return (n_groups,) the medians of those of (n,) values that count; 0 where none does."""
        rows = np.flatnonzero(counts)
        group = self.group[rows]
        ordered = values[rows][np.lexsort((values[rows], group))]
        number = np.bincount(group, minlength=self.n)
        last = np.cumsum(number) - 1
        first = last - number + 1
        if not len(ordered):
            return np.zeros(self.n, np.float32)
        low, high = (np.maximum(at, 0) for at in (first + (number - 1) // 2, first + number // 2))
        middle = (ordered[np.minimum(low, len(ordered) - 1)] + ordered[np.minimum(high, len(ordered) - 1)]) / 2
        return np.where(number > 0, middle, np.float32(0))

    def spread(self, of_group: npt.NDArray[np.generic]) -> Floats:
        """Return (n,) the value of each one's group."""
        return of_group.astype(np.float32)[self.group] if self.n > 1 else of_group.astype(np.float32)


class CommonMode:
    """Follows the common mode of each of p patches: one number, of which every taxel shows its gain.

    Its agility, the variance that it gains in a second, is learned: so large that the moves of the mode are as likely
    as they are frequent. So noise is not followed, slow drift is, and a hum is as it comes.

    Attributes:
        variance: (p,) of the mode.
        agility: (p,) variance a second.
        rate: (p,) average speed, a second.
        rate2: (p,) its mean square.
        unknown_s: (p,) for how long too few taxels have been free to say how it moves.
    """

    def __init__(self, n_patches: int) -> None:
        self.variance, self.agility, self.rate, self.rate2, self.unknown_s = (np.zeros(n_patches) for _ in range(5))
        self.known_s = np.zeros(n_patches)

    def step(self, found: Doubles, precision: Doubles, free: Doubles, passed_s: float) -> tuple[Doubles, Doubles]:
        """Return (p,) by how much the mode moves, and how much of that is sure enough to learn gains from.

        Args:
            found: (p,) how far the free taxels say that it moved.
            precision: (p,) one by the variance of that.
            free: (p,) number of free taxels.
            passed_s: since the last step.
        """
        known = free > FEW_TAXELS
        ahead = self.rate * (known * passed_s)
        found = found - ahead
        trust = np.where(known, 1 - FEW_TAXELS / np.maximum(free, 1), 0)
        unknown = ~known
        self.variance[unknown] += self.rate2[unknown] * (2 * self.unknown_s[unknown] + passed_s) * passed_s
        self.unknown_s[unknown] += passed_s
        self.unknown_s[known] = 0
        total = self.variance + 1 / np.maximum(precision, 1e-30)
        most = DRIFT_SIGMA * np.sqrt(total)
        share = trust * self.variance / total
        news = share * np.minimum(np.maximum(found, -most), most)
        move = ahead + news
        self.variance = (1 - share) ** 2 * self.variance + share * share / np.maximum(precision, 1e-30)
        towards = np.sign(found * found - _MEDIAN * total) * known
        self.agility *= np.exp(min(passed_s / MATCH_S, 1.0) * towards)
        least = 1e-5 / np.maximum(precision, 1e-30)
        np.maximum(self.agility, np.where(known, least, 0), out=self.agility)
        if passed_s > 0:
            self.known_s += passed_s * known
            slow = -math.expm1(-passed_s / RATE_S)
            self.rate += (move / passed_s - self.rate) * (slow * known)
            self.rate2 += (self.rate**2 - self.rate2) * (known * passed_s / np.clip(self.known_s, RATE_S, 10 * RATE_S))
        return move, ahead + share * news


class Offsets:
    """Predicts the offsets of n taxels.

    Args:
        patch: (n,) int, the patch of each taxel: its taxels drift together.
        module: (n,) int, the module of each taxel: what drifts by itself does so there.

    Attributes:
        level: (n,) float32, the offset; NaN before it is known.
        gain: (n,) float32, how strongly each taxel follows the common mode of its patch.
        variance: (n,) float32, of the offset.
        cross: (n,) float32, covariance of offset and gain.
        gain_variance: (n,) float32.
        noise2: (n,) float32, variance from frame to frame.
        noise_s: (n,) float32, for how long that has been measured.
        slow: (n,) float32, the deviation of each at rest, over some seconds.
        common: the common modes.
        agility: (n_patches,) variance that the offset of a taxel gains in a second by a drift of its own.
        wander: (n_patches,) square of how far a typical taxel at rest is from its offset, over some seconds.
        rate2: (n_modules,) mean square of the speeds at which taxels drift by themselves, a second.
        typical: (n_patches,) noise2 of a typical taxel: a dead one, without noise, says no more of the common mode.
    """

    def __init__(self, patch: Rows, module: Rows) -> None:
        n = len(patch)
        self.level: Floats = np.full(n, np.nan, np.float32)
        self.gain: Floats = np.ones(n, np.float32)
        self.variance, self.cross, self.slow = (np.zeros(n, np.float32) for _ in range(3))
        self.gain_variance: Floats = np.full(n, GAIN_SPREAD2, np.float32)
        self.noise2: Floats = np.full(n, np.nan, np.float32)
        self.noise_s: Floats = np.full(n, NOISE_S, np.float32)
        self.patches = Grouping(patch)
        self.common = CommonMode(self.patches.n)
        self.agility, self.typical, self.wander, self._speed2 = np.zeros((4, self.patches.n))
        self._modules = Grouping(module)
        self.rate2 = np.zeros(self._modules.n)
        self._patch_of_module = np.zeros(self._modules.n, np.intp)
        self._patch_of_module[module] = patch
        self._speed: Floats = np.zeros(n, np.float32)
        """How quickly each drifts by itself, a second."""
        self._unseen_s, self._strayed2 = np.zeros((2, n), np.float32)
        """For how long nothing has been measured of each, and the square of how far its own drift led meanwhile."""
        self._gain_before: Floats = self.gain.copy()
        self._grows: Floats = np.zeros(n, np.float32)
        """Variance that each offset gains in a second by a drift of its own."""
        self._tick_s = 0.0

    def total(self) -> Floats:
        """Return (n,) the variance of a deviation at rest: of noise, offset and common mode."""
        common = self.patches.spread(self.common.variance)
        total: Floats = self.noise2 + self.variance + self.gain * self.gain * common
        return total

    def uncertainty(self) -> Floats:
        """Return (n,) the standard deviation of the offset."""
        least = np.maximum(self.patches.spread(self.wander), self.slow * self.slow) + self._strayed2
        common = self.patches.spread(self.common.variance)
        deviation: Floats = np.sqrt(np.maximum(self.variance, least) + self.gain * self.gain * common)
        return deviation

    def follow_common(self, deviation: Floats, free: Flags, hidden2: Floats, passed_s: float) -> None:
        """Move the offsets by the common mode, and take that off the deviations.

        Args:
            deviation: (n,) of the values from the offsets, changed in place; 0 where unknown.
            free: (n,) which taxels are at rest.
            hidden2: (n,) square of the load that each may bear without being touched.
            passed_s: since the last frame.
        """
        if passed_s <= 0:
            return
        mode = self.common
        mode.variance = np.where(self.patches.size > FEW_TAXELS, mode.variance + mode.agility * passed_s, 0)
        typical = self.patches.spread(self.typical)
        free = free & (self.noise2 >= np.float32(QUIET) * typical)
        own = np.maximum(self.noise2, typical) + self.variance
        weight = np.where(free, np.float32(1) / (own + hidden2), np.float32(0))
        limit = np.float32(2) * np.sqrt(own + self.gain * self.gain * self.patches.spread(mode.variance))
        clipped = np.minimum(np.maximum(deviation, -limit), limit)
        np.copyto(clipped, 0, where=~free)
        weights = np.maximum(self.patches.sum(weight), 1e-30)
        reach = np.maximum(self.patches.sum(weight * self.gain), LEAST_GAIN * weights)
        precision = reach * reach / weights
        found = self.patches.sum(clipped * weight) / reach
        move, sure = self.common.step(found, precision, self.patches.sum(free), passed_s)
        change = self.gain * self.patches.spread(move)
        self.level += change
        deviation -= change
        moved = self.patches.spread(sure)
        doubt = moved * self.gain_variance
        self.variance += moved * (np.float32(2) * self.cross + doubt)
        self.cross += doubt

    def learn(
        self,
        deviation: Floats,
        taxels: Flags,
        calm: Flags,
        fresh: Flags,
        live: Flags,
        floor: Floats | np.float32,
        rises: Floats,
        passed_s: float,
    ) -> None:
        """Correct offsets and gains by the deviations of taxels at rest; let the others become less certain.

        Args:
            deviation: (n,) of the values from the offsets.
            taxels: (n,) which are measured.
            calm: (n,) those of them that are far from a touch: only they say something of gains and noise.
            fresh: (n,) those that have not got used to a load: only they say something of the speed of drift.
            live: (n,) those with values and offsets.
            floor: least share of a deviation that the offset follows where it drifts by itself.
            rises: (n,) by how much heat and sweat of a touch may have raised each since the last frame.
            passed_s: since the last frame.
        """
        if passed_s <= 0:
            return
        self.variance += self._grows * np.float32(passed_s)
        total = self.variance + self.noise2
        limit = np.float32(DRIFT_SIGMA) * np.sqrt(total)
        innovation = np.minimum(np.maximum(deviation, -limit), limit)
        np.copyto(innovation, 0, where=~taxels)
        slowly = -math.expm1(-passed_s / SLOW_S)
        expected = self.noise2 * np.float32(slowly / (2 - slowly)) + self.variance
        unlike = self.slow * self.slow / expected
        drifts = unlike > np.float32(DRIFT_SIGMA**2)
        share = self.variance / total
        share = np.where(taxels, np.where(drifts, np.maximum(share, floor), share), np.float32(0))
        of_gain = np.where(calm & (unlike < np.float32(4 * DRIFT_SIGMA**2)), self.cross / total, np.float32(0))
        self.level += share * innovation + np.minimum(np.maximum(deviation, 0), rises)
        self.gain += of_gain * innovation
        self.gain_variance -= of_gain * self.cross
        keep = np.float32(1) - share
        self.cross *= keep
        self.variance = keep * keep * self.variance + share * share * np.where(taxels, self.noise2, np.float32(0))
        quick = innovation - self.slow
        self.slow += quick * (np.float32(slowly) * taxels)
        passed = np.float32(passed_s)
        strays = self._modules.spread(self.rate2) * passed * (2 * self._unseen_s + passed)
        self._strayed2 = keep * keep * self._strayed2 + np.where(taxels, np.float32(0), strays)
        self._unseen_s = np.where(taxels, np.float32(0), self._unseen_s + passed)
        averages = np.float32(-math.expm1(-passed_s / WANDER_S))
        self._speed += (share * innovation / np.float32(passed_s) - self._speed) * (averages * (taxels & fresh))
        self.noise_s = np.minimum(self.noise_s + calm * np.float32(passed_s), np.float32(NOISE_S))
        with np.errstate(divide="ignore"):
            of_square = np.minimum(np.float32(passed_s) / self.noise_s, np.float32(FEWEST))
        self.noise2 += (quick * (innovation - self.slow) - self.noise2) * (calm * of_square)
        self._tick_s += passed_s
        if self._tick_s >= TICK_S:
            self._tick(taxels, live, passed_s)
            self._tick_s = 0.0

    def _tick(self, taxels: Flags, live: Flags, passed_s: float) -> None:
        """Adjust what changes slowly: the agility of own drift, and the typical gain of a patch, which is 1."""
        number = np.maximum(self.patches.sum(taxels), 1)
        share = -math.expm1(-passed_s / SLOW_S)
        of_noise = np.float32(share / (2 - share))
        deviation2 = self.variance + self.gain * self.gain * self.patches.spread(self.common.variance)
        expected = np.float32(1.5 * _MEDIAN) * (self.noise2 * of_noise + deviation2)
        beyond = self.patches.sum(taxels & (self.slow * self.slow > expected)) / number
        typical = self.patches.median(self.noise2, taxels).astype(np.float64)
        some = self.patches.sum(taxels) > 0
        np.copyto(self.typical, typical, where=some)
        away = self.patches.median(np.abs(self.slow), taxels).astype(np.float64)
        away2 = np.maximum(away * away / _MEDIAN - typical * of_noise, 0)
        self.wander += (away2 - self.wander) * (some * -math.expm1(-self._tick_s / WANDER_S))
        agility = self.agility * np.exp(self._tick_s / 10 * (2 * beyond - 1))
        agility = np.where(self.agility > 0, agility, FIRST_DRIFT * typical)
        np.copyto(self.agility, np.clip(agility, LEAST_DRIFT * typical, MOST_DRIFT * typical), where=some)
        self._grows[:] = self.patches.spread(self.agility)
        forgets = np.where(taxels, np.float32(-math.expm1(-self._tick_s / GAIN_LASTS_S)), np.float32(0))
        self.gain += (1 - self.gain) * forgets
        self.gain_variance += (np.float32(GAIN_SPREAD2) - self.gain_variance) * (2 * forgets)
        before, now = (
            self.patches.sum(np.where(taxels, gain, np.float32(0))) for gain in (self._gain_before, self.gain)
        )
        ratio = self.patches.spread(np.where(now > 0, before / np.maximum(now, 1e-9), 1))
        self.gain *= np.where(taxels, ratio, np.float32(1))  # they and the mode must not float apart
        dead = self.noise2 < np.float32(QUIET) * self.patches.spread(self.typical)
        np.clip(self.gain, np.where(dead, np.float32(0), np.float32(LEAST_GAIN)), MOST_GAIN, out=self.gain)
        self._gain_before = self.gain.copy()
        self._follow_speeds(live)

    def _follow_speeds(self, taxels: Flags) -> None:
        """Learn how quickly the taxels of each module drift by themselves, as they did when they were last at rest."""
        speed2 = np.where(taxels, self._speed * self._speed, np.float32(0))
        number = self.patches.sum(taxels)
        np.copyto(self._speed2, self.patches.sum(speed2) / np.maximum(number, 1), where=number > FEW_TAXELS)
        number = self._modules.sum(taxels)
        found = self._modules.sum(speed2) / np.maximum(number, 1)
        found = np.where(number > FEW_TAXELS, found, self._speed2[self._patch_of_module])
        self.rate2 += (found - self.rate2) * -math.expm1(-self._tick_s / WANDER_S)

    def begin(self, taxels: Rows, level: Floats, noise2: Floats, gain: Floats, gain_variance: Floats) -> None:
        """Give k taxels what was measured of them: levels, noise and gains (k,)."""
        self.level[taxels], self.noise2[taxels] = level, noise2
        self.gain[taxels] = self._gain_before[taxels] = np.clip(gain, 0, MOST_GAIN)
        self.gain_variance[taxels] = gain_variance
        self.variance[taxels], self.cross[taxels], self.slow[taxels] = noise2 / 20, 0, 0

    def lose_common(self) -> None:
        """Forget where the common modes are, after a time without data: the next frames find them again."""
        noise2 = np.where(np.isfinite(self.noise2), self.noise2, np.float32(0))
        number = np.maximum(self.patches.sum(noise2 > 0), 1)
        self.common.variance[:] = self.patches.sum(noise2) / number

    def put(self, taxels: Rows, level: Floats) -> None:
        """Put the offsets of k taxels at (k,) levels, as certain as one value is."""
        self.level[taxels] = level
        self.variance[taxels] = self.noise2[taxels]
        self.cross[taxels] = 0
        self.slow[taxels] = 0
