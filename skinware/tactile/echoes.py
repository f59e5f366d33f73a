"""Find taxels that feel what is pressed elsewhere: exchanged, shorted, or with crosstalk.

A taxel is *alone* while it is pressed and none of its neighbours is. One that is alone again and again is watched, and
so is one that misses its touches. Its value while its neighbours are untouched is compared with the loads of all other
places.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from skinware.tactile.dues import Pairs, Shares
from skinware.tactile.health_evidence import Doubles, Flags, Floats, Whole
from skinware.tactile.neighbours import NONE, Table

_MOST = 32
"""Taxels that are watched at once."""
_APART_S = 1.0
_FORGOTTEN_S = 1800.0
_OFTEN = 2.0
"""Times the median: any taxel is alone now and then, as a stroke begins or ends there."""
_EPISODES = 4
"""Separate echoes that a judgement needs."""
_EXPLAINED = 0.6
"""Share of what a taxel shows alone that the load of one other place must explain."""
_MUTUAL = 0.4
"""The same where two taxels explain each other."""
_LEAST_ECHO = 0.03
"""Share of a load: a smaller echo is noise."""
_STEEP = 0.5
"""Share of the larger of two loads by which they differ at least, where a step between both is looked for."""
_BETWEEN = 0.3
"""Share of the same load that the taxels in between show at least, together."""


class Echo(NamedTuple):
    """The place that k watched taxels feel.

    Attributes:
        taxel: (k,) the watched taxels.
        partner: (k,) the places.
        share: (k,) the share of the load there that each shows.
        alike: (k,) the share of what the taxel of that place shows.
    """

    taxel: Whole
    partner: Whole
    share: Doubles
    alike: Doubles


class Echoes:
    """Compares watched taxels with the loads of all n places.

    Args:
        ring: (n, k) the nearest neighbours of each.

    Attributes:
        alone: (n,) float64, how often each was alone; older times count less.
    """

    def __init__(self, ring: Table) -> None:
        n = len(ring)
        self._ring = ring
        self.alone = np.zeros(n)
        self._alone_s = np.full(n, -math.inf)
        self._watched: Whole = np.zeros(0, np.int64)
        self._sums = np.zeros((4, 0, n), np.float32)
        """For each watched taxel and place: sums of v f, f f, v w and w w; v is what the taxel shows, f the load at the
        place, w what its taxel shows."""
        self._own, self._episodes, self._heard_s = np.zeros(0), np.zeros(0, np.int64), np.zeros(0)

    def often_alone(self, times: int) -> Flags:
        """Return (n,) which were alone so many times, and far more often than others."""
        others = self.alone[self.alone > 0]
        often: Flags = self.alone >= max(times, _OFTEN * float(np.median(others)) if len(others) else 0)
        return often

    def watch(self, taxels: Whole) -> None:
        """Watch these taxels, as many as can be watched; others are given up."""
        if np.array_equal(taxels[:_MOST], self._watched):
            return
        kept = np.isin(self._watched, taxels)
        more = taxels[~np.isin(taxels, self._watched)][: _MOST - int(kept.sum())]
        zeros = np.zeros(len(more))
        self._sums = np.concatenate(
            [self._sums[:, kept], np.zeros((4, len(more), len(self.alone)), np.float32)], axis=1
        )
        self._own, self._heard_s = (
            np.concatenate([of[kept], to]) for of, to in ((self._own, zeros), (self._heard_s, zeros - math.inf))
        )
        self._episodes = np.concatenate([self._episodes[kept], zeros.astype(np.int64)])
        self._watched = np.concatenate([self._watched[kept], more])

    def add(
        self,
        now_s: float,
        deviation: Floats,
        touched: Flags,
        hard: Flags,
        due: tuple[Whole, Doubles],
        clear: float,
    ) -> None:
        """Take the next frame in.

        Args:
            now_s: its time.
            deviation: (n,) of the values from their baselines.
            touched: (n,) which are touched.
            hard: (n,) which are clearly touched.
            due: taxels with both sides touched, and what is due to them.
            clear: a load above it is clear.
        """
        active = np.flatnonzero(hard)
        if len(active):
            alone = active[~self._around(active, touched)]
            new = alone[now_s - self._alone_s[alone] > _APART_S]
            self.alone[new] = 1 + self.alone[new] * np.exp((self._alone_s[new] - now_s) / _FORGOTTEN_S)
            self._alone_s[alone] = now_s
        watched = self._watched
        if not len(watched):
            return
        rows = np.flatnonzero(~self._around(watched, touched))
        if not len(rows):
            return
        shown = np.maximum(deviation[watched[rows]], 0)
        heard = rows[shown > clear]
        self._episodes[heard] += now_s - self._heard_s[heard] > _APART_S
        self._heard_s[heard] = now_s
        self._own[rows] += shown**2 - (clear / 8) ** 2 / 2
        places = np.union1d(active, due[0])
        load = np.zeros(len(places), np.float32)
        np.maximum.at(load, np.searchsorted(places, due[0]), due[1].astype(np.float32))
        of_taxel = np.maximum(deviation[places], 0)
        load = np.maximum(load, of_taxel)
        for total, product in zip(
            self._sums, (shown[:, None] * load, load**2, shown[:, None] * of_taxel, of_taxel**2), strict=True
        ):
            total[np.ix_(rows, places)] += product

    def found(self, dark: Flags) -> Echo:
        """Return the watched taxels that one place explains, and the places.

        Args:
            dark: (n,) taxels that do not show what presses their own places: the nearest ones speak for these.
        """
        both, power, beside, of_taxel = self._sums.astype(np.float64)
        watched, rows = self._watched, np.arange(len(self._watched))
        with np.errstate(divide="ignore", invalid="ignore"):
            explained = np.nan_to_num(both**2 / (np.maximum(self._own, 0)[:, None] * power), posinf=0)
            share, alike = both / power, beside / of_taxel
        explained[rows, watched] = 0
        place = explained.argmax(axis=1) if len(rows) else rows
        certain = explained[rows, place]
        best, share, alike = place.copy(), share[rows, place], alike[rows, place]
        is_dark = dark[watched]
        for row in np.flatnonzero(~dark[place]).tolist():
            near = watched[is_dark & (self._ring[watched] == place[row]).any(axis=1) & (watched != watched[row])]
            if len(near):
                place[row] = near[explained[row, near].argmax()]
        at = {taxel: row for row, taxel in enumerate(watched.tolist())}
        other = np.array([at.get(taxel, -1) for taxel in place.tolist()], np.int64)
        mutual = (other >= 0) & (place[other] == watched)
        clear = (certain > np.where(mutual, _MUTUAL, _EXPLAINED)) & (self._episodes >= _EPISODES)
        clear &= (share > _LEAST_ECHO) & ((place == best) | mutual)
        return Echo(watched[clear], place[clear], share[clear], np.nan_to_num(alike[clear]))

    def _around(self, taxels: Whole, touched: Flags) -> Flags:
        ring = self._ring[taxels]
        known = ring != NONE
        around: Flags = (touched[ring] & known).any(axis=1) | ~known.any(axis=1)
        return around


class Steps:
    """Compares neighbours that should differ: the taxel before the first is pressed hard, the one behind the last not.

    Of four taxels in a line, the two in the middle then differ, too, by a third of that at least where the load falls
    off evenly, unless both are connected.

    Args:
        pairs: the pairs of opposite neighbours round each taxel.

    Attributes:
        inner: (k, 2) the two in the middle of each line.
        shares: of the difference of the outer ones that the inner ones showed.
    """

    def __init__(self, pairs: Pairs) -> None:
        lines = pairs.lines()
        self.inner: Whole = lines[:, 1:3]
        self.shares = Shares(len(lines))
        self._outer: Whole = lines[:, [0, 3]]
        n = len(pairs.ring)
        of_taxel = np.concatenate([self._outer[:, 0], self._outer[:, 1]])
        order = np.argsort(of_taxel, kind="stable")
        count = np.bincount(of_taxel, minlength=n)
        column = np.arange(len(order)) - np.repeat(np.cumsum(count) - count, count)
        self._lines = np.full((n, int(count.max(initial=0))), NONE, np.int64)
        self._lines[of_taxel[order], column] = order % max(len(lines), 1)

    def add(self, now_s: float, deviation: Floats, usable: Flags, hard: Flags) -> None:
        """Take the next frame in; arguments as of :meth:`.Dues.add`."""
        active = np.flatnonzero(hard)
        line = np.unique(self._lines[active])
        line = line[line != NONE]
        line = line[usable[self._outer[line]].all(axis=1) & usable[self.inner[line]].all(axis=1)]
        outer, inner = (np.maximum(deviation[of[line]], 0).astype(np.float64) for of in (self._outer, self.inner))
        step = outer[:, 0] - outer[:, 1]
        tells = (np.abs(step) > _STEEP * outer.max(axis=1)) & (inner.sum(axis=1) > _BETWEEN * outer.max(axis=1))
        line, step, inner = line[tells], step[tells], inner[tells]
        if len(line):
            self.shares.add(now_s, line, np.abs(step), np.abs(inner[:, 0] - inner[:, 1]))

    def level(self, touches: int, most: float) -> Whole:
        """Return (k, 2) neighbours that differ by less than a share of what they should, in this many touches."""
        return np.unique(self.inner[self.shares.share(touches) < most], axis=0)
