"""A robot that touches itself finds its modules and the length of its finger, from poses of its hand."""

from __future__ import annotations

import numpy as np
import pytest

from skinware.errors import ConfigurationError
from skinware.tactile.calibration.finger import place_finger
from skinware.tactile.calibration.placing import Presses
from skinware.tactile.calibration.shapes import shapes_of
from skinware.tactile.testing import arm
from tests.tactile.calibrating import off_m, presses, shapes

TIP_M = np.array([0.01, -0.02, 0.11])


def with_hand(given: Presses, seed: int) -> Presses:
    """The same presses, told by poses of a hand whose tip was at their points."""
    random = np.random.default_rng([seed, 9])
    pose = np.tile(np.eye(4), (len(given), 1, 1))
    turns = np.linalg.qr(random.standard_normal((len(given), 3, 3)))[0]
    turns[np.linalg.det(turns) < 0] *= -1
    pose[:, :3, :3] = turns
    pose[:, :3, 3] = given.pose - turns @ TIP_M
    return Presses(given.n, pose, given.press, given.taxel, given.load)


@pytest.mark.thorough
@pytest.mark.parametrize("wrong", [0.0, 0.1])
def test_tip_and_modules_are_found(wrong: float) -> None:
    surface = arm((0, 1))
    given = with_hand(presses(surface, 1, each=2, pose_noise_m=0.003, wrong=wrong), 1)
    found = place_finger(given, shapes(surface), TIP_M + np.array([0.01, 0.01, -0.01]))
    assert np.linalg.norm(found.tip_m - TIP_M) < 0.001
    assert found.known.all()
    assert off_m(surface, found.position_m).mean() < 0.003
    assert (found.normal * surface.normal).sum(axis=1).mean() > 0.9
    if wrong:
        assert 0.05 < found.wrong.mean() < 0.15
    else:
        assert found.wrong.mean() < 0.02


def test_modules_without_a_shape_are_left_out() -> None:
    surface = arm((0,))
    position = surface.position_m.copy()
    position[:20] = np.nan
    known = shapes_of(surface.module, [""] * 16, position, surface.normal)
    found = place_finger(with_hand(presses(surface, 2), 2), known, TIP_M)
    assert found.known.tolist() == [False] * 20 + [True] * 140
    assert off_m(surface, found.position_m)[20:].mean() < 0.002


def test_a_round_tip_is_above_the_skin() -> None:
    surface = arm((0,))
    given = with_hand(presses(surface, 2), 2)
    at_tip, below = (place_finger(given, shapes(surface), TIP_M, offset_m=offset_m) for offset_m in (0.0, 0.01))
    assert np.allclose(below.position_m, at_tip.position_m - 0.01 * at_tip.normal)


def test_what_cannot_be_solved_is_refused() -> None:
    surface = arm((0,))
    given = presses(surface, 1)
    whole = with_hand(given, 1)
    few = Presses(given.n, whole.pose[:3], given.press[:0], given.taxel[:0], given.load[:0])
    for bad, known, why in (
        (given, shapes(surface), "points"),
        (whole, {}, "no module"),
        (few, shapes(surface), "at least"),
    ):
        with pytest.raises(ConfigurationError, match=why):
            place_finger(bad, known)
