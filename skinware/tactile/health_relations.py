"""Find taxels that show touches of others: exchanged, shorted, with crosstalk; and those that lose their values."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from skinware.tactile.arrays import Arrays, Doubles, Flags, Floats, Whole
from skinware.tactile.baseline import Calm
from skinware.tactile.neighbours import NONE, Table

KEPT = 0.95
"""Weight that older touches keep with each new one: a mended taxel is good again after some touches."""
APART_S = 1.0
"""Seconds: touches of a taxel with less time between them count as one."""
_FEWEST_AROUND = 3  # neighbours with a known share that a comparison with neighbours needs
_MOST_EXCHANGED = 64  # weak taxels that are compared with each other
_MOST_COMPARED = 1024  # touched taxels that are compared with their neighbours in one frame
_STEADY = 0.25  # share of a jump: neighbours that change less have not felt it
_BACK = 0.2  # share of a jump: the value is back if it differs by less from the one before
_LOST_S = 2.0  # seconds: what lasts longer is no dropout
_FORGET_S = 600.0  # seconds in which half of the dropouts are forgotten
_CHANGE_S = 0.4  # seconds over which values are averaged: a slow stroke changes little from one frame to the next
_CLEAR_CHANGE = 6.0  # times the noise of a change: it is no noise
_BELOW = 0.8  # part of its value that another must show, where a taxel seems to be touched alone
_MOST_SHARE = 1.25  # part of the touches of another, beyond which they are not the reason of its own
_MOST_ALONE = 256  # taxels that are compared with all others of their modules


def lower_median(numbers: npt.NDArray[np.floating[Any]]) -> tuple[npt.NDArray[np.floating[Any]], Whole]:
    """(m,) the lower median of the numbers of each row that are not NaN, and (m,) how many these are."""
    ordered = np.sort(numbers, axis=1)  # NaN comes last
    count: Whole = (~np.isnan(ordered)).sum(axis=1)
    return ordered[np.arange(len(numbers)), np.maximum(count - 1, 0) // 2], count


def median_around(table: Table, shares: Doubles, part: float) -> Doubles:
    """(n,) the median share of the neighbours, where a taxel's own may be less than a part of it; else NaN."""
    around = np.full(len(shares), math.nan)
    most = np.nanmax(shares) if np.isfinite(shares).any() else 0.0
    rows = np.flatnonzero(shares < part * most)
    if len(rows):
        median, count = lower_median(np.where(table[rows] == NONE, math.nan, shares[table[rows]]))
        enough = count >= _FEWEST_AROUND
        around[rows[enough]] = median[enough]
    return around


def _most_around(table: Table, taxels: Whole, changes: Floats) -> Floats:
    """(m,) the largest change of the neighbours of m taxels."""
    around = table[taxels]
    most: Floats = np.where(around == NONE, np.float32(0), changes[around]).max(axis=1, initial=0)
    return most


class Dropouts:
    """Counts how often each of n taxels loses its value and has it back soon, while its neighbours keep theirs."""

    def __init__(self, table: Table) -> None:
        self._table = table
        self.count: Floats = np.zeros(len(table), np.float32)
        self._lost_s = np.full(len(table), -math.inf)
        self._before, self._lost = np.zeros((2, len(table)), np.float32)

    def add(self, now_s: float, arrays: Arrays, calm: Calm) -> None:
        """Take in a sample in which some have moved, by the arrays of ``struct health``."""
        before, given, jump, far = (arrays[name] for name in ("value", "given", "jump", "far"))
        moved = np.flatnonzero(arrays["moved"])
        moved = moved[_most_around(self._table, moved, jump) <= _STEADY * jump[moved]]
        back = (now_s - self._lost_s[moved] <= _LOST_S) & (
            np.abs(given[moved] - self._before[moved])
            <= _BACK * np.abs(self._before[moved] - self._lost[moved]) + far[moved]
        )
        self.count[moved[back]] += 1
        self._lost_s[moved[back]] = -math.inf
        rest = calm.baseline[moved]
        around = self._table[moved]
        is_beside = (calm.touched[around] & (around != NONE)).any(axis=1)  # a touch that they still feel
        drops = (given[moved] < (rest + before[moved]) / 2) & is_beside
        lost = moved[
            ~back & arrays["was_still"][moved] & (arrays["at_end"][moved] | drops | (given[moved] < rest - far[moved]))
        ]
        self._lost_s[lost], self._before[lost], self._lost[lost] = now_s, before[lost], given[lost]

    def forget(self, passed_s: float) -> None:
        self.count *= np.float32(0.5 ** (passed_s / _FORGET_S))


