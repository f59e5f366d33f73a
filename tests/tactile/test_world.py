"""The world in which tactile algorithms are tested: does it do what it says, and the same each time?"""

from __future__ import annotations

import dataclasses
import subprocess
import sys

import numpy as np
import pytest

from skinware.errors import ConfigurationError
from skinware.sensor_types import PRESSURE, TEMPERATURE
from skinware.status import Status
from skinware.structure import Structure
from skinware.tactile.testing import Response, Surface, World, grid, triangles
from tests.tactile.bench import BENCH_S, bench_world


def quiet(surface: Surface | None = None, **settings: object) -> World:
    """A world without noise or drift, in floats."""
    calm: dict[str, object] = {"noise": 0, "dtype": np.float32, "step": 0, "idle": 0, "minimum": -1e9, "maximum": 1e9}
    return World(grid(2) if surface is None else surface, **(calm | settings))  # type: ignore[arg-type]


def same(one: object, other: object) -> bool:
    return all(np.array_equal(a, b) for a, b in zip(dataclasses.astuple(one), dataclasses.astuple(other), strict=True))  # type: ignore[call-overload]


def busy(seed: int = 3) -> World:
    """Everything at once."""
    world = World(
        grid(4, patches=2),
        seed=seed,
        jitter=0.5,
        gain_spread=0.2,
        drift_per_min=2,
        wave=1,
        wave_s=20,
        walk=1,
        response=Response(sag=0.2, creep=0.1, remainder=0.2, creep_s=2),
    )
    world.push(world.surface.position_m[3], 50, 1, 5)
    world.stroke(world.surface.position_m[[12, 40]], 60, 2, 9, radius_m=0.003)
    world.cover(slice(36, 48), 30, -1, 3)
    world.dead(7)
    world.stuck(20, 99)
    world.noisy([21], 5)
    world.swap(slice(0, 3), slice(44, 47))
    world.missing(slice(12, 24), 2.5, 4.5)
    world.jump(slice(0, 12), -4, 6, suspect_s=0.5)
    return world


@pytest.mark.thorough
def test_same_seed_same_world_whatever_the_blocks() -> None:
    whole = busy().record(10)
    assert len(whole) == 500
    assert same(whole, busy().record(10))
    for rows in (1, 7, 128):
        row = 0
        for block in busy().blocks(10, rows):
            at = slice(row, row + len(block))
            assert np.array_equal(block.time_ns, whole.time_ns[at])
            assert np.array_equal(block.module_time_ns, whole.module_time_ns[at])
            assert np.array_equal(block.values, whole.values[at])
            assert np.array_equal(block.status, whole.status[at])
            assert np.array_equal(block.truth, whole.truth[at])
            row += len(block)
        assert row == 500


def test_another_seed_another_world_of_the_same_truth() -> None:
    one, other = bench_world(seed=1).record(20), bench_world(seed=2).record(20)
    assert np.array_equal(one.truth, other.truth)
    assert (one.values != other.values).mean() > 0.3


def test_frames_are_the_rows_of_blocks() -> None:
    whole, count = busy().record(6), 0
    for row, sample in enumerate(busy().samples(6)):
        assert sample.time_ns == whole.time_ns[row]
        assert np.array_equal(sample.values, whole.values[row])
        assert np.array_equal(sample.usable, whole.usable[row])
        assert np.array_equal(sample.truth, whole.truth[row])
        count += 1
    assert count == len(whole)


def test_a_push_is_a_bell_round_its_place() -> None:
    world = quiet()
    at = world.surface.position_m[5]
    world.push(at, 40, 1, 2, rise_s=0.2)
    block = world.record(3)
    seconds = (block.time_ns - block.time_ns[0]) / 1e9
    distance = np.linalg.norm(world.surface.position_m - at, axis=1)
    held = (seconds >= 1.2) & (seconds < 1.8)
    assert np.allclose(block.truth[held], 40 * np.exp(-0.5 * (distance / 0.004) ** 2), atol=1e-3)
    assert not block.truth[(seconds < 1) | (seconds >= 2)].any()
    rising = block.truth[(seconds >= 1) & (seconds <= 1.2), 5]
    assert len(rising) > 5
    assert (np.diff(rising) > 0).all()
    assert np.array_equal(block.values, block.truth)


