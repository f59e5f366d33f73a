"""Which taxels lie between which."""

from __future__ import annotations

import itertools

import numpy as np

from skinware.geometry import Geometry
from skinware.tactile.health_evidence import Pairs
from skinware.tactile.neighbours import neighbours
from tests.tactile.skins import PITCH_M, placed, triangles


def pairs_of(geometry: Geometry) -> Pairs:
    return Pairs(geometry, neighbours(geometry))


def reference(position_m: np.ndarray[tuple[int, int], np.dtype[np.float64]]) -> set[tuple[int, int, int]]:
    """(middle, one, other) for all nearest neighbours that lie just opposite each other."""
    found = set()
    for middle in range(len(position_m)):
        away = np.linalg.norm(position_m - position_m[middle], axis=1)
        near = np.flatnonzero((away > 0) & (away < 1.1 * PITCH_M))
        for one, other in itertools.combinations(near.tolist(), 2):
            if np.allclose(position_m[one] + position_m[other], 2 * position_m[middle]):
                found.add((middle, one, other))
    return found


def found_by(pairs: Pairs, touched: np.ndarray[tuple[int], np.dtype[np.bool_]]) -> set[tuple[int, int, int]]:
    around = pairs.around(np.flatnonzero(touched), touched)
    return {(m, min(a, b), max(a, b)) for m, a, b in zip(*(part.tolist() for part in around), strict=True)}


def test_all_pairs_of_a_lattice_are_found_once() -> None:
    position = triangles(7, 9)
    pairs, everything = pairs_of(placed(position)), np.ones(len(position), bool)
    wanted = reference(position)
    assert found_by(pairs, everything) == wanted
    assert len(pairs.around(np.flatnonzero(everything), everything)[0]) == len(wanted)


def test_both_sides_must_be_touched() -> None:
    position = triangles(7, 9)
    pairs, wanted = pairs_of(placed(position)), reference(position)
    random = np.random.default_rng(1)
    for _ in range(20):
        touched = random.random(len(position)) < 0.4
        assert found_by(pairs, touched) == {three for three in wanted if touched[three[1]] and touched[three[2]]}


def test_who_has_no_place_lies_between_none() -> None:
    position = triangles(7, 9)
    position[20:30] = np.nan
    pairs = pairs_of(placed(position))
    everything = np.ones(len(position), bool)
    assert found_by(pairs, everything) == reference(position)
    for nowhere in (np.full((5, 3), np.nan), np.zeros((0, 3))):
        assert not found_by(pairs_of(placed(nowhere)), np.ones(len(nowhere), bool))
