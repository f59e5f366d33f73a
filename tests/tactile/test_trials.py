"""Baselines in the trials that fit into a test; ``tools/bench tactile`` runs all of them, with more seeds and rates."""

from __future__ import annotations

import pytest

from tests.tactile.trials import TRIALS, run

SHORT = [trial for trial in TRIALS if trial.until_s <= 450 and not trial.alone]

pytestmark = [pytest.mark.thorough, pytest.mark.timeout(400)]


def test_short_trials_hold() -> None:
    """Hums and waves, spikes, losses, covers, small presses, bent responses."""
    results = run(SHORT, seeds=4, rate_hz=20)
    missed = {trial.name: result.misses(trial) for trial, result in zip(SHORT, results, strict=True)}
    assert not any(missed.values()), missed


@pytest.mark.parametrize("name", [trial.name for trial in TRIALS if trial not in SHORT and trial.until_s < 2500])
def test_other_trials_hold(name: str) -> None:
    """Grips that loosen, grasps for half an hour, heat, humidity, steps of boards, taxels with few levels."""
    trial = next(trial for trial in TRIALS if trial.name == name)
    assert run([trial], seeds=4, rate_hz=20)[0].misses(trial) == {}


def test_losses_at_a_low_rate_leave_enough_to_measure_the_rest() -> None:
    trial = next(trial for trial in TRIALS if trial.name == "30 % lost")
    assert run([trial], seeds=4, rate_hz=5)[0].misses(trial) == {}