def test_a_broad_probe_loads_evenly() -> None:
    world = quiet(radius := grid(1))
    world.push(radius.position_m.mean(axis=0), 40, 0, 1, rise_s=0, radius_m=0.05)
    assert np.allclose(world.record(0.5).truth, 40)


def test_a_stroke_goes_along_its_path_at_one_speed() -> None:
    world = quiet(grid(1, rows=1, columns=11, pitch_m=0.01))
    world.stroke(np.array([[0, 0, 0], [0.04, 0, 0], [0.1, 0, 0]]), 30, 1, 11, rise_s=0)
    block = world.record(11)
    seconds = (block.time_ns - block.time_ns[0]) / 1e9
    for taxel in range(1, 10):
        assert seconds[block.truth[:, taxel].argmax()] == pytest.approx(1 + taxel, abs=0.011)
    ((stroke, place, force),) = world.pressing(6)
    assert (stroke, force) == (world.gestures[0], 30)
    assert np.allclose(place, [0.05, 0, 0])
    assert not world.pressing(0.5)
    assert not world.pressing(11)


def test_a_cover_lies_on_its_taxels_only_and_from_before_the_start() -> None:
    world = quiet()
    world.cover(slice(3, 7), 12, -1, 2)
    truth = world.record(3).truth
    assert (truth[0, 3:7] == 12).all()
    assert not np.delete(truth, slice(3, 7), axis=1).any()
    assert not truth[-1].any()


def test_gains_are_in_the_truth_and_forces_are_scaled() -> None:
    world = quiet(sensitivity=3, gain_spread=0.3)
    world.cover(slice(None), 10, -1, 2)
    block = world.record(1)
    assert block.truth[0].std() > 3
    assert np.median(block.truth[0]) == pytest.approx(30, rel=0.3)
    assert np.array_equal(block.truth, block.values)


def test_sag_pulls_the_neighbours_down_and_is_not_in_the_truth() -> None:
    world = quiet(response=Response(sag=0.25))
    world.push(world.surface.position_m[0], 40, 0, 1, rise_s=0)
    block = world.record(0.5)
    distance = np.linalg.norm(world.surface.position_m - world.surface.position_m[0], axis=1)
    ring = (distance > 0.010) & (distance < 0.014)
    assert ring.any()
    assert (block.values[0, ring] < -8).all()
    assert block.values[0, 0] == 40
    assert not block.values[0, distance > 0.05].any()
    assert block.truth.min() == 0


def test_creep_grows_under_a_load_and_a_remainder_goes_after_it() -> None:
    world = quiet(response=Response(creep=0.1, remainder=0.2, creep_s=4))
    world.cover(0, 50, 1, 41, rise_s=0)
    block = world.record(60)
    seconds = (block.time_ns - block.time_ns[0]) / 1e9
    at = {s: float(block.values[np.searchsorted(seconds, s), 0]) for s in (1.0, 5, 40.9, 41, 45, 59)}
    assert at[1] == pytest.approx(50, abs=0.1)
    assert at[5] == pytest.approx(50 + 5 * (1 - np.exp(-1)), abs=0.1)
    assert at[40.9] == pytest.approx(55, abs=0.1)
    assert at[41] == pytest.approx(10, abs=0.1)
    assert at[45] == pytest.approx(10 * np.exp(-1), abs=0.1)
    assert at[59] == pytest.approx(0, abs=0.2)
    assert not block.truth[seconds >= 41].any()


def test_drift_is_common_with_a_factor_of_each_taxel() -> None:
    world = quiet(grid(10), drift_per_min=3, drift_spread=0.3)
    values = world.record(120).values
    slope = (values[-1] - values[0]) / (119.98 / 60)
    assert np.median(slope) == pytest.approx(3, rel=0.15)
    assert slope.std() == pytest.approx(0.9, rel=0.25)
    half = values[3000] / values[-1]
    assert np.allclose(half, half[0], atol=1e-3)


