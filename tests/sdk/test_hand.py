"""Nominal places of taxels on a hand."""

from __future__ import annotations

import numpy as np
import pytest

from skinware.geometry import Geometry
from skinware.nominal_hand import FINGERS, PARTS
from skinware_drivers.hand import Grid, Hand, Place


def test_a_grid_lies_as_a_person_sees_it() -> None:
    places = Grid(2, 3, pitch_m=0.01).at(Place("here", (1.0, 2.0, 3.0)), ["pressure"], range(10, 16))
    assert places.uid.tolist() == list(range(10, 16))
    assert places.known.all()
    assert np.allclose(places.position_m[0], [0.99, 2.005, 3.0])  # the upper left one
    assert np.allclose(places.position_m[2], [1.01, 2.005, 3.0])
    assert np.allclose(places.position_m[5], [1.01, 1.995, 3.0])
    assert (places.normal == [0, 0, 1]).all()
    assert set(places.frame) == {"here"}


def test_all_axes_of_a_taxel_are_at_its_place() -> None:
    places = Grid(1, 2).at(Place("here"), ["force_x", "force_y", "force_z"], [7, 9])
    of_z = places.at(["force_z"], np.array([9], np.uint64))
    of_x = places.at(["force_x"], np.array([9], np.uint64))
    assert len(places) == 6
    assert (of_z.position_m == of_x.position_m).all()
    assert of_z.known.all()


def test_the_last_taxels_of_a_grid_may_be_missing_and_none_are_too_many() -> None:
    assert len(Grid(2, 3).at(Place("here"), ["pressure"], range(5))) == 5
    with pytest.raises(ValueError, match="7 taxels have no place in a grid of 2 x 3"):
        Grid(2, 3).at(Place("here"), ["pressure"], range(7))


def test_grids_of_a_finger_follow_each_other_and_no_two_taxels_are_at_one_place() -> None:
    grids = [Grid(3, 3), Grid(12, 8), Grid(10, 8)]
    hand, parts = Hand(), []
    for first, part in enumerate((*FINGERS, "palm")):
        uid = 1000 * first
        for grid, centre in zip(grids, hand.down(part, grids), strict=True):
            n = grid.rows * grid.columns
            parts.append(grid.at(centre, ["pressure"], range(uid, uid + n)))
            uid += n
    places = Geometry.joined(parts).position_m
    apart = np.linalg.norm(places[:, None] - places[None], axis=2)
    np.fill_diagonal(apart, np.inf)
    assert apart.min() > 0.0019
    index_tip, index_pad = parts[3].position_m, parts[5].position_m
    assert index_tip[:, 1].min() > index_pad[:, 1].max()


def test_the_thumb_of_a_right_hand_is_right_and_a_left_hand_is_mirrored() -> None:
    right, left = (Hand(side).down("thumb", [Grid(1, 1)])[0] for side in ("right", "left"))
    assert right.centre_m[0] > Hand("right").down("index", [Grid(1, 1)])[0].centre_m[0] > 0
    assert (left.centre_m[0], left.centre_m[1]) == (-right.centre_m[0], right.centre_m[1])
    assert (right.frame, left.frame) == ("right_hand_nominal", "left_hand_nominal")
    assert left.turned_rad == -right.turned_rad > 0  # its tip points away from the fingers


def test_a_part_that_no_hand_has_is_refused() -> None:
    with pytest.raises(ValueError, match="no part 'toe'; it has thumb, index, middle, ring, little, palm"):
        Hand().down("toe", [Grid(1, 1)])


def test_a_claw_has_two_fingers_opposite_to_a_thumb() -> None:
    claw = Hand("left", "claw")
    assert tuple(claw.parts) == ("thumb", "index", "middle", "palm")
    assert Hand.in_frame("left_claw_nominal 2") == claw
    centres = np.array([claw.place(part, 0.02).centre_m for part in claw.parts])
    assert [PARTS[part] for part in claw.parts_at(centres)] == list(claw.parts)
    thumb, index, middle, _ = centres
    assert index[0] < thumb[0] < middle[0]
    assert thumb[1] < index[1] == middle[1]
    with pytest.raises(ValueError, match="a claw has no part 'ring'; it has thumb, index, middle, palm"):
        claw.place("ring", 0.01)
