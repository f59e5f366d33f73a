"""Presses are found in frames; places come from presses, with and without the shapes of modules."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from skinware.errors import ConfigurationError
from skinware.tactile.calibration.placing import Press, Presses, place
from skinware.tactile.calibration.results import confidence_of
from skinware.tactile.calibration.shapes import shapes_of
from skinware.tactile.calibration.state import PressFinder
from skinware.tactile.testing import Surface, arm, triangles
from tests.tactile import calibrating
from tests.tactile.calibrating import DATA, PARTS, PITCH_M, off_m, part, presses, shapes

PERIOD_NS = 20_000_000
HERE = np.array([0.1, 0.2, 0.3])
STEADY = np.array([0.0, 30.0, 5.0])
with_data = pytest.mark.skipif(not DATA.is_dir(), reason=f"the positions of an iCub are not here: {DATA}")


def found(frames: Sequence[tuple[np.ndarray, np.ndarray | None]]) -> list[tuple[int, Press]]:
    """The presses in frames of (load, pose) at 50 Hz, with the number of the frame."""
    finder = PressFinder()
    all_found = [(number, finder.update(number * PERIOD_NS, *frame)) for number, frame in enumerate(frames)]
    return [(number, press) for number, press in all_found if press is not None]


def test_a_touch_that_rests_is_one_press() -> None:
    nothing = (np.zeros(3), HERE)
    once = found([nothing] * 3 + [(STEADY, HERE)] * 40 + [nothing])
    ((number, press),) = once
    assert number == 3 + 10  # 0.2 s
    assert press.taxel.tolist() == [1, 2]
    assert press.load.tolist() == [30, 5]
    assert np.allclose(press.pose, HERE)
    again = found(([(STEADY, HERE)] * 15 + [nothing]) * 3)
    assert len(again) == 3


def test_what_does_not_rest_is_none() -> None:
    moving = [(STEADY, HERE + np.array([0.0005 * number, 0, 0])) for number in range(40)]
    rising = [(STEADY * 1.1**number, HERE) for number in range(40)]
    tapping = ([(STEADY, HERE)] * 9 + [(np.zeros(3), HERE)]) * 5
    lost = [(STEADY, None), (STEADY, np.full(3, np.nan))] * 20
    unknown = [(np.full(3, np.nan), HERE)] * 40
    for frames in (moving, rising, tapping, lost, unknown):
        assert not found(frames)


def test_a_finger_that_stays_down_presses_where_it_rests_again() -> None:
    there = HERE + np.array([0.01, 0, 0])
    slide = [(STEADY, HERE + np.array([0.001 * step, 0, 0])) for step in range(10)]
    (_, first), (_, second) = found([(STEADY, HERE)] * 20 + slide + [(STEADY, there)] * 20)
    assert np.allclose(first.pose, HERE)
    assert np.allclose(second.pose, there, atol=0.001)


def test_poses_of_a_carrier_are_taken_as_they_are() -> None:
    carrier = np.eye(4)
    carrier[:3, 3] = HERE
    ((_, press),) = found([(STEADY, carrier)] * 20)
    assert np.array_equal(press.pose, carrier)


def test_presses_that_make_no_sense_are_refused() -> None:
    whole = np.array([0])
    for pose, press, taxel, load in (
        (np.zeros((1, 2)), whole, whole, np.ones(1)),
        (np.zeros((1, 3)), whole, whole + 3, np.ones(1)),
        (np.zeros((1, 3)), whole + 1, whole, np.ones(1)),
        (np.zeros((1, 3)), whole, whole, np.zeros(1)),
        (np.full((1, 3), np.nan), whole, whole, np.ones(1)),
        (np.zeros((1, 3)), whole, whole, np.ones(2)),
    ):
        with pytest.raises(ConfigurationError):
            Presses(3, pose, press, taxel, load)


def test_a_taxel_has_been_pressed_if_it_felt_half_of_the_most() -> None:
    given = Presses.of_arrays(np.zeros((3, 3)), np.array([[10, 5, 4], [0, 3, 1], [0, 0, np.nan]]))
    assert given.times_pressed.tolist() == [1, 2, 0]


def test_nothing_is_known_of_what_nobody_pressed() -> None:
    surface = triangles(4)
    given = presses(surface, 1)
    kept = given.taxel < 20  # of two modules
    some = Presses(len(surface), given.pose, given.press[kept], given.taxel[kept], given.load[kept])
    placement = place(some)
    assert placement.known.tolist() == [True] * 20 + [False] * 20
    assert np.isnan(placement.error_m[20:]).all()
    assert not np.isfinite(placement.normal).any()
    bound = place(some, shapes(surface))
    assert bound.known.tolist() == placement.known.tolist()
    none = place(Presses.none(7))
    assert not none.known.any()
    assert np.isnan(none.spread_m)


def test_a_rigid_module_is_placed_whole_and_faces_outwards() -> None:
    surface = arm((0, 1))
    given = presses(surface, 1)
    kept = given.taxel % 10 < 6  # the other four of each module are dead
    some = Presses(len(surface), given.pose, given.press[kept], given.taxel[kept], given.load[kept])
    placement = place(some, shapes(surface))
    assert placement.known.all()
    assert off_m(surface, placement.position_m).max() < 0.004
    assert (placement.normal * surface.normal).sum(axis=1).min() > 0.9


def test_modules_of_one_kind_lend_each_other_their_shape() -> None:
    surface = triangles(4)
    position = surface.position_m.copy()
    position[10:] = np.nan
    lent = shapes_of(surface.module, ["triangle"] * 4, position, surface.normal)
    assert sorted(lent) == [0, 1, 2, 3]
    placement = place(presses(surface, 1, each=20), lent)
    assert off_m(surface, placement.position_m).max() < 0.002
    assert sorted(shapes_of(surface.module, [""] * 4, position, surface.normal)) == [0]
    line = np.arange(30.0).reshape(10, 3)
    assert not shapes_of(np.zeros(10, int), ["x"], line, np.full((10, 3), np.nan))


def test_the_probe_and_the_cover_are_between_point_and_taxel() -> None:
    surface = triangles(6)
    given = presses(surface, 1, each=20)
    raised = Presses(given.n, given.pose + np.array([0, 0, 0.01]), given.press, given.taxel, given.load)
    placement = place(raised, shapes(surface), offset_m=0.01)
    assert off_m(surface, placement.position_m).mean() < 0.001
    with pytest.raises(ConfigurationError, match="layout"):
        place(raised, offset_m=0.01)


@pytest.mark.parametrize("wrong", [0.0, 0.1])
def test_wrong_presses_are_named(wrong: float) -> None:
    surface = arm((0, 1, 2))
    placement = place(presses(surface, 3, wrong=wrong))
    share = placement.wrong.mean()
    assert 0.8 * wrong - 0.001 <= share <= wrong + 0.03


@pytest.mark.thorough
def test_confidence_is_what_it_says() -> None:
    """The part of the taxels that is within half a pitch, as estimated and as it is."""
    surface = arm((0, 1, 2))
    for noise_m, each in ((0.001, 5), (0.005, 5), (0.005, 2)):
        for layout in (None, shapes(surface)):
            placement = place(presses(surface, 5, pose_noise_m=noise_m, each=each), layout)
            known = placement.known
            within = (off_m(surface, placement.position_m)[known] < PITCH_M / 2).mean()
            assert abs(confidence_of(placement.error_m[known], PITCH_M) - within) < 0.12


@pytest.mark.thorough
@with_data
@pytest.mark.parametrize("name", PARTS)
@pytest.mark.parametrize("seed", range(2))
def test_the_parts_of_an_icub(name: str, seed: int) -> None:
    """Five touches a taxel; more seeds: tools/bench tactile calibration."""
    surface = part(name)
    layout = shapes(surface)
    for noise_m, alone_m, bound_m in ((0.001, 0.0016, 0.0009), (0.005, 0.0028, 0.0021)):
        given = presses(surface, seed, pose_noise_m=noise_m)
        spoilt = presses(surface, seed, pose_noise_m=noise_m, wrong=0.1)
        for limit_m, shape in ((alone_m, None), (bound_m, layout)):
            error_m = np.nanmean(off_m(surface, place(given, shape).position_m))
            assert error_m <= limit_m
            assert np.nanmean(off_m(surface, place(spoilt, shape).position_m)) <= 1.2 * error_m


def test_the_parts_are_those_that_are_meant() -> None:
    if not DATA.is_dir():
        pytest.skip("the positions of an iCub are not here")
    assert {name: len(part(name)) for name in PARTS} == {"torso": 373, "forearm": 148, "foot": 250}
    assert isinstance(part("foot"), Surface)
    assert calibrating.DATA == DATA