def test_waves_start_at_zero_and_each_patch_has_its_own() -> None:
    world = quiet(grid(4, patches=2), wave=5, wave_s=10, drift_spread=0)
    values = world.record(20).values.astype(np.float64)
    assert np.ptp(values, axis=0) == pytest.approx(10, rel=0.01)
    assert not np.allclose(values[:, 0], values[:, -1], atol=0.5)
    assert np.allclose(values[0], 0, atol=0.1)


def test_a_walk_has_the_size_it_says() -> None:
    values = quiet(grid(20), walk=2).record(60).values
    assert values[-1].std() == pytest.approx(2, rel=0.25)
    assert not np.allclose(values[-1, 0], values[-1, 1])


def test_values_are_rounded_and_clipped_where_they_say() -> None:
    world = World(grid(2), noise=0.8, idle=15)
    world.cover(0, 1000, 0, 9)
    world.jump(1, -1000, 0)
    values = world.record(1).values
    assert values.dtype == np.uint8
    assert values[10:, 0].min() == 255
    assert values[:, 1].max() == 0
    idle = values[:, 2:].astype(float)
    assert idle.mean() == pytest.approx(15, abs=0.1)
    assert idle.std() == pytest.approx(np.hypot(0.8, 12**-0.5), rel=0.1)


def test_dead_stuck_and_noisy_taxels() -> None:
    world = World(grid(2), noise=1, step=0, dtype=np.float32)
    world.cover(slice(None), 50, -1, 9)
    world.dead([3, 4])
    world.stuck(5, 77)
    world.noisy(6, 4)
    block = world.record(4)
    assert (abs(block.values[:, 3:5].mean(axis=0) - 15) < 1).all()
    assert (block.values[:, 5] == 77).all()
    assert (block.values[:, 6] - 65).std() == pytest.approx(4, rel=0.2)
    assert (block.truth == 50).all()


def test_swapped_connectors_show_the_other_and_swapping_back_is_nothing() -> None:
    world = quiet()
    world.cover(0, 50, -1, 9)
    world.swap(slice(0, 12), slice(12, 24))
    block = world.record(1)
    assert block.values[0, 12] == 50
    assert block.values[0, 0] == 0
    assert block.truth[0, 0] == 50
    world.swap(slice(0, 12), slice(12, 24))
    assert np.array_equal(world.record(1).values, block.truth)
    with pytest.raises(ConfigurationError, match="3 taxels cannot be exchanged with 2"):
        world.swap([0, 1, 2], [3, 4])


@pytest.mark.parametrize("rows", [1, 13, 1000])
def test_silent_taxels_keep_their_value_and_say_so(rows: int) -> None:
    world = quiet(grid(4, patches=2), drift_per_min=60, drift_spread=0)
    world.missing(slice(0, 24), 1, 2)
    world.missing(slice(24, 48), -1, 0.5, status=Status.NEVER_SEEN)
    world.missing(40, 1, 2, status=Status(0), value=np.nan)
    blocks = list(world.blocks(3, rows))
    values, status, usable = (
        np.concatenate([getattr(block, name) for block in blocks]) for name in ("values", "status", "usable")
    )
    silent = status[:, 0] == Status.STALE
    assert silent.sum() == 50
    assert len(np.unique(values[silent, 0])) == 1
    assert (np.diff(values[:, 30])[30:] > 0).all()
    assert not usable[silent, :24].any()
    assert usable[silent, 24:].all()
    assert (values[:20, 24:] == 0).all()
    assert (status[:20, 24:] == Status.NEVER_SEEN).all()
    assert np.isnan(values[:, 40]).sum() == 50
    assert not np.isnan(np.delete(values, 40, axis=1)).any()


