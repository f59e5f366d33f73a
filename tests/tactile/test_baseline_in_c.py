"""Baselines in C do what their specification in numpy does, value by value."""

from __future__ import annotations

import ctypes
import mmap
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from skinware import native
from skinware.status import Status
from skinware.tactile.baseline import Baseline, BaselineSettings, Calm
from skinware.tactile.testing import World, grid
from tests.specification.baseline import SpecifiedBaseline
from tests.tactile.bench import bench_world

N = 96
_STEP_NS = 1_000_000_000


def _before_a_guard(array: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Copy an array to where a page that ends the process at the first access follows it."""
    size = -(-array.nbytes // mmap.PAGESIZE) * mmap.PAGESIZE
    memory = mmap.mmap(-1, size + mmap.PAGESIZE)
    begin = ctypes.addressof(ctypes.c_char.from_buffer(memory))
    assert ctypes.CDLL(None).mprotect(ctypes.c_void_p(begin + size), ctypes.c_size_t(mmap.PAGESIZE), 0) == 0
    copy = np.frombuffer(memory, array.dtype, array.size, size - array.nbytes).reshape(array.shape)
    copy[...] = array
    return copy


@pytest.fixture(autouse=True)
def guards(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let C read and write nothing behind the arrays of a baseline."""

    def give_guarded(words: Any, *how: Any) -> dict[str, npt.NDArray[Any]]:
        arrays = native.give_arrays(words, *how)
        return native.give_arrays(words, 0, {}, {name: _before_a_guard(array) for name, array in arrays.items()})

    monkeypatch.setattr("skinware.tactile.baseline.give_arrays", give_guarded)


class Both:
    """A baseline and its specification, which see the same frames."""

    def __init__(self, module: npt.ArrayLike, patch: npt.ArrayLike, **how: object) -> None:
        self.ours = Baseline(module, patch, **how)  # type: ignore[arg-type]
        self.specified = SpecifiedBaseline(module, patch, **how)  # type: ignore[arg-type]

    def update(self, time_ns: int, values: npt.ArrayLike, *flags: npt.ArrayLike, jumped: npt.ArrayLike = False) -> Calm:
        calm = self.ours.update(time_ns, values, *flags, jumped=jumped)
        wanted = self.specified.update(time_ns, values, *flags, jumped=np.broadcast_to(jumped, len(calm.value)))
        for name in ("touched", "held", "why", "forced", "usable"):
            differ = np.flatnonzero(getattr(calm, name) != getattr(wanted, name))
            assert not len(differ), f"{name} of {differ[:5]} at {time_ns / _STEP_NS:.2f} s"
        for name in ("value", "baseline", "uncertainty", "noise"):
            found, right = getattr(calm, name), getattr(wanted, name)
            np.testing.assert_allclose(found, right, 1e-4, 1e-4, err_msg=f"{name} at {time_ns / _STEP_NS:.2f} s")
        assert self.ours.refused_share == self.specified.refused_share
        return calm

    def set(self, settings: BaselineSettings) -> None:
        self.ours.settings = self.specified.settings = settings

    def compare_states(self) -> None:
        ours, specified = self.ours.state(), self.specified.state()
        assert ours.keys() == specified.keys()
        for name, array in ours.items():
            assert array.dtype == specified[name].dtype
            np.testing.assert_allclose(array, specified[name], 1e-3, 1e-4, err_msg=name)

    def restored(self, module: npt.ArrayLike, patch: npt.ArrayLike, rows: npt.NDArray[np.intp]) -> Both:
        """The same with what these have learned."""
        new = Both(module, patch)
        assert new.ours.restore(self.ours.state(), rows) == new.specified.restore(self.specified.state(), rows)
        return new


def shuffled(seed: int) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Modules of twelve and patches of 48 taxels, whose taxels lie apart."""
    order = np.random.default_rng(seed).permutation(N)
    return order // 12, order // 48


@pytest.mark.parametrize("seed", [3, 4, *(pytest.param(seed, marks=pytest.mark.thorough) for seed in (0, 1, 2, 5))])
def test_presses_losses_jumps_and_other_rates(seed: int) -> None:
    random, resolution = np.random.default_rng(seed), 0.0 if seed == 4 else 1.0
    module, patch = shuffled(seed) if seed % 2 else (np.arange(N) // 12, np.arange(N) // 48)
    both = Both(
        *(module, patch),
        signed=seed == 3,
        resolution=resolution,
        limits=(0.0, 90.0) if seed != 4 else (-np.inf, np.inf),
        settings=BaselineSettings(calibrate_s=2.0, maximum_hold_s=6.0 if seed == 5 else None),
    )
    level, load, time_ns = np.full(N, 20.0), np.zeros(N), 0
    rate_hz = 20.0
    for number in range(1200):
        time_ns += round(_STEP_NS / rate_hz)
        level += 0.002 * (1 + 0.3 * (np.arange(N) % 7 - 3))
        if number % 40 == 0:
            rate_hz = float(random.choice([5, 20, 50, 100]))
            first = int(random.integers(0, N - 3))
            load = np.zeros(N)
            load[first : first + 3] = random.choice([0, 4, 8, 25, 60, 200, -10])
            module_step = 4.0 * (random.random() < 0.1)
            level[module == random.integers(8)] += module_step
        usable = random.random(N) > 0.05 * (number % 200 > 150)
        values = (level + load + 0.8 * random.standard_normal(N)).clip(0, 90)
        values = np.round(values) if resolution else values
        values[random.random(N) < 0.002] = np.nan
        jumped = (random.random(N) < 0.02) & (number % 100 == 99)
        level[jumped] += 15
        values[jumped] += 15
        both.update(time_ns, values, usable, jumped=jumped)
        if number in (500, 900):
            assert both.ours.tare(number % 2) == both.specified.tare(number % 2)
        if number in (600, 640):
            both.ours.hold(number == 600)
            both.specified.hold(number == 600)
        if number == 700:
            both.set(both.ours.settings.changed({"minimum_on": 5, "tau_s": 5}))
        if number == 1000:
            time_ns += 700 * _STEP_NS
    both.compare_states()


@pytest.mark.parametrize("frames", [4, 11, 24, 40, 130])
def test_tares_before_the_rest_is_known_are_alike(frames: int) -> None:
    module, patch = np.arange(N) // 12, np.arange(N) // 48
    both, random = Both(module, patch), np.random.default_rng(frames)
    for number in range(2 * frames):
        if number == frames:
            assert both.ours.tare(0) == both.specified.tare(0) > 0
        values = np.round(20 + 2 * random.standard_normal(N) + 2 * random.standard_normal())
        both.update(number * _STEP_NS, values, random.random(N) > 0.1)
    both.compare_states()


def test_a_restored_one_goes_on_alike() -> None:
    module, patch = np.arange(N) // 12, np.arange(N) // 48
    both, random = Both(module, patch), np.random.default_rng(1)
    values = np.round(20 + 0.8 * random.standard_normal((600, N)))
    values[150:350, 30:33] += 40
    for number in range(300):
        both.update((number + 1) * 50_000_000, values[number])
    rows = np.where(np.arange(N) < 90, np.arange(N), -1)
    both = both.restored(module, patch, rows)
    for number in range(300, 600):
        both.update((number + 1) * 50_000_000, values[number])
    both.compare_states()


def test_what_is_left_of_a_load_is_forgotten_when_it_rises_again_and_else_fades() -> None:
    """A load that eases then is no rest of a cover that was pressed before. 3 s after the other fell, 41 are left."""
    both, random = Both(np.arange(24) // 12, np.arange(24) // 12), np.random.default_rng(3)
    touched = []
    for number in range(1, 2200):
        rises = np.interp(number / 20, [10, 10.2, 40, 40.1, 46, 46.1, 52, 72], [0, 200, 200, 20, 20, 60, 60, 10])
        fades = np.interp(number / 20, [10, 10.2, 80, 80.1, 110], [0, 200, 200, 45, 5])
        values = np.round(20 + 0.8 * random.standard_normal(24) + [rises, rises, *[0] * 20, fades, fades])
        touched.append(both.update(number * 50_000_000, values).touched)
    assert np.all(np.array(touched)[20 * 12 : 20 * 80, :2])
    assert np.all(np.array(touched)[20 * 12 : 20 * 89, -2:])
    assert not np.any(touched[20 * 92 :], axis=0)[-2:].any()


@pytest.mark.parametrize("seed", range(3))
def test_patches_that_step_as_a_whole_and_gaps(seed: int) -> None:
    both, random = Both(np.arange(N) // 12, np.arange(N) // 48), np.random.default_rng(seed)
    gain, held = 1 + 0.1 * random.standard_normal(N), np.arange(N) % 48 < 8
    time_ns, step = 0, 0
    for number in range(800):
        time_ns += 20_000_000 if number % 150 else 5 * _STEP_NS
        step = int(random.choice([-12, -6, 0, 0, 6, 12])) if number % 60 == 0 else step
        usable = random.random(N) > 0.02 * (number % 100 > 50)
        values = 40 + number / 100 * gain + (25 * held + step * gain * (np.arange(N) >= 48)) * (number > 280)
        both.update(time_ns, np.round(values + 0.6 * random.standard_normal(N)), usable)
    both.compare_states()


def test_values_that_rest_at_the_lower_end_of_their_range() -> None:
    both, random = Both(np.arange(N) // 12, np.arange(N) // 48, limits=(0.0, 60.0)), np.random.default_rng(1)
    for number in range(900):
        load = 80 * ((number % 150 > 90) & (np.arange(N) % 12 < 3))
        values = 3 * np.sin(number / 100) + load + 0.7 * random.standard_normal(N)
        both.update((number + 1) * 50_000_000, np.round(values.clip(0, 60)))
    both.compare_states()


def test_patches_of_few_taxels() -> None:
    patch, random = np.array([0, 1, 1, 2, 2, 2, 3, 3, 3, 3]), np.random.default_rng(1)
    both = Both(patch, patch)
    for number in range(900):
        load = 40 * (number % 150 > 90) + number / 100
        both.update((number + 1) * 50_000_000, np.round(20 + load + 0.5 * random.standard_normal(10)))
    both.compare_states()


@pytest.mark.parametrize("seed", range(2))
def test_axes_within_the_skin_that_begin_under_a_load(seed: int) -> None:
    module, patch = shuffled(seed)
    along, within = Both(module, patch), Both(module, patch, signed=True)
    within.ours.stand_beside(along.ours)
    within.specified.stand_beside(along.specified)
    random, share = np.random.default_rng(seed), 0.0
    load = np.where(module == 0, 40.0, 0)
    for number in range(1, 1000):
        if number % 80 == 0:
            first, share = int(random.integers(0, N - 6)), float(random.uniform(-1, 1))
            load = np.zeros(N)
            load[first : first + 6] = random.choice([0, 3, 20, 80])
            for both in (along, within):
                both.ours.hold(number == 400)
                both.specified.hold(number == 400)
        noise = random.standard_normal((2, N))
        usable = random.random((2, N)) > 0.05 * (number % 200 > 150)
        pull = 0.2 * np.roll(load, 4) + (share if number >= 80 else 0.6) * load
        within.update(number * 50_000_000, np.round(pull + 0.6 * noise[0]), usable[0])
        along.update(number * 50_000_000, np.round(20 + load + 0.6 * noise[1]), usable[1])
    within.compare_states()


@pytest.mark.parametrize("levels", [1, 2])
def test_taxels_of_few_levels(levels: int) -> None:
    both, random = Both(np.arange(N) // 12, np.arange(N) // 48), np.random.default_rng(levels)
    for number in range(600):
        touched = np.arange(N) // 8 == number // 50
        both.update((number + 1) * 50_000_000, levels * touched + (random.random(N) < 0.001))


@pytest.mark.thorough
@pytest.mark.parametrize("drift", ["slow", "fast"])
def test_the_world_of_the_bench(drift: str) -> None:
    world = bench_world(drift, 20)  # type: ignore[arg-type]
    both = Both(world.surface.module, world.surface.patch)
    for sample in world.samples(1000):
        both.update(sample.time_ns, sample.values, sample.usable)
    both.compare_states()


def test_a_world_with_everything_that_goes_wrong() -> None:
    world = World(grid(modules=4, patches=2), seed=3, drift_per_min=2, rate_hz=20, dtype=np.float32)
    world.push(world.surface.position_m[5], 200, 8, 20)
    world.stuck([1], 255)
    world.noisy([2], 20)
    world.missing(np.arange(24, 48), 3, 10, status=Status(0), value=np.nan)
    world.missing(np.arange(24), 12, 14)
    world.jump(np.arange(24, 48), 30, 16, suspect_s=1)
    both = Both(world.surface.module, world.surface.patch)
    for sample in world.samples(60):
        both.update(sample.time_ns, sample.values, sample.usable)


@pytest.mark.parametrize("is_first", [True, False])
@pytest.mark.parametrize(
    "later", [4, 7, 11, *(pytest.param(frames, marks=pytest.mark.thorough) for frames in (5, 6, 8, 9, 10))]
)
def test_a_module_that_is_looked_at_again_while_a_touch_begins_on_it(later: int, is_first: bool) -> None:
    both, random = Both(np.zeros(12, int), np.zeros(12, int)), np.random.default_rng(later)
    for number in range(160):
        values = np.round(20 + 0.5 * random.standard_normal(12))
        if number >= 130:  # not at once, so that it is looked at again
            values[:9] += 3 if number == 130 else 7
        if number >= 130 + later:
            values[0 if is_first else 11] += 30
        both.update(number * _STEP_NS // 20, values)
    both.compare_states()


@pytest.mark.parametrize(("dead", "speed"), [(0, 100), (20, -300), (20, 2250)])
def test_dead_taxels_are_not_touched_in_a_drift_and_let_no_others_be(dead: int, speed: int) -> None:
    """Values of 24 bits, whose noise is small beside their drift. Beside a quick one, dead taxels seem to move."""
    random, both = np.random.default_rng(1), Both(np.arange(N) // 12, np.zeros(N, int))
    gain = 1 + 0.25 * random.standard_normal(N)
    for number in range(600):
        values = 2.5e6 + (np.arange(N) >= dead) * (speed * number * gain + 6e3 * random.standard_normal(N))
        assert not both.update(number * _STEP_NS // 20, values).touched.any()