class Exchanges:
    """Compares taxels that show little with what is due to others such, for the place that a signal comes from."""

    def __init__(self, n: int) -> None:
        self.taxels: Whole = np.zeros(0, np.int64)
        self._rank: Whole = np.full(n, -1, np.int64)
        self._moment, self._shown = np.zeros((2, 0, 0))
        self._due, self._touches = np.zeros((2, 0))

    def watch(self, weak: Whole) -> None:
        """Compare these, in rising order; pairs that are compared already go on."""
        taxels = weak[:_MOST_EXCHANGED]
        if np.array_equal(taxels, self.taxels):
            return
        then, count = self._rank[taxels], len(taxels)
        here = np.flatnonzero(then >= 0)
        then = then[here]
        moment, shown = np.zeros((2, count, count))
        due, touches = np.zeros((2, count))
        for new, old in ((moment, self._moment), (shown, self._shown)):
            new[np.ix_(here, here)] = old[np.ix_(then, then)]
        due[here], touches[here] = self._due[then], self._touches[then]
        self._moment, self._shown, self._due, self._touches = moment, shown, due, touches
        self.taxels = taxels
        self._rank[:] = -1
        self._rank[taxels] = np.arange(count)

    def note(self, taxels: Whole, above: Floats) -> None:
        """Keep what is shown at the hardest moment so far of a touch of these, by (n,) values above the baselines."""
        rank = self._rank[taxels]
        self._moment[rank[rank >= 0]] = np.maximum(above[self.taxels], 0)

    def end(self, taxels: Whole, due: Doubles) -> None:
        """End the touches of some taxels, to which so much was due."""
        rank = self._rank[taxels]
        rank, due = rank[rank >= 0], due[rank >= 0]
        self._shown[rank] = KEPT * self._shown[rank] + due[:, None] * self._moment[rank]
        self._due[rank] = KEPT * self._due[rank] + due * due
        self._touches[rank] += due > 0
        self._moment[rank] = 0

    def found(self, share: float, touches: int) -> tuple[Whole, Whole]:
        """(m,) the taxels that show at least this share of the due of others, and (m,) those others."""
        known = self._touches >= touches
        shares = np.where(known[:, None], self._shown, 0) / np.where(known, self._due, 1)[:, None]
        if not len(shares):
            return self.taxels, self.taxels
        place = np.argmax(shares, axis=0)  # of each signal
        rows = np.flatnonzero(shares[place, np.arange(len(place))] >= share)
        return self.taxels[rows], self.taxels[place[rows]]


class Copies:
    """Finds taxels that change with another of their module, while their own neighbours do not.

    Changes are those of means over some samples, from what the neighbours do: a cover sags round a touch. ``total`` is
    (n,), the sum of the values so far, which begins again with each mean.
    """

    def __init__(self, module: npt.NDArray[np.intp], table: Table, total: Floats) -> None:
        self._module, self._table, self._sum = module, table, total
        self._is_known: Flags = (table != NONE).any(axis=1)
        self._frames = 0
        self._before: Floats = np.full(len(table), np.nan, np.float32)
        self._before_s = -math.inf
        self._alone: dict[int, _Alone] = {}

    def add(self, now_s: float, noise: float) -> None:
        """Take in that ``total`` has another sample; ``noise`` is that of the typical taxel."""
        self._frames += 1
        if now_s - self._before_s < _CHANGE_S:
            return
        mean = (self._sum / self._frames).astype(np.float32)
        clear = _CLEAR_CHANGE * noise * math.sqrt(2 / self._frames)
        change = np.nan_to_num(mean - self._before)
        self._before, self._before_s, self._frames = mean, now_s, 0
        self._sum[:] = 0
        self._compare(now_s, change, clear)

    def _compare(self, now_s: float, change: Floats, clear: float) -> None:
        """Take in changes, of which one above ``clear`` is no noise."""
        size = np.abs(change)
        felt = np.flatnonzero(size > clear)[:_MOST_COMPARED]
        is_in_use = np.zeros(int(self._module.max(initial=-1)) + 1, bool)
        is_in_use[self._module[felt]] = True
        rows = np.flatnonzero(is_in_use[self._module] & self._is_known)[:_MOST_COMPARED]
        if not len(rows):
            return
        around = np.where(self._table[rows] == NONE, np.float32(np.nan), change[self._table[rows]])
        own = change[rows] - lower_median(around)[0]
        sign, far = np.sign(own), _STEADY * np.abs(own)
        is_alone = np.nanmax(sign[:, None] * around, axis=1) <= np.maximum(far, clear / 2)
        is_alone &= (sign * change[rows] >= far) | (np.abs(own) <= clear)  # a dead taxel does not sag
        for taxel, moved in zip(rows[is_alone].tolist(), own[is_alone].tolist(), strict=True):
            if taxel not in self._alone and abs(moved) > clear:
                self._watch(taxel, felt[size[felt] >= _BELOW * abs(moved)])
            if taxel in self._alone:
                self._alone[taxel].add(now_s, moved, change, clear)

    def _watch(self, taxel: int, felt: Whole) -> None:
        """Compare a taxel from now on, if others of its module were touched as well."""
        members = np.flatnonzero(self._module == self._module[taxel])
        others = members[~np.isin(members, [taxel, *self._table[taxel]])]
        if not np.isin(others, felt).any():
            return
        if len(self._alone) == _MOST_ALONE:
            del self._alone[min(self._alone, key=lambda one: self._alone[one].touches)]
        self._alone[taxel] = _Alone(others)

    def found(self, share: float, alike: float, touches: int) -> tuple[Whole, Whole, Doubles]:
        """Find taxels that show a part of the touches of others: (m,) they, (m,) those others, and (m,) the part.

        Args:
            share: the least part.
            alike: the least correlation of both.
            touches: that a taxel must have shown while its neighbours were not touched.
        """
        found = []
        for taxel, alone in self._alone.items():
            other, part, correlation = alone.nearest()
            if alone.touches >= touches and share <= part <= _MOST_SHARE and correlation >= alike:
                found.append((taxel, other, part))
        rows = np.array(found).reshape(-1, 3)
        return rows[:, 0].astype(np.int64), rows[:, 1].astype(np.int64), rows[:, 2]


