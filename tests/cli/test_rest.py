"""Baselines of the view: a touch stays to be seen, drift does not."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from skinware.sensor_types import PRESSURE
from skinware.views.history import DriverRest
from tests.cli.fake_skin import fake_structure

STRUCTURE = fake_structure(1, 1)
N = STRUCTURE.n_sensors
PRESSURE_AT, TEMPERATURE_AT = 0, 11
FRESH = np.ones(N, bool)


class Watching:
    def __init__(self) -> None:
        self.rest = DriverRest(STRUCTURE)
        self.time_ns = 10**9

    def see(
        self, value: float, duration_s: float = 0.05, fresh: npt.NDArray[np.bool_] = FRESH
    ) -> npt.NDArray[np.float32]:
        """All sensors have a value for some time; returns the changes then."""
        values = np.full(N, value, np.float32)
        for _ in range(round(duration_s * 20)):
            self.rest.follow(values, fresh, self.time_ns)
            self.time_ns += 50_000_000
        return self.rest.change(values)


def test_the_first_second_is_the_baseline() -> None:
    watching = Watching()
    for value in (12, 17) * 11:
        watching.see(value)
    assert watching.rest.baseline == pytest.approx(np.full(N, 14.5), abs=0.5)
    assert (watching.see(136) > 120).all()


def test_a_touch_stays_to_be_seen() -> None:
    watching = Watching()
    watching.see(14, 2)
    assert (watching.see(34, 10) > 15).all()


def test_drift_is_followed() -> None:
    watching = Watching()
    watching.see(14, 2)
    assert (watching.see(18, 300) < 0.2).all()


def test_pressure_that_was_there_from_the_start_is_forgotten_once_it_ends() -> None:
    watching = Watching()
    watching.see(200, 2)
    change = watching.see(14, 5)
    assert change[PRESSURE_AT] < 2  # it grows when touched: this is rest
    assert change[TEMPERATURE_AT] > 100  # who knows


def test_only_fresh_values_count() -> None:
    watching = Watching()
    stale = FRESH.copy()
    stale[:5] = False
    watching.see(90, 2, fresh=stale)
    assert np.isnan(watching.rest.baseline[:5]).all()
    assert (watching.rest.change(np.full(N, 90, np.float32)) < 1).all()
    watching.see(20, 0.1)  # at rest, ten snapshots a second count
    assert watching.rest.baseline[:5].tolist() == [20] * 5
    watching.see(np.nan)
    assert np.isfinite(watching.rest.baseline).all()


def test_the_same_frame_again_changes_nothing() -> None:
    watching = Watching()
    watching.see(14, 2)
    for _ in range(1000):
        watching.rest.follow(np.full(N, 100, np.float32), FRESH, watching.time_ns)
    assert watching.rest.baseline[TEMPERATURE_AT] == pytest.approx(14, abs=1)


def test_noise_is_what_half_of_them_do_by_themselves() -> None:
    watching = Watching()
    watching.see(14, 2)
    assert watching.rest.noise(PRESSURE.name) == 1  # count
    assert watching.rest.noise("temperature") == 0.5  # degC for a count
    watching = Watching()
    for value in (12, 17) * 11:
        watching.see(value)
    assert 2 < watching.rest.noise(PRESSURE.name) <= 5
    watching.see(250, 1)  # later than the first second
    assert watching.rest.noise(PRESSURE.name) <= 5
