"""A cover that sinks round a contact, over the borders of modules, is no touch when it comes back."""

from __future__ import annotations

import numpy as np
import pytest

from skinware.tactile import Baseline
from skinware.tactile.testing import Response, Wander, World, arm, arm_path, grid, triangles

LOAD = 60


def sagging(seed: int) -> World:
    """Twelve triangles side by side, 9 counts of sag 12 mm round a firm press."""
    return World(triangles(12), seed=seed, rate_hz=20, drift_per_min=0.5, response=Response(sag=0.15))


@pytest.mark.thorough
@pytest.mark.parametrize("seconds", [4, 30])
@pytest.mark.parametrize("seed", range(4))
def test_modules_round_a_contact_are_at_rest_when_it_is_over(seed: int, seconds: float) -> None:
    world = sagging(seed)
    surface = world.surface
    taxel = int(np.random.default_rng(seed).integers(len(surface)))
    world.push(surface.position_m[taxel], LOAD, 10, 10 + seconds, rise_s=0.1, radius_m=0.004)
    baseline = Baseline(surface.module, surface.patch)
    for sample in world.samples(30 + seconds):
        calm = baseline.update(sample.time_ns, sample.values, sample.usable)
        time_s = (sample.time_ns - 1_000_000_000) / 1e9
        if 10.3 < time_s < 10 + seconds - 0.2:
            assert calm.touched[taxel]
        if time_s > 11 + seconds:
            assert not calm.touched.any(), f"{time_s:.2f} s: {np.flatnonzero(calm.touched)}"


@pytest.mark.thorough
def test_a_touch_where_the_cover_has_sunk_is_seen_and_outlives_the_contact_that_made_it_sink() -> None:
    world = sagging(1)
    surface = world.surface
    firm = 45
    away_m = np.linalg.norm(surface.position_m - surface.position_m[firm], axis=1)
    sunk = int(np.abs(away_m - 0.022).argmin())
    assert surface.module[sunk] != surface.module[firm]
    world.push(surface.position_m[firm], LOAD, 10, 30, rise_s=0.1, radius_m=0.004)
    world.push(surface.position_m[sunk], 30, 20, 40, rise_s=0.1)
    baseline = Baseline(surface.module, surface.patch)
    seen, over = [], []
    for sample in world.samples(60):
        calm = baseline.update(sample.time_ns, sample.values, sample.usable)
        time_s = (sample.time_ns - 1_000_000_000) / 1e9
        if 20.3 < time_s < 39.8:
            seen.append(bool(calm.touched[sunk]))
        if time_s > 42:
            over.append(bool(calm.touched.any()))
    assert all(seen)
    assert not any(over)


@pytest.mark.thorough
def test_fingers_that_stroke_without_end_leave_nothing_behind_them() -> None:
    world = World(arm((2, 3)), rate_hz=20, sensitivity=12, drift_per_min=0.5, response=Response(sag=0.15))
    for board in (2, 3):
        path = tuple((x, y, z) for x, y, z in arm_path(board).tolist())
        world.gestures.append(Wander(path_m=path, force=5, radius_m=0.006, begin_s=6, end_s=1e6, speed_m_s=0.02))
    baseline = Baseline(world.surface.module, world.surface.patch)
    false = idle = seen = pressed = 0
    for sample in world.samples(90):
        calm = baseline.update(sample.time_ns, sample.values, sample.usable)
        if sample.time_ns < 21_000_000_000:
            continue
        is_idle, is_pressed = sample.truth < 0.5, sample.truth > 15
        false, idle = false + int((calm.touched & is_idle).sum()), idle + int(is_idle.sum())
        seen, pressed = seen + int((calm.touched & is_pressed).sum()), pressed + int(is_pressed.sum())
    assert false / idle < 0.003
    assert seen / pressed > 0.97


def test_a_cover_that_pulls_a_whole_quiet_patch_down_is_no_drift() -> None:
    """Strokes over a plate whose cover sags all over it, where one step of the values is far more than noise."""
    surface = grid(1, 8, 8)
    world = World(surface, seed=2, rate_hz=20, noise=0.05, response=Response(width_m=0.004, sag=0.2))
    ends = np.random.default_rng(2).uniform(surface.position_m.min(axis=0), surface.position_m.max(axis=0), (30, 2, 3))
    for number, stroke in enumerate(ends):
        world.stroke(stroke, 45.0, 7 + 3.0 * number, 9 + 3.0 * number, radius_m=0.006)
    baseline = Baseline(surface.module, surface.patch)
    for sample in world.samples(110.0):
        calm = baseline.update(sample.time_ns, sample.values, sample.usable)
    assert not calm.touched.any()
    assert np.abs(calm.baseline - sample.values.astype(np.float32)).max() <= 2


@pytest.mark.parametrize("seed", [0, 2])
def test_presses_that_follow_each_other_quickly_stay_felt(seed: int) -> None:
    """A patch is pressed for 1.75 s by what slides away, then free for 0.65 s, again and again: it is always in use."""
    random, surface = np.random.default_rng(seed), grid(1, 8, 8)
    place_m, rate_hz, noise = surface.position_m[:, :2], 100, 4.0
    pitch_m = np.ptp(place_m) / 7
    times_s = np.arange(60 * rate_hz) / rate_hz
    load = np.zeros((len(times_s), len(place_m)))
    for begin_s in np.arange(7, 58, 2.4):
        centre_m = random.uniform(place_m.min(axis=0), place_m.max(axis=0))
        way, width_m = random.normal(size=2), random.uniform(1, 2) * pitch_m
        top = random.uniform(270, 1350)
        rows = np.flatnonzero((times_s >= begin_s) & (times_s < begin_s + 1.75))
        share = (times_s[rows] - begin_s) / 1.75
        slid_m = 2 * pitch_m * np.clip(5 * share - 4, 0, 1)[:, None] * way / np.hypot(*way)
        away2 = ((place_m - (centre_m + slid_m)[:, None]) ** 2).sum(axis=2)
        load[rows] = top * np.minimum(1, share * 58)[:, None] * np.exp(-away2 / 2 / width_m**2)
    values = np.round(1000 + load + random.normal(0, noise, load.shape)).astype(np.float32)
    baseline, touched = Baseline(surface.module, surface.patch), np.zeros(load.shape, bool)
    for number, row in enumerate(values):
        touched[number] = baseline.update(1_000_000_000 + round(times_s[number] * 1e9), row).touched
    pressed = load > 15 * noise
    pressed[20:] &= pressed[:-20]  # for 0.2 s, at least
    pressed[: 9 * rate_hz] = False
    assert (~touched & pressed).sum() < 0.05 * pressed.sum()
    assert (touched & (load < 1)).sum() < 0.005 * (load < 1).sum()
