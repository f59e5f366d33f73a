"""Estimate how baselines drift and sag: what a patch has in common, and what each taxel does alone."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from skinware.tactile.rule import (
    COVER_RETURNS_BY,
    COVER_RETURNS_S,
    DOUBT,
    FREE_SHARE,
    LEAST_FACTOR,
    LEVEL_EVERY_S,
    MOST_FACTOR,
    STRETCH,
)

Floats = npt.NDArray[np.float32]
Flags = npt.NDArray[np.bool_]


class Drift:
    """Follows the drift of n taxels.

    Args:
        patch: (n,) int, the patch of each taxel: its taxels drift together.

    Attributes:
        factor: (n,) float32, each taxel's drift in proportion to that of its patch.
        own: (n,) float32, how far each has drifted away from contacts since its last stretch began.
        common: (n,) float32, how far its patch has drifted meanwhile.
        product: (n,) float32, sum of own times common drift over the stretches before.
        square: (n,) float32, sum of the squares of common drift.
        lag: (n,) float32, how far each has yet to follow, beside the common drift, over some seconds.
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
        """Return (n,) how far the baselines move in this time.

        Args:
            deviation: (n,) of the values from the baselines; 0 where not usable.
            usable: (n,) which taxels have values.
            free: (n,) which of them are away from contacts.
            passed_s: since the last step.
            tau_s: time constant of own drift.
            common_tau_s: time constant of common drift.
            limit: (n,) threshold of touch, above 0: no common drift reaches it within a time constant.
        """
        own_share, common_share = (np.float32(-math.expm1(-passed_s / tau)) for tau in (tau_s, common_tau_s))
        median, n_free = self._median(deviation / self.factor, free)
        n_usable = np.bincount(self._patch[usable], minlength=len(n_free))
        median[(n_free == 0) | (n_free < FREE_SHARE * n_usable)] = 0
        common = np.clip(median[self._patch], -limit, limit)
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

    def _learn(self, free: Flags, passed_s: float, limit: Floats) -> None:
        own = self.own + self.lag
        product, square = self.product + own * self.common, self.square + self.common * self.common
        doubt = (DOUBT * limit) ** 2
        ratio = (product + doubt) / (square + doubt)
        self._unlevelled_s += passed_s
        if self._unlevelled_s > LEVEL_EVERY_S:
            self._unlevelled_s = 0.0
            median, found = self._median(ratio, free)
            self._typical = np.where((found > 0) & (median > 0), median, np.float32(1))[self._patch]
        np.copyto(self.factor, np.clip(ratio / self._typical, LEAST_FACTOR, MOST_FACTOR), where=free)
        over = np.abs(self.common) > STRETCH * limit
        if over.any():
            self.product[over], self.square[over] = product[over] / 2, square[over] / 2
            self.own[over], self.common[over] = -self.lag[over], 0


Rows = npt.NDArray[np.intp]


class Sag:
    """Remembers how far the baselines of n taxels went down while their patch was touched.

    A cover that is pressed sinks around the contact, farther than the module that is held. The baselines of free taxels
    there follow it down. They go up again with the cover when the contact is over, or its return would be a touch.

    Args:
        module: (n,) int, the module of each taxel.
        patch: (n,) int, the patch of each taxel.
    """

    def __init__(self, module: Rows, patch: Rows) -> None:
        self._module, self._patch = module, patch
        self._patch_of_module = np.zeros(int(module.max(initial=-1)) + 1, np.intp)
        self._patch_of_module[module] = patch
        self._is_touched = np.zeros(len(self._patch_of_module), bool)
        self._in_contact = np.zeros(int(patch.max(initial=-1)) + 1, bool)
        self._since_end_s = np.full(len(self._in_contact), np.inf)
        self._sunk: Floats = np.zeros(len(module), np.float32)

    def sink(self, by: Floats) -> None:
        """Note how far (n,) baselines went down beside the common drift; below 0, they went up."""
        if self._in_contact.any():
            self._sunk += by * self._in_contact[self._patch]
            np.maximum(self._sunk, 0, out=self._sunk)

    def come_back(self, deviation: Floats, touched: Flags, off: Floats, passed_s: float) -> Floats:
        """Follow the contacts, and return (n,) how far the baselines go up where the sag is over.

        Args:
            deviation: (n,) of the values from the baselines.
            touched: (n,) which taxels were touched in the last frame.
            off: (n,) threshold below which a touch ends.
            passed_s: since the last frame.
        """
        is_touched = np.zeros(len(self._is_touched), bool)
        is_touched[self._module[touched]] = True
        self._since_end_s += passed_s
        self._since_end_s[self._patch_of_module[self._is_touched & ~is_touched]] = 0
        self._is_touched = is_touched
        self._in_contact[:] = False
        self._in_contact[self._patch_of_module[is_touched]] = True
        is_ending = self._since_end_s < COVER_RETURNS_S
        if not is_ending.any():
            if not self._in_contact.all():
                self._sunk *= self._in_contact[self._patch]
            return np.zeros_like(self._sunk)
        is_back = is_ending[self._patch] & (deviation > off) & (deviation < COVER_RETURNS_BY * self._sunk + off)
        up = self._sunk * is_back
        self._sunk -= up
        return up


class GroupMedian:
    """Computes the medians of n values by group.

    Groups of similar size are rows of one table, which is sorted at once. A table is at most twice as wide as its
    smallest group: one huge group beside a thousand small ones costs no more than their members.

    Args:
        group: (n,) int, the group of each value, 0 or more.
    """

    def __init__(self, group: npt.NDArray[np.integer]) -> None:
        self.n_groups = int(group.max(initial=-1)) + 1
        self._group = group
        sizes = np.bincount(group, minlength=self.n_groups)
        members = np.split(np.argsort(group, kind="stable"), np.cumsum(sizes)[:-1])
        self._tables: list[tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]] = []
        by_size = [int(number) for number in np.argsort(sizes, kind="stable") if sizes[number]]
        while by_size:
            widest = 2 * sizes[by_size[0]]
            rows = [number for number in by_size if sizes[number] <= widest]
            by_size = by_size[len(rows) :]
            table = np.full((len(rows), sizes[rows[-1]]), len(group), np.intp)  # beyond the values stands infinity
            for row, number in enumerate(rows):
                table[row, : sizes[number]] = members[number]
            self._tables.append((np.array(rows, np.intp), table))
        self._values = np.full(len(group) + 1, np.inf, np.float32)

    def __call__(
        self, values: npt.NDArray[np.float32], counts: npt.NDArray[np.bool_]
    ) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.intp]]:
        """Compute the medians of the values that count.

        Args:
            values: (n,) finite where they count.
            counts: (n,) which of them count.

        Returns:
            (n_groups,) medians, NaN where no value counts; and (n_groups,) how many count.
        """
        medians = np.full(self.n_groups, np.nan, np.float32)
        found = np.bincount(self._group[counts], minlength=self.n_groups)
        self._values[:-1] = np.where(counts, values, np.inf)
        for rows, table in self._tables:
            ordered = np.sort(self._values[table], axis=1)
            each, number = np.arange(len(rows)), found[rows]
            twice = ordered[each, np.maximum(number - 1, 0) // 2] + ordered[each, number // 2]
            medians[rows] = np.where(number > 0, twice / 2, np.nan)
        return medians, found
