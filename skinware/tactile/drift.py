"""Drift of baselines: what is common to a patch, what is each taxel's own, and how strongly each follows the common."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from skinware.tactile.group_median import GroupMedian

_LEAST_FACTOR, _MOST_FACTOR = 0.2, 3.0
"""Of a taxel's drift in proportion to that of its patch."""
_FREE_SHARE = 0.5
"""Of a patch must be away from contacts, or nothing is known of its common drift."""


class Drift:
    """Follows the drift of n taxels.

    Args:
        patch: (n,) int, the patch of each taxel: what drifts together.

    Attributes:
        factor: (n,) float32, each taxel's drift in proportion to that of its patch, learned away from contacts.
        own_path: (n,) float32, what the baselines away from contacts have moved in all.
        common_path: (n,) float32, what their patches' common drift was meanwhile.
    """

    def __init__(self, patch: npt.NDArray[np.intp]) -> None:
        self._patch = patch
        self._median = GroupMedian(patch)
        self.factor: npt.NDArray[np.float32] = np.ones(len(patch), np.float32)
        self.own_path: npt.NDArray[np.float32] = np.zeros(len(patch), np.float32)
        self.common_path: npt.NDArray[np.float32] = np.zeros(len(patch), np.float32)

    def step(
        self,
        deviation: npt.NDArray[np.float32],
        usable: npt.NDArray[np.bool_],
        free: npt.NDArray[np.bool_],
        *,
        passed_s: float,
        tau_s: float,
        common_tau_s: float,
        limit: npt.NDArray[np.float32],
    ) -> npt.NDArray[np.float32]:
        """How far the baselines move in this time.

        Args:
            deviation: (n,) of the values from the baselines.
            usable: (n,) which taxels have values.
            free: (n,) which of them are away from contacts.
            passed_s: the time.
            tau_s, common_tau_s: time constants of own and of common drift.
            limit: (n,) what no drift reaches within a time constant, above 0.
        """
        own_share, common_share = (np.float32(-math.expm1(-passed_s / tau)) for tau in (tau_s, common_tau_s))
        common = self._common_drift(deviation, usable, free)
        np.clip(common, -limit, limit, out=common)
        followed = self.factor * common
        change = followed * common_share
        change += (deviation - followed) * own_share * free
        change *= usable
        self._learn(change, common * common_share, free, limit)
        return change

    def _common_drift(
        self, deviation: npt.NDArray[np.float32], usable: npt.NDArray[np.bool_], free: npt.NDArray[np.bool_]
    ) -> npt.NDArray[np.float32]:
        """(n,) the drift of each taxel's patch; 0 where too much of it is in contact to tell."""
        median, n_free = self._median(deviation / self.factor, free)
        n_usable = n_free if free is usable else np.bincount(self._patch[usable], minlength=len(n_free))
        median[(n_free == 0) | (n_free < _FREE_SHARE * n_usable)] = 0
        return median[self._patch]

    def _learn(
        self,
        change: npt.NDArray[np.float32],
        common: npt.NDArray[np.float32],
        free: npt.NDArray[np.bool_],
        limit: npt.NDArray[np.float32],
    ) -> None:
        self.own_path += change * free
        self.common_path += common * free
        own, common = self.own_path * np.sign(self.common_path), np.abs(self.common_path)
        np.clip((own + limit) / (common + limit), _LEAST_FACTOR, _MOST_FACTOR, out=self.factor)
