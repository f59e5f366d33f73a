"""Tracks of contacts that C follows are those of their specification in numpy."""

from __future__ import annotations

import numpy as np
import pytest

from skinware.tactile.tracking import TrackingSettings
from skinware.tactile.tracks import TRACK, Tracks, correct, expected_at, judge, move
from tests.specification import tracks as specified

N, PITCH_M = 40, 0.0065
SETTINGS = TrackingSettings()
JUDGED_BY = np.array([SETTINGS.velocity_s, SETTINGS.touch_s, SETTINGS.sliding_m_s, SETTINGS.steady, PITCH_M])


def some_tracks(random: np.random.Generator, time_ns: int) -> Tracks:
    """Old and new ones, some without a place, that share a blob, that jump, or that have gone."""
    tracks = np.zeros(N, TRACK)
    for name in ("place", "found"):
        tracks[name] = 0.1 + 0.003 * random.standard_normal((N, 3))
        tracks[name][random.random(N) < 0.1] = np.nan
    for name in ("pace", "motion", "velocity"):
        tracks[name] = 0.05 * random.standard_normal((N, 3))
    tracks["velocity"][random.random(N) < 0.1] = np.nan
    tracks["spread"] = 1e-6 * random.random((N, 3))
    tracks["spread"][random.random(N) < 0.1, 0] = np.inf
    for name in ("now", "height", "load", "peak"):
        tracks[name] = 20 * random.random(N)
    tracks["now"] = np.where(random.random(N) < 0.5, tracks["load"], tracks["now"])
    tracks["noise"], tracks["width"] = 1e-6 * random.random(N), 0.005 * random.random(N)
    tracks["seen_ns"] = time_ns - random.integers(0, 120_000_000, N)
    tracks["born_ns"] = time_ns - random.integers(0, 600_000_000, N)
    tracks["frames"], tracks["steps"] = random.integers(1, 9, (2, N))
    tracks["home"], tracks["frame"], tracks["kind"] = random.integers(-1, 4, N), random.integers(0, 2, N), 1
    for name in ("sure", "shared", "jumps"):
        tracks[name] = random.random(N) < 0.2
    return tracks


def assert_same(ours: Tracks, wanted: Tracks) -> None:
    for name in TRACK.names or ():
        np.testing.assert_allclose(ours[name], wanted[name], 1e-12, 1e-15, err_msg=name)


@pytest.mark.parametrize("seed", range(5))
def test_each_step_is_that_of_the_specification(seed: int) -> None:
    random, time_ns = np.random.default_rng(seed), 5_000_000_000
    before = some_tracks(random, time_ns)
    ours = expected_at(before, time_ns)
    assert_same(ours, specified.expected_at(before, time_ns))
    wanted, rows = ours.copy(), np.flatnonzero(random.random(N) < 0.7)
    correct(ours, rows, time_ns)
    specified.correct(wanted, rows, time_ns)
    assert_same(ours, wanted)
    for tracks in (ours, wanted):
        tracks["seen_ns"][rows] = time_ns
    move(ours, before[:-5].copy(), SETTINGS.velocity_s)
    specified.move(wanted, before[:-5], SETTINGS.velocity_s)
    assert_same(ours, wanted)
    judge(ours, before[:-5].copy(), time_ns, JUDGED_BY)
    specified.judge(wanted, before[:-5], time_ns, SETTINGS, PITCH_M)
    assert_same(ours, wanted)
    assert set(ours["kind"].tolist()) == {0, 1, 2}
