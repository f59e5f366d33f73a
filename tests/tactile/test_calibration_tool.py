"""Tools that drift, lag, have play, a wrong scale or zero: it is corrected, or the places are not to be trusted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from skinware.errors import ConfigurationError
from skinware.tactile.calibration.placing import Placement, Press, Presses, place
from skinware.tactile.calibration.state import PressFinder
from skinware.tactile.calibration.tool import DRIFT, KINDS, LAG, OFFSET, PLAY, SCALE
from skinware.tactile.testing import arm
from tests.tactile.calibrating import Tool, off_m, presses, shapes, with_tool

SURFACE = arm((0,))
SHAPES = shapes(SURFACE)
IN_95_PERCENT = np.sqrt(2 * np.log(20)) / np.sqrt(2)
"""Times the root of the mean square of errors along the skin, if these are normal."""
MOVES = Tool((0.01, 0, 0), lag_s=0.2, play_m=0.004)
ALL = Tool((0.006, 0.004, -0.005), 0.0, 1.05, (0, 0.005, 0), 0.1, 0.004)


def placed(tool: Tool, seed: int, *, noise_m: float = 0.001, layout: bool, in_order: bool = False) -> Placement:
    given = with_tool(SURFACE, presses(SURFACE, seed, pose_noise_m=noise_m), seed, tool, in_order=in_order)
    return place(given, SHAPES, layout_m=SURFACE.position_m) if layout else place(given)


def held(placement: Placement) -> float:
    """The share of the taxels within their 95 % intervals."""
    known = placement.known
    return float((off_m(SURFACE, placement.position_m) <= IN_95_PERCENT * placement.error_m)[known].mean())


@pytest.mark.thorough
@pytest.mark.parametrize("tool", [Tool(), Tool((0.01, 0, 0)), MOVES], ids=["good", "drift", "all"])
@pytest.mark.parametrize("layout", [False, True])
@pytest.mark.parametrize("in_order", [False, True])
def test_what_the_presses_show_is_corrected(tool: Tool, layout: bool, in_order: bool) -> None:
    shares = []
    for seed in range(20):
        placement = placed(tool, seed, layout=layout, in_order=in_order)
        assert not placement.tool.doubts
        assert len(placement.tool.found) == (tool.drift_m[0] > 0) + (tool.lag_s > 0) + (tool.play_m > 0)
        assert set(placement.tool.unchecked) - ({DRIFT} if in_order else set()) == {SCALE, OFFSET}
        shares.append(held(placement))
    assert 0.9 <= np.mean(shares) <= 0.985, shares


@pytest.mark.thorough
@pytest.mark.parametrize("noise_m", [0.001, 0.003])
@pytest.mark.parametrize("tool", [Tool(scale=1.05), Tool(offset_m=(0.005, 0, 0)), ALL], ids=["scale", "offset", "all"])
def test_what_only_a_layout_shows_is_doubted(tool: Tool, noise_m: float) -> None:
    """Where points are poor, a scale may look like an offset."""
    n_named = 0
    for seed in range(20):
        (doubt,) = placed(tool, seed, noise_m=noise_m, layout=True).tool.doubts
        assert "layout" in doubt
        n_named += doubt.startswith("the skin is 1.0" if tool.scale > 1 else "all places are (")
        if seed < 3:
            alone = placed(tool, seed, noise_m=noise_m, layout=False).tool
            assert {alone.unchecked[SCALE], alone.unchecked[OFFSET]} == {np.inf}
    assert noise_m > 0.002 or n_named >= 18


@pytest.mark.thorough
def test_a_layout_elsewhere_shows_the_scale_alone() -> None:
    """Where it does not, it says that so much would not show: it moves the places by 2 mm."""
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    elsewhere, n_doubted = SURFACE.position_m @ turn.T + [0.3, 0, 0], 0
    for seed in range(20):
        for scale in (1.0, 1.05):
            given = with_tool(SURFACE, presses(SURFACE, seed), seed, Tool(scale=scale))
            tool = place(given, SHAPES, layout_m=elsewhere, is_here=False).tool
            assert tool.unchecked[OFFSET] == np.inf
            assert all(doubt.startswith("the skin is 1.0") for doubt in tool.doubts)
            assert scale > 1 or not tool.doubts
            assert scale == 1 or tool.doubts or tool.unchecked[SCALE] > 0.0015
            n_doubted += len(tool.doubts)
    assert n_doubted >= 18


@pytest.mark.thorough
def test_a_tool_that_jumps_is_doubted_or_followed() -> None:
    n_doubted = 0
    for seed in range(20):
        placement = placed(Tool(step_m=0.005), seed, layout=False)
        assert placement.tool.doubts or held(placement) > 0.9
        assert all(doubt.startswith("the tool moves to and fro") for doubt in placement.tool.doubts)
        n_doubted += len(placement.tool.doubts)
    assert n_doubted >= 12


def test_what_was_found_is_said() -> None:
    found = placed(MOVES, 1, layout=True).tool
    drift, lag, play = found.found
    assert drift.startswith("the tool drifts: 10.")
    assert "mm in 40 min" in drift
    assert lag.startswith("the points lag 0.2")
    assert play.startswith("the points differ by 4.")
    *lines, unseen = found.words()
    assert lines == [f"corrected: {one}" for one in found.found]
    assert unseen.startswith("would not show: ")


def test_presses_without_times_show_nothing() -> None:
    placement = place(presses(SURFACE, 1))
    assert placement.tool.unchecked == dict.fromkeys(KINDS, np.inf)
    assert placement.tool.words() == ["would not show: " + ", ".join(f"{kind} of any size" for kind in KINDS)]
    with pytest.raises(ConfigurationError, match=r"motion of 0 presses"):
        replace(Presses.none(3), motion=np.zeros((4, 7)))


def test_from_one_direction_no_play_shows() -> None:
    given = with_tool(SURFACE, presses(SURFACE, 1), 1, MOVES)
    motion = given.motion.copy()
    motion[:, 4:] = [0, 0, -1]
    tool = place(replace(given, motion=motion)).tool
    assert {DRIFT, LAG} & set(tool.unchecked) == set()
    assert tool.unchecked[PLAY] > 0.001


def test_a_press_knows_from_where_it_came() -> None:
    finder = PressFinder()
    found: list[Press] = []
    steady, nothing = np.array([0.0, 30.0, 5.0]), np.zeros(3)

    def take(number: int, load: np.ndarray, x_m: float) -> Sequence[Press]:
        press = finder.update(number * 20_000_000, load, np.array([x_m, 0.2, 0.3]))
        return [] if press is None else [press]

    for number in range(40):
        found += take(number, nothing, 0.1 - 0.001 * number)
    for number in range(40, 60):
        found += take(number, steady, 0.061)
    (press,) = found
    assert press.motion.tolist() == [1.0, 0, 0, 0, -1, 0, 0]
    finder.update(0, nothing, None)
    (unknown,) = [press for number in range(60, 72) for press in take(number, steady, 0.061)]
    assert np.isnan(unknown.motion).tolist() == [False] * 4 + [True] * 3
