"""Drift of baselines: what is common to a patch, what is each taxel's own, and how strongly each follows the common."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from skinware.tactile.group_median import GroupMedian

Floats = npt.NDArray[np.float32]
Flags = npt.NDArray[np.bool_]

_LEAST_FACTOR, _MOST_FACTOR = 0.2, 3.0
"""Of a taxel's drift in proportion to that of its patch."""
_FREE_SHARE = 0.5
"""Of a patch must be away from contacts, or nothing is known of its common drift."""
_DOUBT = 0.3
"""Of a threshold: a common drift of so much says as much about a factor as the guess that it is 1."""
_STRETCH = 2.0
"""Of a threshold: after so much common drift, a factor is learned anew, and what was known counts half."""
_LEVEL_EVERY_S = 1.0
"""So often the typical factor of a patch is made 1: common drift is measured in factors, and these by common drift."""


class Drift:
    """Follows the drift of n taxels.

    Args:
        patch: (n,) int, the patch of each taxel: what drifts together.

    Attributes:
        factor: (n,) float32, each taxel's drift in proportion to that of its patch.
        own: (n,) float32, how far each has drifted away from contacts since its last stretch began.
        common: (n,) float32, how far its patch has, meanwhile.
        product: (n,) float32, sum of own times common drift of the stretches before.
        square: (n,) float32, sum of the squares of common drift.
        lag: (n,) float32, what each has yet to follow beside the common drift, over some seconds.
        alone: (n,) float32, how far each baseline moved beside the common drift in the last step.
    """

    def __init__(self, patch: npt.NDArray[np.intp]) -> None:
        self._patch = patch
        self._median = GroupMedian(patch)
        self.factor: Floats = np.ones(len(patch), np.float32)
        self.own: Floats = np.zeros(len(patch), np.float32)
        self.common: Floats = np.zeros(len(patch), np.float32)
        self.product: Floats = np.zeros(len(patch), np.float32)
        self.square: Floats = np.zeros(len(patch), np.float32)
        self.lag: Floats = np.zeros(len(patch), np.float32)
        self.alone: Floats = np.zeros(len(patch), np.float32)
        self._typical: Floats = np.ones(len(patch), np.float32)
        self._unlevelled_s = 0.0

    def step(
        self,
        deviation: Floats,
        usable: Flags,
        free: Flags,
        *,
        passed_s: float,
        tau_s: float,
        common_tau_s: float,
        limit: Floats,
    ) -> Floats:
        """How far the baselines move in this time.

        Args:
            deviation: (n,) of the values from the baselines; 0 where not usable.
            usable: (n,) which taxels have values.
            free: (n,) which of them are away from contacts.
            passed_s: the time.
            tau_s: time constant of own drift.
            common_tau_s: of common drift.
            limit: (n,) threshold of touch, above 0: no common drift reaches it within a time constant.
        """
        own_share, common_share = (np.float32(-math.expm1(-passed_s / tau)) for tau in (tau_s, common_tau_s))
        common = self._common_drift(deviation, usable, free)
        np.clip(common, -limit, limit, out=common)
        followed = self.factor * common
        change = followed * common_share
        rest = deviation - followed
        self.alone = rest * (own_share * (free & usable))
        change += self.alone
        change *= usable
        self.lag += (rest - self.lag) * (common_share * free)
        self.own += change * free
        self.common += common * (common_share * free)
        self._learn(free, passed_s, limit)
        return change

    def _common_drift(self, deviation: Floats, usable: Flags, free: Flags) -> Floats:
        """(n,) the drift of each taxel's patch; 0 where too much of it is in contact to tell."""
        median, n_free = self._median(deviation / self.factor, free)
        n_usable = np.bincount(self._patch[usable], minlength=len(n_free))
        median[(n_free == 0) | (n_free < _FREE_SHARE * n_usable)] = 0
        return median[self._patch]

    def _learn(self, free: Flags, passed_s: float, limit: Floats) -> None:
        own = self.own + self.lag
        product, square = self.product + own * self.common, self.square + self.common * self.common
        doubt = (_DOUBT * limit) ** 2
        ratio = (product + doubt) / (square + doubt)
        self._unlevelled_s += passed_s
        if self._unlevelled_s > _LEVEL_EVERY_S:
            self._unlevelled_s = 0.0
            median, found = self._median(ratio, free)
            self._typical = np.where((found > 0) & (median > 0), median, np.float32(1))[self._patch]
        np.copyto(self.factor, np.clip(ratio / self._typical, _LEAST_FACTOR, _MOST_FACTOR), where=free)
        over = np.abs(self.common) > _STRETCH * limit
        if over.any():
            self.product[over], self.square[over] = product[over] / 2, square[over] / 2
            self.own[over], self.common[over] = -self.lag[over], 0
