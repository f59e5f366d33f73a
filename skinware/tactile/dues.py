"""Compare taxels with what is due to them, by what presses both their sides."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from skinware.geometry import Geometry
from skinware.tactile.health_evidence import APART_S, KEPT, Doubles, Flags, Floats, Whole
from skinware.tactile.neighbours import NONE, Table, pitch_m

_MOST_AT_ONCE = 2048
"""Touched taxels that are compared in one frame; if there are more, each frame takes another part."""
_NEAR_PITCHES = 1.3
"""Pitches: only the nearest ring of neighbours says much about the taxel in the middle."""
_OPPOSITE_COSINE = -0.9
"""Cosine of the angle from one neighbour to the other: they are opposite beyond some 155 degrees."""
_EVEN = 1.4
"""Times: the farther of two opposite neighbours is at most this much farther than the nearer."""
MOST_PAIRS = 4
"""Pairs round one taxel that count: a lattice of triangles has three."""
_MISSED, _FELT = 0.1, 0.35
"""Shares of its due: with less, a taxel missed a touch; with more, it felt it."""
_MOST_SHARE = 2.0
_FORGOTTEN_PER_TOUCH = 0.005
_ENOUGH_TOUCHES = 12.0
_LEAST_SPAN_H = 0.1
"""Touches, and hours from the first to the last, that a trend needs."""


class Shares:
    """Adds up what k cells showed of what was due to them, each touch by its hardest moment.

    Attributes:
        due: (k,) sum of the squares of what was due in the touches so far; older ones count less.
        shown: (k,) the same sum of due times shown.
        touches: (k,) int64, separate touches.
    """

    def __init__(self, k: int) -> None:
        self.due, self.shown = np.zeros(k), np.zeros(k)
        self.touches: Whole = np.zeros(k, np.int64)
        self._hardest_due, self._hardest_shown = np.zeros(k), np.zeros(k)
        self._compared_s = np.full(k, -math.inf)

    def add(self, now_s: float, cell: Whole, due: Doubles, shown: Doubles) -> tuple[Whole, Doubles, Doubles]:
        """Take (m,) comparisons of one frame in; return the cells whose last touches are over, their due and shown."""
        over = np.unique(cell[now_s - self._compared_s[cell] >= APART_S])
        ended = self._end(over[self._hardest_due[over] > 0])
        self._compared_s[cell] = now_s
        harder = np.flatnonzero(due > self._hardest_due[cell])
        harder = harder[np.argsort(due[harder], kind="stable")]  # of several in one cell the hardest stays
        self._hardest_due[cell[harder]], self._hardest_shown[cell[harder]] = due[harder], shown[harder]
        return ended

    def share(self, touches: int) -> Doubles:
        """Return (k,) the share of its due that each showed; NaN after fewer touches."""
        known = (self.touches >= touches) & (self.due > 0)
        share: Doubles = np.where(known, self.shown, math.nan) / np.where(known, self.due, 1)
        return share

    def _end(self, cells: Whole) -> tuple[Whole, Doubles, Doubles]:
        due, shown = self._hardest_due[cells], self._hardest_shown[cells]
        self.due[cells] = KEPT * self.due[cells] + due * due
        self.shown[cells] = KEPT * self.shown[cells] + due * shown
        self.touches[cells] += 1
        self._hardest_due[cells] = 0
        return cells, due, shown


class Dues:
    """Compares n taxels with what is due to them: the geometric mean of both their sides, where both are touched.

    Args:
        pairs: the pairs round each taxel.

    Attributes:
        shares: one cell for each pair round a taxel.
        returns: (n,) how often each felt a touch again after it had missed some; older ones count less.
        sums: (n, 6) of a line through the shares over time, in hours: weights, times, their squares, shares, products
            and squares of shares.
        distrusted: (n,) bool, taxels whose word does not count for those between them.
    """

    def __init__(self, pairs: Pairs) -> None:
        n = len(pairs.sides)
        self._pairs, self._frames = pairs, 0
        self.shares = Shares(n * MOST_PAIRS)
        self.returns, self.sums = np.zeros(n), np.zeros((n, 6))
        self.distrusted: Flags = np.zeros(n, bool)
        self._missed: Flags = np.zeros(n, bool)

    def add(self, now_s: float, deviation: Floats, usable: Flags, hard: Flags) -> tuple[Whole, Doubles]:
        """Take the next frame in.

        Args:
            now_s: its time.
            deviation: (n,) of the values from their baselines.
            usable: (n,) which of them are of this frame.
            hard: (n,) taxels that are clearly touched.

        Returns:
            (m,) taxels of whose sides both are touched, and (m,) what is due to them.
        """
        self._frames += 1
        active = np.flatnonzero(hard)
        step = len(active) // _MOST_AT_ONCE + 1
        cell, one, other = self._pairs.around(active[self._frames % step :: step], hard)
        middle = cell // MOST_PAIRS
        known = usable[middle]
        cell, one, other, middle = cell[known], one[known], other[known], middle[known]
        shown, left, right = (np.maximum(deviation[taxel], 0).astype(np.float64) for taxel in (middle, one, other))
        due = np.sqrt(left * right)
        if len(cell):
            self._note(now_s, *self.shares.add(now_s, cell, due, shown))
        return middle, due

    def shown(self, touches: int) -> tuple[Doubles, Whole]:
        """Return (n,) the share of its due that each taxel showed, NaN after fewer touches; and (n,) the touches.

        Between several pairs, the one counts by which it showed most: only a fault of its own hides all of them. Pairs
        with a distrusted taxel do not count.
        """
        sides = self._pairs.sides
        trusted = ~self.distrusted[sides].any(axis=2)
        share = np.where(trusted, self.shares.share(touches).reshape(trusted.shape), math.nan)
        count = np.where(trusted, self.shares.touches.reshape(trusted.shape), 0)
        return np.fmax.reduce(share, axis=1), count.max(axis=1)

    def trend(self) -> tuple[Doubles, Doubles]:
        """Return (n,) the part of its share that each lost since the first touch that counts, and (n,) its error."""
        weight, time, square, share, product, power = np.maximum(self.sums, 0).T
        with np.errstate(divide="ignore", invalid="ignore"):
            mean, middle = time / weight, share / weight
            spread = square - weight * mean**2
            slope = (product - weight * mean * middle) / spread
            left = power - weight * middle**2 - slope**2 * spread
            error = np.sqrt(np.maximum(left, 0) / (weight - 2) / spread)
            span = np.sqrt(12 * spread / weight)  # of even times
            first = middle - slope * span / 2
            lost, error = -slope * span / first, error * span / first
        known = (weight >= _ENOUGH_TOUCHES) & (span >= _LEAST_SPAN_H) & (first > 0)
        return np.where(known, lost, math.nan), np.where(known, error, math.nan)

    def _note(self, now_s: float, cell: Whole, due: Doubles, shown: Doubles) -> None:
        """Follow how touches that are over compare with those before."""
        middle = cell // MOST_PAIRS
        trusted = ~self.distrusted[self._pairs.sides[middle, cell % MOST_PAIRS]].any(axis=1)
        middle, share = middle[trusted], np.minimum(shown[trusted] / due[trusted], _MOST_SHARE)
        missed, felt = middle[share < _MISSED], middle[share > _FELT]
        self.returns[middle] *= KEPT
        np.add.at(self.returns, felt, self._missed[felt] / np.maximum(np.bincount(felt, minlength=1)[felt], 1))
        self._missed[missed], self._missed[felt] = True, False
        hours = now_s / 3600
        self.sums[middle] *= math.exp(-_FORGOTTEN_PER_TOUCH)
        of_touch = [np.ones(len(share)), np.full(len(share), hours), np.full(len(share), hours**2)]
        np.add.at(self.sums, middle, np.column_stack([*of_touch, share, share * hours, share**2]))


class Pairs:
    """The pairs of taxels on opposite sides of each of n taxels, at about the same distance.

    Args:
        geometry: places of the n taxels; one whose place is not known lies between none.
        table: (n, k) int32, which taxels lie beside each other: :func:`skinware.tactile.neighbours.neighbours`.

    Attributes:
        ring: (n, k) int32, the nearest of them.
        sides: (n, 4, 2) the pairs round each taxel; a taxel with fewer pairs has 0 in the others.
    """

    def __init__(self, geometry: Geometry, table: Table) -> None:
        away_m = np.linalg.norm(geometry.position_m[table] - geometry.position_m[:, None], axis=2)
        close = (table != NONE) & (away_m > 0) & (away_m <= _NEAR_PITCHES * pitch_m(geometry)[:, None])
        nearest = np.argsort(~close, axis=1, kind="stable")[:, : int(close.sum(axis=1).max(initial=0))]
        ring = np.take_along_axis(np.where(close, table, np.int32(NONE)), nearest, axis=1)
        middle, one, other, number = _numbered(*_opposite(geometry, ring))
        first = np.argsort(one, kind="stable")
        count = np.bincount(one, minlength=len(geometry))
        shape = len(geometry), int(count.max(initial=0))
        column = np.arange(len(one)) - np.repeat(np.cumsum(count) - count, count)
        self._cell, self._other = np.full(shape, NONE, np.int64), np.full(shape, NONE, np.int32)
        self._cell[one[first], column] = middle[first] * MOST_PAIRS + number[first]
        self._other[one[first], column] = other[first]
        self.ring: Table = ring
        self.sides = np.zeros((len(geometry), MOST_PAIRS, 2), np.int64)
        self.sides[middle, number] = np.column_stack([one, other])

    def lines(self) -> Whole:
        """Return (k, 4) taxels in a line, each beside the next; the second has a lower number than the third."""
        taxel, number = np.nonzero(self.sides.any(axis=2))
        one, other = self.sides[taxel, number].T
        before, middle, behind = (np.concatenate(both) for both in ((one, other), (taxel, taxel), (other, one)))
        n = len(self.sides)
        first, last = middle * n + behind, before * n + middle
        order = np.argsort(last, kind="stable")
        begin, end = (np.searchsorted(last[order], first, side=side) for side in ("left", "right"))
        row = np.repeat(np.arange(len(first)), end - begin)
        found = order[np.arange(len(row)) - np.repeat(np.cumsum(end - begin) - end, end - begin)]
        lines = np.column_stack([before[row], middle[row], behind[row], behind[found]])
        return lines[lines[:, 1] < lines[:, 2]].astype(np.int64)

    def around(self, taxels: Whole, touched: Flags) -> tuple[Whole, Whole, Whole]:
        """Find taxels between two touched ones.

        Args:
            taxels: the touched ones from which pairs are looked for: all of them, or a part.
            touched: (n,) bool.

        Returns:
            (m,) the cells of the pairs, each taxel has :data:`MOST_PAIRS`; (m,) the one side and (m,) the other.
        """
        other = self._other[taxels]
        row, column = np.nonzero(touched[other] & (other != NONE))
        found = taxels[row]
        return self._cell[found, column], found, other[row, column].astype(np.int64)


def _opposite(geometry: Geometry, ring: Table) -> npt.NDArray[Any]:
    """(3, m): a taxel and two of its nearest neighbours, on opposite sides, the lower number first."""
    way_m = np.where((ring != NONE)[:, :, None], geometry.position_m[ring] - geometry.position_m[:, None], np.nan)
    length_m = np.linalg.norm(way_m, axis=2)
    found = [np.zeros((3, 0), np.int64)]
    for one in range(ring.shape[1]):
        for other in range(one + 1, ring.shape[1]):
            product = np.einsum("ij,ij->i", way_m[:, one], way_m[:, other])
            cosine = product / (length_m[:, one] * length_m[:, other])
            uneven = np.maximum(length_m[:, one] / length_m[:, other], length_m[:, other] / length_m[:, one])
            middle = np.flatnonzero((cosine <= _OPPOSITE_COSINE) & (uneven <= _EVEN))
            found.append(np.stack([middle, ring[middle, one], ring[middle, other]]))
    return np.concatenate(found, axis=1).astype(np.int64)


def _numbered(middle: Whole, one: Whole, other: Whole) -> tuple[Whole, Whole, Whole, Whole]:
    """The first pairs round each taxel, each with its number there."""
    order = np.argsort(middle, kind="stable")
    middle, one, other = middle[order], one[order], other[order]
    number = np.arange(len(middle)) - np.searchsorted(middle, middle)
    kept = number < MOST_PAIRS
    return middle[kept], one[kept], other[kept], number[kept]
