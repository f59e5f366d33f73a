"""Who lies beside whom: against all pairs, and at the odd places that files have."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skinware.errors import ConfigurationError
from skinware.geometry import Geometry
from skinware.tactile.neighbours import NONE, area_m2, checked, neighbours, neighbours_of_pairs, pitch_m, posed
from tests.tactile.skins import PITCH_M, placed, triangles


def as_sets(table: npt.NDArray[np.int32]) -> list[set[int]]:
    return [set(row[row != NONE].tolist()) for row in table]


def all_pairs(geometry: Geometry, radius_m: float) -> list[set[int]]:
    """The same by looking at every pair."""
    position, normal, frame = geometry.position_m, geometry.normal, geometry.frame
    found: list[set[int]] = [set() for _ in range(len(geometry))]
    for i in range(len(geometry)):
        for j in range(len(geometry)):
            near = ((position[i] / radius_m - position[j] / radius_m) ** 2).sum() <= 1
            if i != j and near and frame[i] == frame[j] and not normal[i] @ normal[j] < -0.2:
                found[i].add(j)
    return found


coordinate = st.one_of(st.integers(-3, 3).map(float), st.floats(-3, 3), st.just(np.nan))
normals = st.sampled_from([(0.0, 0.0, 1.0), (0.0, 0.0, -1.0), (1.0, 0.0, 0.0), (np.nan, np.nan, np.nan)])
taxel = st.tuples(st.tuples(coordinate, coordinate, coordinate), st.sampled_from("ab"), normals)


@pytest.mark.thorough
@given(st.lists(taxel, min_size=1, max_size=25), st.floats(0.2, 4.0))
def test_as_by_looking_at_every_pair(
    taxels: list[tuple[tuple[float, ...], str, tuple[float, ...]]], radius: float
) -> None:
    positions = [(np.nan,) * 3 if np.isnan(position).any() else position for position, _, _ in taxels]
    geometry = placed(positions, [frame for _, frame, _ in taxels], [normal for _, _, normal in taxels])
    table = neighbours(geometry, radius)
    assert table.dtype == np.int32
    assert as_sets(table) == all_pairs(geometry, radius)
    for row in table:
        known = row[row != NONE]
        assert (np.diff(known) > 0).all()
        assert (row[len(known) :] == NONE).all()


@given(st.integers(1, 12), st.data())
def test_pairs_may_come_in_any_order_and_often(n: int, data: st.DataObject) -> None:
    number = st.integers(0, n - 1)
    pairs = data.draw(st.lists(st.tuples(number, number), max_size=30))
    expected = [{j for j in range(n) if i != j and ((i, j) in pairs or (j, i) in pairs)} for i in range(n)]
    table = neighbours_of_pairs(pairs, n)
    assert as_sets(table) == expected
    assert np.array_equal(checked(table, n), table)


def test_two_rings_of_a_lattice_are_neighbours() -> None:
    table = neighbours(placed(triangles(9, 9)))
    assert len(as_sets(table)[4 * 9 + 4]) == 12
    assert table.shape == (81, 12)


def test_every_frame_has_its_own_pitch() -> None:
    coarse, fine = triangles(6, 6), triangles(6, 6, PITCH_M / 5)
    geometry = placed(np.vstack([coarse, fine]), ["arm"] * 36 + ["finger"] * 36)
    assert np.allclose(pitch_m(geometry), [PITCH_M] * 36 + [PITCH_M / 5] * 36)
    table = neighbours(geometry)
    assert np.array_equal(np.sort(table[:36], axis=1), np.sort(neighbours(placed(coarse)), axis=1))
    assert [{i - 36 for i in row} for row in as_sets(table[36:])] == as_sets(table[:36])


def test_the_two_sides_of_a_thin_part_are_apart() -> None:
    side = triangles(6, 6)
    both = np.vstack([side, side - [0, 0, 0.002]])
    geometry = placed(both, normal=[[0, 0, 1]] * 36 + [[0, 0, -1]] * 36)
    assert as_sets(neighbours(geometry)[:36]) == as_sets(neighbours(placed(side)))
    assert np.allclose(area_m2(geometry), area_m2(placed(side))[0])
    assert all(max(row) >= 36 for row in as_sets(neighbours(placed(both), 0.01)[:36]))


def test_taxels_at_one_place_are_neighbours_and_do_not_shrink_the_pitch() -> None:
    lattice = triangles(5, 5)
    geometry = placed(np.repeat(lattice, 3, axis=0))
    assert np.allclose(pitch_m(geometry), PITCH_M)
    assert as_sets(neighbours(geometry))[0] >= {1, 2}
    assert np.allclose(area_m2(geometry), area_m2(placed(lattice))[0] / 3)


def test_a_place_that_very_many_share_is_none() -> None:
    lattice = triangles(5, 5)
    table = neighbours(placed(np.vstack([lattice, [[0.01, 0.01, 0.0]] * 1000])))
    assert as_sets(table[:25]) == as_sets(neighbours(placed(lattice)))
    assert (table[25:] == NONE).all()


@pytest.mark.parametrize(
    "positions", [[], [[np.nan] * 3], [[0, 0, 0]], [[0, 0, 0], [np.nan] * 3]], ids=["none", "nowhere", "one", "half"]
)
def test_tiny_skins_have_no_neighbours(positions: list[list[float]]) -> None:
    geometry = placed(positions)
    assert neighbours(geometry).shape == (len(positions), 0)
    assert neighbours_of_pairs([], len(positions)).shape == (len(positions), 0)
    assert np.isnan(pitch_m(geometry)).all()
    assert np.isnan(area_m2(geometry)).all()


def test_the_only_two_taxels_of_a_frame() -> None:
    assert neighbours(placed([[0, 0, 0], [0, 0, 0]])).tolist() == [[1], [0]]
    assert neighbours(placed([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0]])).tolist() == [[1], [0]]


def test_a_taxel_stands_for_a_cell_of_its_lattice() -> None:
    assert np.allclose(area_m2(placed(triangles(8, 8))), PITCH_M**2 * np.sqrt(0.75))
    x, y = np.meshgrid(np.arange(6), np.arange(4))
    squares = np.column_stack([x.ravel(), y.ravel(), 0 * x.ravel()]) * 0.002
    assert np.allclose(area_m2(placed(squares)), 0.002**2)


@pytest.mark.parametrize("radius_m", [0.0, -1.0, np.nan, np.inf])
def test_a_radius_that_is_none(radius_m: float) -> None:
    with pytest.raises(ConfigurationError, match="give a radius above 0"):
        neighbours(placed(triangles(3, 3)), radius_m)


def test_a_radius_over_the_whole_skin_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="give a smaller radius"):
        neighbours(placed(triangles(100, 100)), 10.0)


def test_a_place_in_other_units_is_told() -> None:
    with pytest.raises(ConfigurationError, match="not in metres"):
        neighbours(placed([[0.0, 0.0, 0.0], [0.001, 0.0, 0.0], [1e15, 1e15, 1e15]]), 0.01)


@pytest.mark.parametrize("pairs", [[[0, 3]], [[-1, 0]], [[0.0, 1.0]], [0, 1], [[0, 1, 2]]])
def test_pairs_that_are_none(pairs: list[object]) -> None:
    with pytest.raises(ConfigurationError, match="of neighbours"):
        neighbours_of_pairs(pairs, 3)  # type: ignore[arg-type]


def test_a_table_is_made_symmetric_or_refused() -> None:
    assert as_sets(checked(np.array([[1, -1], [-1, -1], [0, 2]]), 3)) == [{1, 2}, {0}, {0}]
    with pytest.raises(ConfigurationError, match=r"give \(4, k\) integers"):
        checked(np.zeros((3, 2), np.int32), 4)
    with pytest.raises(ConfigurationError, match="only 2 taxels"):
        checked(np.array([[7], [-1]]), 2)


def test_taxels_across_the_border_of_posed_frames_are_neighbours() -> None:
    side = np.where(np.arange(32) % 8 < 4, "left", "right")
    here = placed(triangles(4, 8), side, normal=[0, 0, 1])
    turn = np.array([[0, -1, 0, 0.5], [1, 0, 0, 0], [0, 0, 1, 0.2], [0, 0, 0, 1.0]])
    rows = here.frame == "right"
    apart = placed(here.position_m, here.frame, here.normal)
    apart.position_m[rows] = (apart.position_m[rows] - turn[:3, 3]) @ turn[:3, :3]
    together = posed(apart, {"left": np.eye(4), "right": turn})
    assert np.allclose(together.position_m, here.position_m)
    assert set(together.frame) == {"common"}
    assert as_sets(neighbours(together)) == as_sets(neighbours(placed(here.position_m)))
    with pytest.raises(ConfigurationError, match="pose of frame 'left'"):
        posed(apart, {"left": np.eye(3)})
