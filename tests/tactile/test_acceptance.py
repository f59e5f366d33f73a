"""Baselines in the world in which rules are compared: 25 minutes of drift, presses, strokes, covers and sags."""

from __future__ import annotations

import numpy as np
import pytest

from tests.tactile.judging import Marks, Ours, Worlds, judge, peers

FALSE = {"slow": 0.001, "fast": 0.005}
SEEDS = 20
END_S = 1130.0
"""When all that people do was done, but for strokes; ``tools/bench tactile`` goes on to the end."""

pytestmark = pytest.mark.timeout(400)  # a busy machine takes three times as long as an idle one


def check(marks: Marks, drift: str, *, to_the_end: bool = True) -> None:
    """Every line that a baseline has to reach, in every world."""
    assert marks.false.max() < FALSE[drift]
    assert marks.taps.min() == 1
    assert marks.hold_on.min() >= 0.99
    assert np.abs(marks.hold_value - 1).max() <= 0.15
    assert marks.off_s.max() <= 2
    assert marks.slow.min() >= 0.95
    assert marks.covered_s.max() <= 2
    assert marks.sag_s.max() <= 1
    if to_the_end:
        assert marks.weak.min() >= 0.99


def fails(marks: Marks, drift: str) -> set[str]:
    """The lines that a rule does not reach in the typical world."""
    reached = {
        "false": np.median(marks.false) < FALSE[drift],
        "taps": np.median(marks.taps) == 1,
        "hold_on": np.median(marks.hold_on) >= 0.99,
        "hold_value": np.median(np.abs(marks.hold_value - 1)) <= 0.15,
        "off": np.median(marks.off_s) <= 2,
        "slow": np.median(marks.slow) >= 0.95,
        "covered": np.median(marks.covered_s) <= 2,
        "sag": np.median(marks.sag_s) <= 1,
    }
    return {name for name, is_reached in reached.items() if not is_reached}


@pytest.mark.thorough
def test_baselines_hold_in_every_world_where_the_rules_of_others_do_not() -> None:
    worlds = Worlds(20, SEEDS)
    found = judge({"ours": Ours(worlds), **peers(20)}, worlds, END_S)
    for drift in worlds.drifts:
        check(found["ours", drift], drift)
        for name in peers(20):
            assert fails(found[name, drift], drift), f"{name} does all that we do: {drift}"
    for drift in worlds.drifts:  # what each of them is known for
        assert {"false", "off"} <= fails(found["tare once", drift], drift)
        assert "off" in fails(found["iCub, code", drift], drift)
        assert {"hold_on", "slow"} <= fails(found["iCub, shipped", drift], drift)
        assert "slow" in fails(found["CapSense", drift], drift)
        assert {"hold_on", "slow"} <= fails(found["QTouch", drift], drift)


@pytest.mark.thorough
@pytest.mark.parametrize(("rate_hz", "count"), [(50, 5), (100, 2)])
def test_the_rate_makes_no_difference(rate_hz: float, count: int) -> None:
    """The same at other rates, up to the end of the long hold and 30 s more; ``tools/bench tactile`` has all of it."""
    worlds = Worlds(rate_hz, count, seed=2)
    found = judge({"ours": Ours(worlds)}, worlds, 750)
    for drift in worlds.drifts:
        check(found["ours", drift], drift, to_the_end=False)
