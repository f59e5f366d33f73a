"""Strokes give the topology of a skin, and tell what is wrong with a geometry."""

from __future__ import annotations

import functools

import numpy as np
import pytest

from skinware.errors import ConfigurationError
from skinware.tactile.calibration.checking import Finding, check_file, check_strokes
from skinware.tactile.calibration.results import unrolled_comment
from skinware.tactile.calibration.shapes import rigid
from skinware.tactile.calibration.topology import MOST_TAXELS, StrokeSums, Topology, topology_of, unrolled_m
from skinware.tactile.testing import Surface, arm, triangles
from tests.tactile.calibrating import (
    DATA,
    PARTS,
    PITCH_M,
    geometry_of,
    judge,
    part,
    stroked,
    true_ways_m,
)

with_data = pytest.mark.skipif(not DATA.is_dir(), reason=f"the positions of an iCub are not here: {DATA}")


@functools.cache
def flat() -> tuple[Surface, StrokeSums]:
    """Two strips of triangles side by side, stroked for two minutes."""
    one = triangles(8)
    position = np.concatenate([one.position_m, one.position_m + np.array([0, 0.026, 0])])
    module = np.repeat(np.arange(16), 10)
    surface = Surface(position, np.tile([0.0, 0, 1], (160, 1)), module, module // 8)
    return surface, stroked(surface, 1, 2.0)


@pytest.mark.thorough
@with_data
@pytest.mark.parametrize("name", PARTS)
def test_the_parts_of_an_icub(name: str) -> None:
    """Three minutes of strokes; more seeds: tools/bench tactile calibration."""
    surface = part(name)
    marks = judge(surface, topology_of(stroked(surface, 1), PITCH_M), true_ways_m(surface))
    assert marks.pieces_right
    assert marks.covered >= 0.95
    assert marks.precision >= 0.95
    assert marks.recall >= 0.95
    assert marks.geodesic <= 0.07


@pytest.mark.thorough
def test_a_flat_skin_comes_out_as_it_is() -> None:
    surface, sums = flat()
    topology = topology_of(sums)
    assert topology.n_pieces == 1
    places = np.zeros((160, 3))
    places[:, :2] = unrolled_m(topology, np.arange(160))
    pose = rigid(places, surface.position_m, np.ones(160))
    off_m = np.linalg.norm(places @ pose.rotation.T + pose.origin_m - surface.position_m, axis=1)
    assert off_m.mean() < 0.003


@pytest.mark.thorough
def test_pieces_that_are_apart_are_apart() -> None:
    surface = arm((3,))  # palm and back of a hand
    topology = topology_of(stroked(surface, 2, 2.0))
    assert topology.n_pieces == 2
    covered, palm = topology.piece >= 0, surface.normal[:, 2] < 0
    assert covered.mean() > 0.95
    assert len(np.unique(topology.piece[covered & palm])) == len(np.unique(topology.piece[covered & ~palm])) == 1


def test_sums_do_not_depend_on_how_frames_come() -> None:
    random = np.random.default_rng(1)
    loads = np.maximum(random.normal(-1, 1, (60, 7)), 0)
    loads[3, 2], loads[:, 5], loads[10:20] = np.nan, 0, 0
    one, other = StrokeSums.empty(7), StrokeSums.empty(7)
    one.add(loads)
    for row in loads:
        other.add(row)
    assert np.allclose(one.products, other.products)
    assert one.active.tolist() == other.active.tolist()
    assert one.frames == other.frames
    assert one.active[5] == 0
    similarity = one.similarity()
    assert (similarity[5] == 0).all()
    assert np.array_equal(similarity, similarity.T)


def test_without_strokes_there_is_nothing() -> None:
    topology = topology_of(StrokeSums.empty(5))
    assert topology.n_pieces == 0
    assert not len(topology.pairs)
    assert topology.piece.tolist() == [-1] * 5
    with pytest.raises(ConfigurationError, match="at most"):
        StrokeSums.empty(MOST_TAXELS + 1)


def test_parts_that_were_hardly_felt_together_are_not_put_anywhere() -> None:
    """Two rows of a piece that a single weak touch joins: how far they are apart is not known."""
    sums = StrokeSums.empty(9)
    at = np.concatenate([np.arange(5), 20 + np.arange(4)])
    for middle in np.linspace(-1, 25, 400):
        sums.add(np.where(abs(at - middle) < 2, 50 * np.exp(-((at - middle) ** 2) / 2), 0))
    sums.add(np.array([0, 0, 0, 0, 35.0, 35.0, 0, 0, 0]))
    topology = topology_of(sums)
    assert topology.piece.tolist() == [0] * 9
    assert topology.linked.tolist() == [True] * 5 + [False] * 4
    assert "Not placed: 4 that were hardly felt together" in unrolled_comment(topology)
    assert np.isfinite(unrolled_m(topology, np.arange(5))).all()


def checked(surface: Surface, said: np.ndarray, topology: Topology) -> list[Finding]:
    """What is wrong if a file says these places."""
    geometry = geometry_of(Surface(said, surface.normal, surface.module, surface.patch))
    return check_strokes(geometry, surface.module, surface.patch, topology)


@pytest.mark.thorough
def test_nothing_is_found_in_a_right_geometry() -> None:
    surface, sums = flat()
    assert not checked(surface, surface.position_m, topology_of(sums))
    assert not check_file(geometry_of(surface), surface.module)


@pytest.mark.thorough
@pytest.mark.parametrize("pair", [(2, 6), (3, 4), (1, 9), (0, 15)])
def test_exchanged_connectors_are_named(pair: tuple[int, int]) -> None:
    surface, sums = flat()
    said = surface.position_m.copy()
    one, other = (surface.module == number for number in pair)
    said[one], said[other] = said[other].copy(), said[one].copy()
    (finding,) = checked(surface, said, topology_of(sums))
    assert (finding.kind, finding.modules) == ("swapped", pair)


def test_exchanged_patches_are_named() -> None:
    surface, sums = flat()
    said = np.roll(surface.position_m, 80, axis=0)
    findings = checked(surface, said, topology_of(sums))
    assert [(finding.kind, finding.patches) for finding in findings] == [("swapped", (0, 1))]


@pytest.mark.parametrize("number", [2, 5, 8, 13])
def test_a_mirrored_module_is_named(number: int) -> None:
    surface, sums = flat()
    said = surface.position_m.copy()
    own = surface.module == number
    said[own, 0] = 2 * said[own, 0].mean() - said[own, 0]
    (finding,) = checked(surface, said, topology_of(sums))
    assert (finding.kind, finding.modules) == ("mirrored", (number,))


def test_a_turned_module_is_named() -> None:
    surface, sums = flat()
    said = surface.position_m.copy()
    own = surface.module == 5
    middle, angle = said[own].mean(axis=0), np.radians(120)
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    said[own] = middle + (said[own] - middle) @ turn.T
    (finding,) = checked(surface, said, topology_of(sums))
    assert (finding.kind, finding.modules) == ("turned", (5,))
    assert abs(finding.degrees - 120) <= 15


def test_a_taxel_that_is_off_is_named() -> None:
    surface, sums = flat()
    said = surface.position_m.copy()
    said[[33, 120]] += [[0.03, 0, 0], [0, 0, 0.02]]
    findings = checked(surface, said, topology_of(sums))
    assert [(finding.kind, finding.taxels.tolist()) for finding in findings] == [("off", [33]), ("off", [120])]


def test_places_that_are_shared_or_missing_are_named() -> None:
    surface, _ = flat()
    said = surface.position_m.copy()
    said[17], said[44] = said[12], said[12]
    said[100:103] = np.nan
    findings = check_file(geometry_of(Surface(said, surface.normal, surface.module, surface.patch)), surface.module)
    assert [(f.kind, f.modules, f.taxels.tolist()) for f in findings] == [
        ("shared", (1, 4), [12, 17, 44]),
        ("unknown", (10,), [100, 101, 102]),
    ]
