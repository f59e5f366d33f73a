"""Baselines in the trials that fit into a test; ``tools/bench tactile`` runs all of them, with more seeds and rates."""

from __future__ import annotations

import pytest

from tests.tactile.trials import TRIALS, run

SHORT = [trial for trial in TRIALS if trial.until_s <= 450 and not trial.alone]
HALF_THE_RATE = {"common sine of 10 counts at 0.1 s"}
"""A hum of as many counts from frame to frame hides the beginning of a hold at 20 Hz."""

pytestmark = [pytest.mark.thorough, pytest.mark.timeout(400)]


def test_short_trials_hold() -> None:
    """Hums and waves, spikes, losses, covers, small presses, bent responses."""
    results = run(SHORT, seeds=4, rate_hz=20)
    missed = {trial.name: result.misses(trial) for trial, result in zip(SHORT, results, strict=True)}
    assert {name for name, of in missed.items() if of} <= HALF_THE_RATE, missed


@pytest.mark.parametrize("name", ["binary", "three levels"])
def test_few_levels_are_enough(name: str) -> None:
    trial = next(trial for trial in TRIALS if trial.name == name)
    assert run([trial], seeds=4, rate_hz=20)[0].misses(trial) == {}


def test_losses_at_a_low_rate_leave_enough_to_measure_the_rest() -> None:
    trial = next(trial for trial in TRIALS if trial.name == "30 % lost")
    assert run([trial], seeds=4, rate_hz=5)[0].misses(trial) == {}
