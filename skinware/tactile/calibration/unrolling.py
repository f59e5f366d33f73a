"""A flat map of a piece of skin from distances along it: curved skins come out unrolled, as a peel does."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from skinware.tactile.calibration.topology import Topology

ArrayF = npt.NDArray[np.float64]
ArrayI = npt.NDArray[np.int64]

_ROUNDS = 200
_ENOUGH = 1e-5
"""Of the stress, by which a round must still lower it."""
_FAR_WEIGHT = 0.002
"""Of a way over several taxels, beside that of a measured distance of the same length."""


def unrolled_m(topology: Topology, taxels: ArrayI) -> ArrayF:
    """(k, 2) places of k taxels of one piece on a map, m, with their mean at 0. It may be the mirror image.

    Classical multidimensional scaling of the ways along the skin, then majorisation of the stress, in which measured
    distances count most.

    Args:
        topology: with their distances.
        taxels: (k,) of one piece.
    """
    ways = topology.geodesics_m(taxels)
    if len(taxels) == 1:
        return np.zeros((1, 2))
    ways[~np.isfinite(ways)] = ways[np.isfinite(ways)].max()
    places = _scaled(ways)
    measured = np.isfinite(topology.distance_m[np.ix_(taxels, taxels)])
    typical = float(np.median(ways[measured])) if measured.any() else 1.0
    with np.errstate(divide="ignore"):
        weight = np.where(measured, 1.0, _FAR_WEIGHT * (typical / ways) ** 2)
    np.fill_diagonal(weight, 0)
    return _majorised(places, ways, weight)


def _scaled(ways: ArrayF) -> ArrayF:
    """(k, 2) classical scaling: the two strongest directions of the table of squared distances."""
    squares = ways**2
    rows = squares.mean(axis=0)
    value, vector = np.linalg.eigh(-0.5 * (squares - rows - rows[:, None] + squares.mean()))
    strongest = vector[:, ::-1][:, :2] * np.sqrt(np.maximum(value[::-1][:2], 0))
    places = np.zeros((len(ways), 2))
    places[:, : strongest.shape[1]] = strongest
    return places


def _majorised(places: ArrayF, ways: ArrayF, weight: ArrayF) -> ArrayF:
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
    centred: ArrayF = places - places.mean(axis=0)
    return centred