class _Alone:
    """Compares the changes of a taxel whose neighbours are still with those of some others of its module."""

    def __init__(self, others: Whole) -> None:
        self._others = others
        self.touches = 0
        self._touched_s = -math.inf
        self._own = 0.0
        self._both, self._squares = np.zeros((2, len(others)))

    def add(self, now_s: float, own: float, change: Floats, clear: float) -> None:
        if abs(own) > clear:
            if now_s - self._touched_s >= APART_S:
                self.touches += 1
                self._own *= KEPT
                self._both *= KEPT
                self._squares *= KEPT
            self._touched_s = now_s
        others = change[self._others]
        self._own += own * own
        self._both += own * others
        self._squares += others * others

    def nearest(self) -> tuple[int, float, float]:
        """The other that is most alike, the part of it that the taxel shows, and the correlation."""
        size = np.sqrt(self._squares * self._own)
        alike = np.where(size > 0, self._both, 0) / np.where(size > 0, size, 1)
        best = int(np.argmax(alike))
        return int(self._others[best]), float(self._both[best] / max(self._squares[best], 1e-9)), float(alike[best])


class Twins:
    """Compares each of n taxels with its neighbours: two that always show the same are shorted."""

    def __init__(self, table: Table) -> None:
        self._table = table
        self._difference, self._size = np.zeros((2, *table.shape), np.float32)
        self.touches: Whole = np.zeros(len(table), np.int64)
        self._compared_s = np.full(len(table), -math.inf)

    def add(self, now_s: float, above: Floats, plain: Flags, calm: Calm, noise: float) -> None:
        """Take in a sample with plain touches: its values above the baselines, and the noise of the typical taxel."""
        rows = np.flatnonzero(plain)[:_MOST_COMPARED]
        if not self._table.shape[1]:
            return
        around = self._table[rows]
        is_there = (around != NONE) & calm.usable[around]
        own, others = above[rows, None], above[around]
        new = now_s - self._compared_s[rows] >= APART_S
        self._compared_s[rows] = now_s
        self.touches[rows] += new
        for sums in (self._difference, self._size):
            sums[rows[new]] *= KEPT
        self._difference[rows] += is_there * ((own - others) ** 2 - 2 * noise * noise)
        self._size[rows] += is_there * (own * own + others * others)

    def found(self, same: float, other: float, touches: int) -> tuple[Whole, Whole]:
        """Find pairs that always show the same: (m,) taxels, and (m,) those with which they are the same.

        Args:
            same: two are the same whose squared differences, less those of noise, are less than this part of their
                squares.
            other: the median of the other neighbours differs by at least this part.
            touches: that are needed.
        """
        known = np.flatnonzero(self.touches >= touches)
        if not len(known) or not self._table.shape[1]:
            return known[:0], known[:0]
        with np.errstate(invalid="ignore", divide="ignore"):
            part = self._difference[known] / self._size[known]
        median, _ = lower_median(part)
        part[np.isnan(part)] = math.inf
        nearest = np.argmin(part, axis=1)
        rows = np.flatnonzero((part[np.arange(len(known)), nearest] <= same) & (median >= other))
        return known[rows], self._table[known[rows], nearest[rows]].astype(np.int64)
