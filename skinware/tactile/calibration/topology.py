"""Who lies beside whom, and how far apart, from strokes alone.

For touches of the shape of a bell, sqrt(-ln S) grows in proportion to the distance of two taxels, where S is the
cosine between what they felt. Nothing else is needed but one length: the pitch of the lattice.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from skinware.tactile.calibration.strokes import StrokeSums
from skinware.tactile.components import Components
from skinware.tactile.neighbours import neighbours_of_pairs

ArrayF = npt.NDArray[np.float64]
ArrayI = npt.NDArray[np.int64]

PITCH_M = 0.0065
"""Of ROBOSKIN."""
_LEAST_SIMILAR = 0.05
"""Below this the tail of a bell is noise."""
_BESIDE = 1.6
"""Neighbours, in pitches: between the first and the second ring of a lattice of triangles."""
_TOGETHER = 0.012
"""Taxels so similar are of one piece: a strip that was hardly stroked is more, noise between pieces less."""
_NEAREST = 3
"""So many of each taxel's nearest are typically a pitch away: in a lattice of triangles six are, at its edge three."""


@dataclass(frozen=True)
class Topology:
    """What strokes tell of n taxels.

    Attributes:
        pairs: (k, 2) int64, those that lie beside each other, the lower number first.
        distance_m: (n, n), m, straight distances of pairs that are near enough to be measured; inf of all others.
        piece: (n,) int64, the piece of skin that each is in, from the largest, 0; -1: felt too little.
    """

    pairs: ArrayI
    distance_m: ArrayF
    piece: ArrayI

    @property
    def n_pieces(self) -> int:
        """Number of pieces."""
        return int(self.piece.max(initial=-1)) + 1

    def geodesics_m(self, taxels: ArrayI) -> ArrayF:
        """(k, k) the shortest ways between k taxels over measured distances, m; inf where there is none."""
        ways: ArrayF = self.distance_m[np.ix_(taxels, taxels)].copy()
        np.fill_diagonal(ways, 0)
        return shortest_m(ways)


def topology_of(sums: StrokeSums, pitch_m: float = PITCH_M) -> Topology:
    """The topology of a skin that was stroked.

    Args:
        sums: of the strokes.
        pitch_m: distance between the nearest taxels, m.
    """
    similarity = sums.similarity()
    with np.errstate(divide="ignore"):
        far = np.where(similarity > _LEAST_SIMILAR, np.sqrt(-np.log(similarity)), np.inf)
    np.fill_diagonal(far, np.inf)
    distance = far * _scale(far, pitch_m)
    n = len(sums)
    one, other = np.nonzero(np.triu(distance <= _BESIDE * pitch_m))
    near = np.column_stack(np.nonzero(np.triu(similarity > _TOGETHER)))
    piece = np.full(n, -1, np.int64)
    rows = np.flatnonzero(sums.known)
    component, _ = Components(n, neighbours_of_pairs(near, n)).of(rows)
    _, number, size = np.unique(component, return_inverse=True, return_counts=True)
    piece[rows] = np.argsort(np.argsort(-size, kind="stable"))[number]
    return Topology(np.column_stack([one, other]), distance, piece)


def _scale(far: ArrayF, pitch_m: float) -> float:
    """Metres to one unit of sqrt(-ln S): the nearest taxels are a pitch away."""
    if len(far) <= _NEAREST:
        return pitch_m
    nearest = np.sort(far, axis=1)[:, :_NEAREST]
    nearest = nearest[np.isfinite(nearest)]
    typical = float(np.median(nearest)) if len(nearest) else 0.0
    return pitch_m / typical if typical > 0 else pitch_m


def shortest_m(distance_m: ArrayF) -> ArrayF:
    """(k, k) the shortest ways over a (k, k) table of distances, whose diagonal is 0, inf where there is none."""
    ways = distance_m.copy()
    for between in range(len(ways)):
        np.minimum(ways, ways[:, between, None] + ways[None, between], out=ways)
    return ways
