"""Map a skin from strokes alone: neighbours, distances, and a flat map."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from skinware.errors import ConfigurationError
from skinware.tactile.arrays import Doubles, Flags, Whole
from skinware.tactile.neighbours import Components, neighbours_of_pairs

MOST_TAXELS = 6000
"""Every taxel is compared with every other one: this many need 290 MB."""
ENOUGH_FRAMES = 20
"""Samples with a touch after which a taxel is covered."""
_LEAST_FRAMES = 8  # frames with a touch from which a taxel counts: in fewer it may be noise


@dataclass
class StrokeSums:
    """The sums over all samples from which a topology is computed.

    Attributes:
        products: (n, n) float64, sum of the products of the loads of each pair of taxels.
        active: (n,) int64, samples in which each was touched.
        frames: number of samples in which any was touched.
    """

    products: Doubles
    active: Whole
    frames: int = 0

    @classmethod
    def empty(cls, n: int) -> Self:
        """Make the sums of n taxels before the first sample; raises ConfigurationError if there are too many."""
        if n > MOST_TAXELS:
            raise ConfigurationError(f"{n} taxels: a topology is found of at most {MOST_TAXELS} at a time")
        return cls(np.zeros((n, n)), np.zeros(n, np.int64))

    def __len__(self) -> int:
        return len(self.active)

    def add(self, load: npt.NDArray[Any]) -> None:
        """Take one sample or many: (n,) or (m, n) loads, 0 where nothing touches, NaN where it is not known."""
        loads = np.nan_to_num(np.atleast_2d(np.asarray(load, np.float64)), posinf=0.0)
        np.maximum(loads, 0, out=loads)
        loads = loads[(loads > 0).any(axis=1)]
        if not len(loads):
            return
        taxels = np.flatnonzero((loads > 0).any(axis=0))
        felt = loads[:, taxels]
        self.products[np.ix_(taxels, taxels)] += felt.T @ felt
        self.active[taxels] += (felt > 0).sum(axis=0)
        self.frames += len(loads)

    @property
    def known(self) -> Flags:
        """(n,) bool: touched in enough samples to be compared with others."""
        return self.active >= _LEAST_FRAMES

    def similarity(self) -> Doubles:
        """Return (n, n), 0 to 1: the cosine between the loads of two taxels over time; 0 if one is not known."""
        length = np.sqrt(np.diag(self.products))
        known = self.known & (length > 0)
        scale = np.where(known, 1 / np.where(known, length, 1), 0)
        similarity: Doubles = np.clip(self.products * scale[:, None] * scale, 0, 1)
        return similarity


PITCH_M = 0.0065
"""Pitch of ROBOSKIN, m."""
_LEAST_SIMILAR = 0.05  # similarity below which the tail of a bell is noise
_BESIDE = 1.6  # pitches within which taxels are neighbours: between two rings of a lattice of triangles
_TOGETHER = 0.012
"""Similarity of taxels of one piece: more even on a strip that was hardly stroked, while noise makes less."""
_NEAREST = 3  # nearest taxels that are typically a pitch away: six in a lattice of triangles, three at its edge


@dataclass(frozen=True)
class Topology:
    """The topology of n taxels.

    Attributes:
        pairs: (k, 2) int64, neighbours, the lower number first.
        distance_m: (n, n), m, straight distances of pairs that are near enough; inf of all others.
        piece: (n,) int64, the piece of skin of each, from the largest, 0; -1: touched too little.
        linked: (n,) bool, which are in the largest part of their piece that measured distances link; too little was
            felt between this part and the others of the piece to say where they are.
    """

    pairs: Whole
    distance_m: Doubles
    piece: Whole
    linked: Flags

    @property
    def n_pieces(self) -> int:
        """Number of pieces."""
        return int(self.piece.max(initial=-1)) + 1

    def geodesics_m(self, taxels: Whole) -> Doubles:
        """Return (k, k) the shortest ways between k taxels over measured distances, m; inf where there is none."""
        ways: Doubles = self.distance_m[np.ix_(taxels, taxels)].copy()
        np.fill_diagonal(ways, 0)
        return shortest_m(ways)


def topology_of(sums: StrokeSums, pitch_m: float = PITCH_M) -> Topology:
    """Compute the topology of a skin from strokes; the pitch is the distance between the nearest taxels, m."""
    similarity = sums.similarity()
    with np.errstate(divide="ignore"):
        far = np.where(similarity > _LEAST_SIMILAR, np.sqrt(-np.log(similarity)), np.inf)
    np.fill_diagonal(far, np.inf)
    nearest = np.sort(far, axis=1)[:, :_NEAREST] if len(far) > _NEAREST else far[:0]
    nearest = nearest[np.isfinite(nearest)]
    typical = float(np.median(nearest)) if len(nearest) else 0.0  # of sqrt(-ln S): a pitch away
    distance = far * (pitch_m / typical if typical > 0 else pitch_m)
    n = len(sums)
    one, other = np.nonzero(np.triu(distance <= _BESIDE * pitch_m))
    near = np.column_stack(np.nonzero(np.triu(similarity > _TOGETHER)))
    piece = np.full(n, -1, np.int64)
    rows = np.flatnonzero(sums.known)
    component, _ = Components(n, neighbours_of_pairs(near, n)).of(rows)
    _, number, size = np.unique(component, return_inverse=True, return_counts=True)
    piece[rows] = np.argsort(np.argsort(-size, kind="stable"))[number]
    measured = np.column_stack(np.nonzero(np.triu(np.isfinite(distance))))
    part, _ = Components(n, neighbours_of_pairs(measured, n)).of(rows)
    _, part, size = np.unique(part, return_inverse=True, return_counts=True)
    linked = np.zeros(n, bool)
    for which in range(int(piece.max(initial=-1)) + 1):
        own = np.flatnonzero(piece[rows] == which)
        linked[rows[own]] = part[own] == part[own][np.argmax(size[part[own]])]
    return Topology(np.column_stack([one, other]), distance, piece, linked)


def shortest_m(distance_m: Doubles) -> Doubles:
    """Return (k, k) the shortest ways over a (k, k) table of distances with a diagonal of 0; inf: there is none."""
    ways = distance_m.copy()
    for between in range(len(ways)):
        np.minimum(ways, ways[:, between, None] + ways[None, between], out=ways)
    return ways


_ROUNDS = 200
_ENOUGH = 1e-5  # share of the stress by which a round must lower it
_FAR_WEIGHT = 0.002  # weight of a way over several taxels, relative to a measured distance of the same length


def unrolled_m(topology: Topology, taxels: Whole) -> Doubles:
    """Return (k, 2) places of (k,) linked taxels of one piece on a map, m, with mean 0. It may be the mirror image.

    Classical multidimensional scaling of the ways along the skin, then majorisation of the stress, in which measured
    distances count most.
    """
    ways = topology.geodesics_m(taxels)
    if len(taxels) == 1:
        return np.zeros((1, 2))
    squares = ways**2
    rows = squares.mean(axis=0)
    value, vector = np.linalg.eigh(-0.5 * (squares - rows - rows[:, None] + squares.mean()))
    places = vector[:, ::-1][:, :2] * np.sqrt(np.maximum(value[::-1][:2], 0))
    measured = np.isfinite(topology.distance_m[np.ix_(taxels, taxels)])
    typical = float(np.median(ways[measured])) if measured.any() else 1.0
    with np.errstate(divide="ignore"):
        weight = np.where(measured, 1.0, _FAR_WEIGHT * (typical / ways) ** 2)
    np.fill_diagonal(weight, 0)
    return _majorised(places, ways, weight)


def _majorised(places: Doubles, ways: Doubles, weight: Doubles) -> Doubles:
    laplacian = np.diag(weight.sum(axis=1)) - weight
    inverse = np.linalg.pinv(laplacian, hermitian=True)
    stress = np.inf
    for _ in range(_ROUNDS):
        distance = np.linalg.norm(places[:, None] - places[None], axis=2)
        before, stress = stress, float((weight * (distance - ways) ** 2).sum())
        if stress >= (1 - _ENOUGH) * before:
            break
        pull = -weight * ways / np.where(distance > 0, distance, np.inf)
        np.fill_diagonal(pull, -pull.sum(axis=1))
        places = inverse @ (pull @ places)
    centred: Doubles = places - places.mean(axis=0)
    return centred
