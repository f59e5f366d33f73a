"""Which taxels lie between which: what presses both of two taxels presses those between them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from skinware.geometry import Geometry
from skinware.tactile.neighbours import NONE, Table, pitch_m

_NEAR_PITCHES = 1.3
"""Only the nearest ring of neighbours: what is felt two pitches apart says little of the middle."""
_OPPOSITE = -0.9
"""Cosine of the angle from one neighbour to the other, at least: some 155 degrees."""
_EVEN = 1.4
"""The farther of both neighbours is at most so many times as far as the nearer."""

Whole = npt.NDArray[np.int64]


class Between(NamedTuple):
    """m taxels, each between two that are touched; one that lies between several pairs is there several times.

    Attributes:
        middle: (m,) int64.
        one: (m,) int64.
        other: (m,) int64.
    """

    middle: Whole
    one: Whole
    other: Whole


class Pairs:
    """The pairs of taxels on opposite sides of each of n taxels, at about the same distance.

    Args:
        geometry: places of the n taxels; one whose place is not known lies between none.
        table: (n, k) int32, which taxels lie beside each other: :func:`skinware.tactile.neighbours.neighbours`.
    """

    def __init__(self, geometry: Geometry, table: Table) -> None:
        n = len(geometry)
        middle, one, other = _opposite(geometry, _ring(geometry, table))
        first = np.argsort(one, kind="stable")
        count = np.bincount(one, minlength=n)
        shape = n, int(count.max(initial=0))
        column = np.arange(len(one)) - np.repeat(np.cumsum(count) - count, count)
        self._middle, self._other = np.full(shape, NONE, np.int32), np.full(shape, NONE, np.int32)
        self._middle[one[first], column], self._other[one[first], column] = middle[first], other[first]
        self._has = np.zeros(n, bool)
        self._has[middle] = True

    @property
    def known(self) -> npt.NDArray[np.bool_]:
        """(n,) bool: the taxels that lie between others at all; a copy."""
        return self._has.copy()

    def around(self, taxels: Whole, touched: npt.NDArray[np.bool_]) -> Between:
        """All taxels between two touched ones.

        Args:
            taxels: the touched ones from which pairs are looked for: all of them, or a part.
            touched: (n,) bool.
        """
        other = self._other[taxels]
        row, column = np.nonzero(touched[other] & (other != NONE))
        found = taxels[row]
        return Between(self._middle[found, column].astype(np.int64), found, other[row, column].astype(np.int64))


def _ring(geometry: Geometry, table: Table) -> Table:
    """(n, k): the nearest of the neighbours of each taxel."""
    away_m = np.linalg.norm(geometry.position_m[table] - geometry.position_m[:, None], axis=2)
    close = (table != NONE) & (away_m > 0) & (away_m <= _NEAR_PITCHES * pitch_m(geometry)[:, None])
    nearest = np.argsort(~close, axis=1, kind="stable")[:, : int(close.sum(axis=1).max(initial=0))]
    ring: Table = np.take_along_axis(np.where(close, table, np.int32(NONE)), nearest, axis=1)
    return ring


def _opposite(geometry: Geometry, ring: Table) -> Between:
    """All pairs of neighbours on opposite sides of a taxel, the lower number first."""
    way_m = np.where((ring != NONE)[:, :, None], geometry.position_m[ring] - geometry.position_m[:, None], np.nan)
    length_m = np.linalg.norm(way_m, axis=2)
    found = []
    for one in range(ring.shape[1]):
        for other in range(one + 1, ring.shape[1]):
            product = np.einsum("ij,ij->i", way_m[:, one], way_m[:, other])
            cosine = product / (length_m[:, one] * length_m[:, other])
            uneven = np.maximum(length_m[:, one] / length_m[:, other], length_m[:, other] / length_m[:, one])
            middle = np.flatnonzero((cosine <= _OPPOSITE) & (uneven <= _EVEN))
            found.append(np.stack([middle, ring[middle, one], ring[middle, other]]))
    rows = np.concatenate(found, axis=1) if found else np.zeros((3, 0))
    return Between(*rows.astype(np.int64))