def test_a_jump_moves_its_taxels_and_may_be_told() -> None:
    world = quiet()
    world.jump(slice(0, 12), 9, 1, suspect_s=0.2)
    world.jump(13, -3, 2)
    block = world.record(3)
    assert (block.values[[0, 49, 50, 149], 0] == [0, 0, 9, 9]).all()
    assert (block.values[[99, 100], 13] == [0, -3]).all()
    assert (block.status == Status.SUSPECT).sum() == 10 * 12
    assert block.usable.all()
    assert not block.truth.any()


def test_patches_have_their_own_phases_and_time_stamps() -> None:
    world = quiet(grid(6, patches=3), rate_hz=20)
    block = world.record(2)
    late = block.time_ns[:, np.newaxis] - block.module_time_ns
    assert (late >= 0).all()
    assert (late < 1e9 / 20).all()
    assert (late.min(axis=1) == 0).all()
    assert np.array_equal(late[:, 0], late[:, 1])
    assert len(np.unique(late[0])) == 3
    assert np.allclose(np.diff(block.time_ns), 1e9 / 20)


def test_each_patch_feels_what_is_there_when_it_looks() -> None:
    world = quiet(grid(4, patches=4), rate_hz=20)
    world.cover(slice(None), 100, 0, 4, rise_s=2)
    block = world.record(2)
    of_patch = block.truth.reshape(-1, 4, 12)[:, :, 0]
    module_s = (block.module_time_ns - block.time_ns[0]) / 1e9
    assert np.allclose(of_patch, 50 * module_s.clip(0), atol=1e-3)


def test_jitter_moves_frames_but_not_their_order() -> None:
    steps = np.diff(quiet(jitter=0.9, rate_hz=100).record(20).time_ns) / 1e9
    assert steps.min() > 0
    assert steps.std() > 0.002
    assert steps.mean() == pytest.approx(0.01, rel=0.01)


def test_taxels_without_a_place_feel_no_push_and_break_nothing() -> None:
    position = grid(1).position_m.copy()
    position[4] = np.nan
    world = quiet(Surface.at(position), response=Response(sag=0.2))
    world.push(position[0], 50, 0, 2, radius_m=1)
    world.stroke(position[[0, 3]], 50, 0, 2)
    block = world.record(1)
    assert not block.values[:, 4].any()
    assert np.isfinite(block.values).all()
    assert (block.truth[25, [0, 1, 2, 3, 5]] > 45).all()


def test_nothing_at_all() -> None:
    assert not list(quiet().samples(0))
    with pytest.raises(ConfigurationError, match="no frames"):
        quiet().record(0)
    empty = Surface.at(np.zeros((0, 3)))
    assert (len(empty), empty.n_modules, empty.n_patches) == (0, 0, 0)


def test_a_surface_of_a_structure_has_its_places_and_numbers() -> None:
    structure = Structure(
        types=[PRESSURE, TEMPERATURE],
        buses=["can0"],
        patch_name=["a", "b"],
        patch_bus=[0, 0],
        module_patch=[0, 1, 1],
        module_kind=["x", "x", "x"],
        sensor_uid=[1, 2, 3, 4, 5],
        sensor_type=[PRESSURE.id, TEMPERATURE.id, TEMPERATURE.id, PRESSURE.id, PRESSURE.id],
        sensor_module=[0, 0, 1, 2, 2],
        dtype="u1",
    )
    surface = Surface.of(structure, "pressure")
    assert surface.module.tolist() == [0, 1, 1]
    assert surface.patch.tolist() == [0, 1, 1]
    assert np.isnan(surface.position_m).all()
    world = quiet(surface)
    world.cover(2, 5, -1, 9)
    assert world.record(1).values[0].tolist() == [0, 0, 5]


