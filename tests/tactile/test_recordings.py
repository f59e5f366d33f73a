"""Real iCub fingertips: 50 recorded trials of a hand that grasps things, with the settings that everybody gets.

The trials have 4 to 21 frames, too few to measure the rest: each begins with ``tare``. Nobody says how fast they were
recorded; 10 Hz is taken. In the five trials with the bear no finger joint moves by more than 1 degree and no taxel by
more than 3 counts: there is no grasp in them to be found, and so none may be.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from skinware.realtime import NS_PER_S
from skinware.tactile.baseline import Baseline

TRIALS = Path(__file__).resolve().parents[3] / "shared" / "data" / "icub_grasp" / "trials"
FINGERS, TAXELS = 5, 12
PERIOD_NS = 100_000_000
GRASPS, NOT_CLOSED, NOTHING = 40, 5, 5
IDLE = (3, 4)
"""Ring and little finger: the hand grasps with the other three."""

pytestmark = pytest.mark.skipif(not TRIALS.is_dir(), reason=f"no recordings at {TRIALS}")


def frames_of(trial: Path) -> npt.NDArray[np.float32]:
    """(m, 60) counts, more = more pressure."""
    rows = [[float(text) for text in line.split()] for line in trial.read_text().splitlines()]
    taxels = [row for row in rows if len(row) == TAXELS]
    return 255 - np.array(taxels, np.float32).reshape(-1, FINGERS * TAXELS)


def touched_fingers(trial: Path) -> npt.NDArray[np.int64]:
    """(5,) in how many frames each finger was touched."""
    finger = np.repeat(np.arange(FINGERS), TAXELS)
    baseline = Baseline(finger, np.zeros_like(finger))
    count = np.zeros(FINGERS, np.int64)
    for number, frame in enumerate(frames_of(trial)):
        calm = baseline.update((number + 1) * PERIOD_NS, frame)
        if number == 0:
            baseline.tare()
        count += calm.touched.reshape(FINGERS, TAXELS).any(axis=1)
    return count


def trials(*beginnings: str) -> list[Path]:
    return [path for path in sorted(TRIALS.iterdir()) if path.stem.startswith(beginnings)]


def test_every_grasp_is_found_and_no_idle_finger_touches_anything() -> None:
    found = {path.stem: touched_fingers(path) for path in trials("")}
    assert len(found) == GRASPS + NOT_CLOSED + NOTHING
    false = {name: count for name, count in found.items() if count[list(IDLE)].any()}
    assert not false
    grasped = {name for name, count in found.items() if count.any()}
    missed = {path.stem for path in trials("")} - grasped
    assert missed == {path.stem for path in trials("blue_bear", "none")}


@pytest.mark.parametrize("name", ["empty_coke", "full_vitamin_water", "med_coke", "med_vitamin_water"])
def test_a_firm_grasp_is_seen_to_its_end(name: str) -> None:
    for trial in trials(name):
        count = touched_fingers(trial)
        assert count.max() >= len(frames_of(trial)) - 3, trial.stem


@pytest.mark.parametrize("rate_hz", [5, 10, 20, 50])
def test_trials_in_one_go_leave_idle_fingers_alone_though_their_taxels_jump_between_them(rate_hz: int) -> None:
    finger = np.repeat(np.arange(FINGERS), TAXELS)
    baseline = Baseline(finger, np.zeros_like(finger))
    in_contact: list[bool] = []
    grasps: list[bool] = []
    for path in trials(""):
        touched = np.zeros(FINGERS, bool)
        for frame in frames_of(path):
            calm = baseline.update((len(in_contact) + 1) * NS_PER_S // rate_hz, frame)
            if not in_contact:
                baseline.tare()
            fingers = np.array([calm.touched[finger == number].any() for number in range(FINGERS)])
            in_contact.append(bool(fingers[IDLE[0] :].any()))
            touched |= fingers
        grasps.append(bool(touched.any()))
    assert np.mean(in_contact) < 0.01
    assert all(grasps[NOTHING:-NOT_CLOSED])  # without blue_bear and none