def test_triangles_are_those_of_a_roboskin() -> None:
    surface = triangles(5, patches=2)
    assert (len(surface), surface.n_modules, surface.n_patches) == (50, 5, 2)
    distance = np.linalg.norm(surface.position_m[:, np.newaxis] - surface.position_m, axis=2)
    np.fill_diagonal(distance, np.inf)
    assert np.allclose(distance[:10, :10].min(axis=1), 0.0065)
    between = [distance[10 * m : 10 * m + 10, 10 * m + 10 : 10 * m + 20].min() for m in range(4)]
    assert np.allclose(between, between[0])
    assert 0.005 < between[0] < 0.008
    centres = surface.position_m.reshape(5, 10, 3).mean(axis=1)
    assert np.allclose(np.linalg.norm(np.diff(centres, axis=0), axis=1), 0.03 / np.sqrt(3))


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: World(grid(1), rate_hz=0), "rate_hz 0"),
        (lambda: World(grid(1), jitter=1), "jitter 1"),
        (lambda: World(grid(1), idle=300), "idle 300"),
        (lambda: World(grid(1), maximum=1000), "more than uint8 holds"),
        (lambda: World(grid(1), minimum=-1), "more than uint8 holds"),
        (lambda: World(grid(1), wave_s=0), "wave_s 0"),
        (lambda: World(Surface.at(np.zeros((0, 3)))), "at least one taxel"),
        (lambda: World(grid(1)).stuck(0, 300), "stuck at 300"),
        (lambda: World(grid(1)).stuck(0, np.nan), "stuck at nan"),
        (lambda: World(grid(1)).missing(0, 0, 1, value=np.nan), "uint8 cannot be nan"),
        (lambda: World(grid(1)).missing(0, 0, 1, value=256), "uint8 cannot be 256"),
        (lambda: Response(width_m=0), "width_m 0"),
        (lambda: Response(creep_s=-1), "creep_s -1"),
        (lambda: World(grid(1)).push([0, 0, 0], 1, 2, 1), "no time"),
        (lambda: World(grid(1)).push([0, 0, 0], 1, 0, 1, rise_s=0.6, fall_s=0.6), "no time"),
        (lambda: World(grid(1)).push([0, 0, 0], np.nan, 0, 1), "not finite"),
        (lambda: World(grid(1)).stroke([[0, 0, 0]], 1, 0, 1), "two points"),
        (lambda: World(grid(1)).cover([12], 1, 0, 1), "of 12 taxels"),
        (lambda: World(grid(1)).dead(99), "of 12 taxels"),
        (lambda: Surface.at(np.zeros((4, 3)), module=[0, 2, 2, 2]), "module must count from 0"),
        (lambda: Surface.at(np.zeros((2, 3)), patch=[0, 1]), "two patches"),
        (lambda: Surface.at(np.zeros((4, 3)), module=[0, 0]), "4 taxels, but module"),
    ],
)
def test_nonsense_is_refused_in_words(make: object, words: str) -> None:
    with pytest.raises(ConfigurationError, match=words):
        make()  # type: ignore[operator]


@pytest.mark.thorough
@pytest.mark.parametrize("rate_hz", [20.0, 100.0])
@pytest.mark.parametrize("drift", ["slow", "fast"])
def test_the_bench_is_what_it_says(drift: str, rate_hz: float) -> None:
    world = bench_world(drift, rate_hz)  # type: ignore[arg-type]
    block = world.record(BENCH_S)
    truth = block.truth.reshape(len(block), 10, 12)
    seconds = (block.time_ns - block.time_ns[0]) / 1e9
    assert not truth[:, 7:].any()
    held = (seconds > 121) & (seconds < 719)
    assert np.allclose(truth[held, 1, 5], 25)
    assert truth[seconds < 59, 0].min() == 40
    assert truth[:, 3].max() == pytest.approx(12)
    assert truth[:, 4].max() == pytest.approx(6)
    taps = truth[:, 2].max(axis=1) > 20
    assert (np.diff(taps.astype(int)) == 1).sum() == 30
    drifted = (block.values[-1, 84:].astype(float) - 15) / world.follows[84:]
    assert np.median(drifted) == pytest.approx({"slow": 12.5, "fast": 75}[drift], abs=2.5)
    assert {gesture.name for gesture in world.gestures} == {
        "covered", "hold", "tap", "slow", "weak", "firm", "stroke"
    }  # fmt: skip


@pytest.mark.thorough
def test_skinware_does_not_load_it() -> None:
    code = "import sys, skinware; sys.exit(any(name.startswith('skinware.tactile') for name in sys.modules))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
