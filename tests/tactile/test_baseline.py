"""Baselines, one property at a time."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from skinware import DriverReader, Status
from skinware.errors import ConfigurationError, StructureError
from skinware.realtime import NS_PER_S
from skinware.status import Why
from skinware.tactile.baseline import Baseline, BaselineSettings, Calm
from skinware.tactile.testing import World, grid
from tests.cli.fake_skin import FakeSkin

RATE_HZ = 50
STEP_NS = 1_000_000_000 // RATE_HZ
N = 48
MODULE, PATCH = np.arange(N) // 12, np.arange(N) // 24


class Bench:
    """A baseline that is fed with noise around a level, and whatever is put on top."""

    def __init__(self, settings: BaselineSettings | None = None, noise: float = 0.8, **how: Any) -> None:
        self.baseline = Baseline(MODULE, PATCH, settings, **how)
        self.least = how.get("limits", (-np.inf,))[0]
        self.random = np.random.default_rng(1)
        self.noise = noise
        self.level = np.full(N, 15.0)
        self.time_ns = 0
        self.calm: Calm

    def run(
        self,
        seconds: float,
        load: float | npt.NDArray[np.float64] = 0.0,
        usable: npt.NDArray[np.bool_] | None = None,
        each: Callable[[Calm], object] = lambda _calm: None,
        per_s: float = 0.0,
        **more: Any,
    ) -> Calm:
        """The last of so many seconds of frames."""
        for _ in range(round(seconds * RATE_HZ)):
            self.time_ns += STEP_NS
            self.level += per_s / RATE_HZ
            values = np.round(self.level + load + self.noise * self.random.standard_normal(N)).clip(self.least)
            self.calm = self.baseline.update(self.time_ns, values, usable, **more)
            each(self.calm)
        return self.calm


def on(*taxels: int, load: float = 25.0) -> npt.NDArray[np.float64]:
    """(n,) a load on some taxels."""
    loads = np.zeros(N)
    loads[list(taxels)] = load
    return loads


def test_before_the_rest_is_known_nothing_is_touched() -> None:
    bench = Bench()
    calm = bench.run(4.9, on(3))
    assert not calm.touched.any()
    assert not calm.usable.any()
    assert np.isnan(calm.baseline).all()
    assert not calm.value.any()
    calm = bench.run(0.3)
    assert calm.usable.all()
    assert np.abs(calm.baseline[4:] - 15).max() < 0.5
    assert np.abs(calm.noise - 0.85).max() < 0.25  # that of the sensor, and that of its steps


def test_the_rest_is_known_though_somebody_brushed_over_it_for_a_third_of_the_time() -> None:
    bench = Bench()
    bench.run(1.5)
    bench.run(1.5, on(7))
    calm = bench.run(2.2)
    assert abs(calm.baseline[7] - 15) < 0.5
    assert calm.noise[7] < 1.5


def test_the_rest_is_not_taken_while_many_taxels_move() -> None:
    bench = Bench()
    strokes = [on(*range(first, first + 12)) for first in range(0, N, 12)]
    for round_of in range(8):
        calm = bench.run(1.0, strokes[round_of % 4])
    assert not calm.usable.any()
    assert bench.baseline.refused_share > 0.05
    calm = bench.run(10.0)
    assert calm.usable.all()
    assert bench.baseline.refused_share == 0
    assert np.abs(calm.baseline - 15).max() < 0.5


def test_those_that_rest_begin_and_each_of_the_others_when_it_has_rested() -> None:
    bench = Bench()
    for round_of in range(8):
        calm = bench.run(1.0, on(*range(12 * (round_of % 2), 12 * (round_of % 2) + 12)))
        assert not calm.usable[:24].any()
    assert calm.usable[24:].all()
    assert np.abs(calm.baseline[24:] - 15).max() < 0.5
    assert bench.baseline.refused_share == 0.5
    calm = bench.run(2.0, on(*range(6)))
    assert bench.baseline.refused_share == 0.5
    calm = bench.run(2.7)
    assert not calm.usable[:6].any(), "they were pressed a moment ago"
    calm = bench.run(0.5)
    assert calm.usable[6:].all()
    assert not calm.usable[:6].any()
    calm = bench.run(2.5)
    assert calm.usable.all()
    assert bench.baseline.refused_share == 0
    assert np.abs(calm.baseline - 15).max() < 0.5
    assert np.abs(calm.noise - 0.85).max() < 0.25


def test_a_tare_ends_the_waiting_of_those_that_move() -> None:
    bench = Bench()
    for round_of in range(6):
        calm = bench.run(1.0, on(*range(12 * (round_of % 2), 12 * (round_of % 2) + 12)))
    assert calm.usable.sum() == 24
    bench.run(0.5)
    bench.baseline.tare()
    calm = bench.run(0.1)
    assert calm.usable.all()
    assert not calm.touched.any()


def test_a_touch_has_its_value_without_delay_and_nothing_else_has_one() -> None:
    bench = Bench()
    bench.run(6)
    calm = bench.run(0.1, on(3, 30))
    assert np.flatnonzero(calm.touched).tolist() == [3, 30]
    assert np.abs(calm.value[[3, 30]] - 25).max() < 4
    assert not np.delete(calm.value, [3, 30]).any()
    assert calm.held[:12].all()
    assert not calm.held[12:24].any()
    calm = bench.run(1.0)
    assert not calm.touched.any()
    assert calm.held[:12].all(), "what was near a contact settles for a while"
    assert not bench.run(3.0).held.any()


@pytest.mark.thorough
@pytest.mark.parametrize("load", [12, 25, 60, 120, 200])
def test_the_end_of_a_touch_shows_at_once_however_firm_it_was(load: float) -> None:
    bench = Bench()
    bench.run(6)
    assert bench.run(2, on(5, load=load)).touched[5]
    assert not bench.run(0.14).touched.any()


@pytest.mark.parametrize("spread", [0.0, 0.1, 0.3])
def test_a_press_of_whole_patches_in_one_frame_is_a_touch(spread: float) -> None:
    """However alike its taxels answer: a hand that slams shut saturates all of them, and is no step of their supply."""
    bench = Bench()
    bench.run(10)
    load = 100 * (1 + spread * np.random.default_rng(2).standard_normal(N))
    shares = list[float]()
    bench.run(10, load=load, each=lambda calm: shares.append(float(calm.touched.mean())))
    assert min(shares[2:]) == 1


def test_a_glitch_does_not_end_a_light_touch() -> None:
    bench = Bench()
    bench.run(6)
    seen: list[bool] = []
    for _ in range(20):
        bench.run(0.5, on(5, load=8), each=lambda calm: seen.append(bool(calm.touched[5])))
        bench.run(0.02)
    assert np.mean(seen) > 0.99


@pytest.mark.thorough
def test_a_light_touch_stays_for_as_long_as_it_lasts() -> None:
    bench = Bench()
    bench.run(6)
    seen: list[bool] = []
    bench.run(300, on(5, load=6), each=lambda calm: seen.append(bool(calm.touched[5])))
    assert np.mean(seen[25:]) > 0.99


def test_a_longest_hold_ends_a_touch() -> None:
    bench = Bench(BaselineSettings(maximum_hold_s=4))
    bench.run(6)
    assert bench.run(3.5, on(3)).touched[3]
    forced: list[int] = []
    calm = bench.run(1.5, on(3), each=lambda calm: forced.extend(np.flatnonzero(calm.forced).tolist()))
    assert not calm.touched[3]
    assert forced == [3]


def test_tare_takes_what_is_there_for_the_rest() -> None:
    bench = Bench()
    bench.run(6)
    load = on(3, 30)
    bench.run(1, load)
    assert bench.baseline.tare(patch=0) == 24
    calm = bench.run(1 / RATE_HZ, load)
    assert calm.forced[:24].all()
    assert not calm.forced[24:].any()
    assert np.flatnonzero(calm.touched).tolist() == [30]
    assert bench.baseline.tare() == N
    assert not bench.run(1, load).touched.any()


def test_tare_needs_a_frame_and_ends_the_measurement_of_the_rest() -> None:
    bench = Bench()
    with pytest.raises(ConfigurationError, match="no value has come"):
        bench.baseline.tare()
    bench.run(0.2)
    bench.baseline.tare()
    calm = bench.run(0.2, on(3))
    assert calm.usable.all()
    assert np.flatnonzero(calm.touched).tolist() == [3]


def test_values_without_steps_need_four_values_before_a_tare() -> None:
    random, baseline = np.random.default_rng(0), Baseline(np.zeros(N), np.zeros(N), resolution=0.0)
    for number in range(3):
        baseline.update(number * NS_PER_S // RATE_HZ, random.random(N))
        with pytest.raises(ConfigurationError, match="known after four values"):
            baseline.tare()
    baseline.update(3 * NS_PER_S // RATE_HZ, random.random(N))
    assert baseline.tare() == N


@pytest.mark.parametrize("after_s", [0.8, 1.0, 3.0])
@pytest.mark.parametrize("rate_hz", [5, 20, 200])
def test_a_tare_before_the_rest_is_known_measures_the_noise(rate_hz: int, after_s: float) -> None:
    random = np.random.default_rng(2)
    values = np.round(220 + 2 * random.standard_normal((20 * rate_hz, 32)))
    baseline = Baseline(np.zeros(32), np.zeros(32))
    touched = []
    for number, frame in enumerate(values):
        if number == after_s * rate_hz:
            assert baseline.tare() == 32
        touched.append(baseline.update(number * NS_PER_S // rate_hz, frame).touched)
    assert not np.any(touched)


@pytest.mark.thorough
def test_hold_keeps_baselines_where_they_are_but_for_common_drift() -> None:
    bench = Bench(BaselineSettings(tau_s=1))
    bench.run(6)
    bench.baseline.hold(True)
    calm = bench.run(10, on(3, load=2.5))
    assert calm.held.all()
    assert abs(calm.baseline[3] - 15) < 0.5
    bench.baseline.hold(False)
    calm = bench.run(10, on(3, load=2.5))
    assert not calm.held.any()
    assert abs(calm.baseline[3] - 17.5) < 0.5


@pytest.mark.thorough
@pytest.mark.parametrize("what", ["nan", "stale", "huge"])
def test_a_patch_without_data_touches_nobody_else(what: str) -> None:
    """Not by one bit, and its own state is kept."""
    plain, disturbed = Bench(), Bench()
    gone = np.ones(N, bool)
    for bench in (plain, disturbed):
        bench.run(6, per_s=0.05)
        bench.run(2, on(3, 30), per_s=0.05)
    before = disturbed.calm
    bad = np.zeros(N)
    bad[24:] = {"nan": np.nan, "stale": -15.0, "huge": np.inf}[what]
    if what == "stale":
        gone[24:] = False
    for load in (on(3), on(), on(7, load=12)):
        one = plain.run(20, load, per_s=0.05)
        other = disturbed.run(20, load + bad, gone, per_s=0.05)
        for name in ("value", "touched", "held", "baseline", "noise", "forced"):
            assert np.array_equal(getattr(one, name)[:24], getattr(other, name)[:24], equal_nan=True), name
        assert not other.usable[24:].any()
        assert np.array_equal(other.baseline[24:], before.baseline[24:])
        assert np.array_equal(other.touched[24:], before.touched[24:])


def test_a_taxel_that_comes_later_is_measured_when_it_comes() -> None:
    bench = Bench()
    present = np.arange(N) != 40
    assert not bench.run(8, usable=present).usable[40]
    assert not bench.run(4).usable[40]
    assert bench.run(2).usable[40]
    assert bench.run(0.2, on(40)).touched[40]


def test_after_ten_minutes_without_data_a_baseline_is_worth_nothing() -> None:
    bench = Bench()
    bench.run(6)
    bench.time_ns += 599_000_000_000
    bench.level += 40
    assert bench.run(0.5).usable.all()
    bench.run(2)
    bench.time_ns += 601_000_000_000
    assert not bench.run(0.5).usable.any()
    assert bench.run(6).usable.all()


def test_a_jump_that_the_hardware_tells_is_no_touch() -> None:
    bench = Bench()
    bench.run(6)
    bench.level[:12] += 30
    jumped = np.arange(N) < 12
    calm = bench.run(1 / RATE_HZ, jumped=jumped)
    assert calm.forced[:12].any()
    assert not calm.forced[12:].any()
    seen: list[bool] = []
    bench.run(2, each=lambda calm: seen.append(bool(calm.touched.any())))
    assert not any(seen)


def test_what_was_covered_at_the_start_is_good_a_second_after() -> None:
    bench = Bench()
    bench.run(8, on(*range(12)))
    bench.run(1.5)
    assert np.abs(bench.calm.baseline[:12] - 15).max() < 1.5
    assert bench.run(0.2, on(4)).touched[4]


@pytest.mark.parametrize("together", [1, 3])
@pytest.mark.parametrize("signed", [False, True])
def test_few_taxels_have_no_common_mode_and_feel_after_minutes_and_after_a_press_at_the_start(
    together: int, signed: bool
) -> None:
    """Such are sums of forces, and fingertips with one value: their press at the start is no drift that they share."""
    baseline = Baseline(np.zeros(together, int), np.zeros(together, int), signed=signed)
    random, time_s = np.random.default_rng(together), np.arange(0, 400, 0.1)
    load = np.interp(time_s, [3.4, 3.5, 4.7, 4.8, 60, 60.1, 70, 70.1, 390, 390.1], [0, 30, 30, 0] * 2 + [0, 30])
    for moment_s, force in zip(time_s, load, strict=True):
        values = np.round(15 + force + 0.4 * random.standard_normal(together))
        calm = baseline.update(round(moment_s * NS_PER_S), values)
        if moment_s > 10 and force == load[np.abs(time_s - moment_s) < 0.5].mean():
            assert (calm.touched == (force > 0)).all(), moment_s
    assert calm.value == pytest.approx(30, abs=2)


def test_types_that_a_touch_moves_to_both_sides() -> None:
    bench = Bench(signed=True)
    bench.run(6)
    calm = bench.run(0.5, on(3) - on(20))
    assert np.flatnonzero(calm.touched).tolist() == [3, 20]
    assert calm.value[20] < -20
    assert not bench.run(1.5).touched.any()


def test_the_same_frame_twice_changes_nothing() -> None:
    bench = Bench()
    bench.run(6)
    values = np.round(bench.level + on(3))
    once = [bench.baseline.update(bench.time_ns + STEP_NS, values) for _ in range(3)]
    assert np.array_equal(once[0].baseline, once[2].baseline)
    back = bench.baseline.update(bench.time_ns - 10 * STEP_NS, values)
    assert np.array_equal(once[0].baseline, back.baseline), "nor one from before"


@pytest.mark.thorough
def test_bumps_do_not_make_a_held_load_look_released() -> None:
    bench = Bench()
    bench.run(6)
    bench.run(120, on(3), per_s=0.02)
    bench.run(0.3, on(3, load=120), per_s=0.02)
    seen: list[bool] = []
    bench.run(10, on(3), each=lambda calm: seen.append(bool(calm.touched[3])), per_s=0.02)
    assert all(seen)


@pytest.mark.thorough
def test_what_sagged_and_drifted_under_a_long_hold_is_no_contact_afterwards() -> None:
    bench = Bench()
    bench.run(6)
    for _ in range(80):  # taxel 5 drifts by 8 counts on its own, hidden by a sag of 6
        bench.level[5] += 0.1
        bench.run(1, on(3) - on(5, load=6))
    assert not bench.calm.touched[5]
    bench.run(2)
    assert not bench.calm.touched.any()
    assert bench.run(0.3, on(5, load=8)).touched[5], "and it feels as before"


@pytest.mark.thorough
def test_a_second_contact_in_the_module_outlives_the_first() -> None:
    bench = Bench()
    bench.run(6)
    bench.run(60, on(3))
    bench.run(20, on(3, 9))
    seen: list[bool] = []
    bench.run(10, on(9), each=lambda calm: seen.append(bool(calm.touched[9])))
    assert all(seen)


@pytest.mark.thorough
@pytest.mark.parametrize(("held_s", "grip", "eased"), [(60, 50, 8), (60, 150, 8), (240, 100, 15)])
def test_an_eased_grip_stays_felt(held_s: int, grip: float, eased: float) -> None:
    bench = Bench()
    bench.run(6)
    bench.run(held_s, on(3, load=grip))
    seen: list[bool] = []
    bench.run(60, on(3, load=eased), each=lambda calm: seen.append(bool(calm.touched[3])))
    assert all(seen)
    assert not bench.run(2).touched.any()


@pytest.mark.thorough
@pytest.mark.parametrize("eased", [15, 30, 50])
def test_an_eased_grip_shows_what_is_left_of_it_also_where_the_patch_drifts(eased: float) -> None:
    bench = Bench()
    bench.run(120, per_s=0.05)
    bench.run(60, on(3, load=150), per_s=0.05)
    shown: list[float] = []
    bench.run(120, on(3, load=eased), each=lambda calm: shown.append(float(calm.value[3])), per_s=0.05)
    assert min(shown) > 0
    assert abs(np.mean(shown) / eased - 1) < 0.2
    assert not bench.run(2, per_s=0.05).touched.any()


@pytest.mark.thorough
def test_the_uncertainty_grows_under_a_touch_by_the_drift_alone_and_shrinks_after_it() -> None:
    still, drifting = Bench(), Bench()
    for bench, per_s in ((still, 0.0), (drifting, 0.1)):
        bench.run(20, per_s=per_s)
        before = bench.calm.uncertainty[3]
        calm = bench.run(60, on(3), per_s=per_s)
        assert calm.why[3] == Why.HELD
        assert (calm.uncertainty[3] > 2 * before) == (per_s > 0)
        assert calm.uncertainty[3] < 1
        assert bench.run(10, per_s=per_s).uncertainty[3] < max(0.2, 1.2 * before)


@pytest.mark.parametrize("levels", [1, 2])
def test_taxels_with_two_or_three_levels_are_touched_at_the_first(levels: int) -> None:
    bench = Bench(noise=0.0)
    bench.level[:] = 0
    bench.run(6)
    calm = bench.run(30, on(3, load=levels))
    assert np.flatnonzero(calm.touched).tolist() == [3]
    assert calm.value[3] == pytest.approx(levels, abs=0.1)
    assert (calm.why == Why.NO_RESOLUTION).all()
    assert not bench.run(1).touched.any()


def test_a_press_of_three_counts_is_felt_where_the_noise_is_small() -> None:
    bench = Bench(noise=0.3)
    bench.run(10)
    assert np.flatnonzero(bench.run(1, on(3, load=3)).touched).tolist() == [3]
    assert not bench.run(1).touched.any()


@pytest.mark.parametrize("counts", [3, 6, -6, -30])
def test_a_board_that_moves_its_own_baseline_by_a_little_is_no_touch(counts: float) -> None:
    bench = Bench()
    bench.run(10)
    bench.level[:12] += counts
    bench.run(2)
    assert not bench.run(5).touched.any()
    assert np.flatnonzero(bench.run(1, on(5)).touched).tolist() == [5]


def test_touches_that_lower_values_are_none_and_their_polarity_is_doubted() -> None:
    bench = Bench()
    bench.run(10)
    for _ in range(3):
        bench.run(4, -on(5))
        calm = bench.run(4)
        assert not calm.touched.any()
    assert calm.why[5] == Why.DOUBTED
    assert not (calm.why[:5] == Why.DOUBTED).any()


def test_a_spike_of_one_frame_is_no_touch() -> None:
    bench = Bench()
    bench.run(6)
    seen: list[bool] = []
    for _ in range(20):
        bench.run(0.02, on(5, load=100), each=lambda calm: seen.append(bool(calm.touched.any())))
        bench.run(0.3, each=lambda calm: seen.append(bool(calm.touched.any())))
    assert not any(seen)


@pytest.mark.parametrize("noise", [0, 0.8])
def test_a_rest_at_the_lower_end_of_the_range_is_known(noise: float) -> None:
    """Such are values that the device tares: most of their noise is cut off."""
    rest: list[npt.NDArray[np.bool_]] = []
    bench = Bench(noise=noise, limits=(0, 255))
    bench.level[:] = 0
    bench.run(6)
    for _ in range(6):
        assert bench.run(3, on(3, 4) + on(30)).touched[[3, 4, 30]].all()
        bench.run(1.5)
        bench.run(5, each=lambda calm: rest.append((calm.why == Why.REST) & (np.abs(calm.baseline) < 0.5)))
    assert np.mean(rest) > 0.99


def test_a_touched_value_at_the_end_of_the_range_may_be_more() -> None:
    bench = Bench(limits=(0, 40))
    bench.run(6)
    assert bench.run(1, on(5)).why[5] == Why.SATURATED
    assert bench.run(1, on(5, load=15)).why[5] == Why.HELD


def test_settings_can_change_while_it_runs() -> None:
    bench = Bench()
    bench.run(6)
    assert bench.run(1, on(3, load=8)).touched[3]
    bench.baseline.settings = bench.baseline.settings.changed({"minimum_on": 20})
    assert not bench.run(1, on(3, load=8)).touched.any()
    with pytest.raises(ConfigurationError, match="no setting 'tau'; there are: tau_s"):
        bench.baseline.settings.changed({"tau": 3})
    for name, value in (
        ("tau_s", 0),
        ("tau_s", None),
        ("tau_s", "3"),
        ("on_sigma", 2),
        ("settle_s", -1),
    ):
        with pytest.raises(ConfigurationError, match=name):
            bench.baseline.settings.changed({name: value})


def test_a_drivers_frames_with_their_status() -> None:
    with FakeSkin() as skin:
        baseline = Baseline.of(skin.structure, "pressure", BaselineSettings(smooth_s=0))
        assert len(baseline.ready) == 640
        with pytest.raises(StructureError, match="no sensor type"):
            Baseline.of(skin.structure, "proximity")
        skin.values = np.full(skin.structure.n_sensors, 200.0)
        skin.status[24] = Status.NEVER_SEEN
        skin.publish()
        with DriverReader("fake") as reader:
            baseline.take(reader.read())
            baseline.tare()
            skin.values[12] = 100  # of module 1: raw counts fall with pressure
            skin.values[24] = 100
            skin.status[36:46] |= np.uint8(Status.SUSPECT)
            skin.values[36:46] = 150
            for _ in range(3):
                skin.publish()
                calm = baseline.take(reader.read())
    assert not calm.usable[20]
    assert calm.usable.sum() == 639
    assert np.flatnonzero(calm.value > 90).tolist() == [10]
    assert calm.value[10] == 100
    assert not calm.touched[30:40].any(), "a jump that the hardware tells of"


def test_a_restored_baseline_begins_with_a_suspect_frame() -> None:
    with FakeSkin() as skin:
        first, second = (Baseline.of(skin.structure, "pressure") for _ in range(2))
        skin.values = np.full(skin.structure.n_sensors, 200.0)
        with DriverReader("fake") as reader:
            skin.publish()
            first.take(reader.read())
            first.tare()
            second.restore(first.state(), np.arange(640))
            skin.status[:] = Status.SUSPECT
            skin.publish()
            assert np.isfinite(second.take(reader.read()).baseline).all()


@pytest.mark.thorough
@settings(max_examples=40)
@given(st.data())
def test_whatever_comes_nothing_is_raised_and_nothing_is_said_of_the_unknown(data: st.DataObject) -> None:
    n = data.draw(st.integers(1, 9))
    module = data.draw(hnp.arrays(np.int64, n, elements=st.integers(0, 2)))
    patch = data.draw(hnp.arrays(np.int64, n, elements=st.integers(0, 1)))
    chosen = BaselineSettings(calibrate_s=data.draw(st.sampled_from([0.1, 1])), maximum_hold_s=1)
    baseline = Baseline(
        module, patch, chosen, signed=data.draw(st.booleans()), resolution=data.draw(st.sampled_from([0, 1]))
    )
    time_ns, ever = 0, np.zeros(n, bool)
    any_float = st.floats(width=32, allow_infinity=True, allow_nan=True) | st.integers(-300, 300).map(float)
    with np.errstate(over="ignore", invalid="ignore"):  # of the largest numbers there are
        for _ in range(data.draw(st.integers(1, 30))):
            time_ns += data.draw(st.sampled_from([0, 1, 10**7, 10**9, 10**12, -(10**8)]))
            values = data.draw(hnp.arrays(np.float32, n, elements=any_float))
            usable = data.draw(hnp.arrays(np.bool_, n))
            calm = baseline.update(time_ns, values, usable, jumped=data.draw(hnp.arrays(np.bool_, n)))
            ever |= usable & np.isfinite(values)
            assert not (calm.touched & ~ever).any()
            assert not (calm.usable & ~(usable & np.isfinite(values))).any()
            assert not calm.value[~calm.touched].any()
            assert len(calm.value) == len(calm.held) == len(calm.baseline) == len(calm.noise) == n
            if data.draw(st.booleans()):
                with contextlib.suppress(ConfigurationError):
                    baseline.tare()
            if data.draw(st.booleans()):
                baseline.hold(data.draw(st.booleans()))


def test_worlds_with_everything_that_goes_wrong_raise_nothing() -> None:
    world = World(grid(modules=4, patches=2), seed=3, drift_per_min=2, rate_hz=20, dtype=np.float32)
    world.push(world.surface.position_m[5], 200, 8, 20)
    world.stuck([1], 255)
    world.noisy([2], 20)
    world.missing(np.arange(24, 48), 3, 10, status=Status(0), value=np.nan)
    world.missing(np.arange(24), 12, 14)
    world.jump(np.arange(24, 48), 30, 16, suspect_s=1)
    baseline = Baseline(world.surface.module, world.surface.patch)
    for sample in world.samples(30):
        calm = baseline.update(sample.time_ns, sample.values, sample.usable)
        assert np.isfinite(calm.value).all()
        assert np.isfinite(calm.baseline[calm.usable]).all()


def test_a_light_load_beside_a_touch_is_not_learned_after_a_short_rest() -> None:
    random, baseline, frames = np.random.default_rng(1), Baseline(np.zeros(16, int), np.zeros(16, int)), 0
    strong, beside = {0: 2000, 1: 300}, {5: 2000, 1: 45}
    for seconds, loads in ((8.0, {}), *((1.2, strong), (0.5, {}), (1.2, beside), (0.5, {})) * 3, (1.2, beside)):
        for frame in range(round(seconds * 100)):
            values = 1000 + np.rint(4 * random.standard_normal(16))
            for taxel, load in {**strong, **beside, **loads}.items():
                values[taxel] += load if taxel in loads else load * max(0.0, 1 - frame / 20) * (frames > 800)
            frames += 1
            calm = baseline.update(frames * 10_000_000, values)
    assert abs(calm.baseline[1] - 1000) < 10
    assert calm.touched[5]


def test_a_hand_in_use_from_the_first_frame_takes_no_press_for_noise() -> None:
    """A quarter of the taxels are pressed for 0.4 s of each 1.1 s: they wait until they are known at rest."""
    random, n = np.random.default_rng(4), 40
    baseline, module = Baseline(np.arange(n) // 8, np.zeros(n, int)), np.arange(n) < 10
    for number in range(1200):
        time_s = number / 50
        load = 900 * np.sin(np.pi * min(time_s % 1.1, 0.4) / 0.4) * module * (time_s < 16)
        calm = baseline.update(number * 20_000_000, np.round(12 + 0.3 * random.standard_normal(n) + load))
    assert baseline.ready.all()
    assert calm.noise.max() < 1
    assert calm.baseline == pytest.approx(12, abs=1)


def test_a_hand_that_is_laid_down_within_a_second_is_no_step_of_its_boards() -> None:
    bench = Bench()
    bench.run(10)
    load = on(*range(36)) / 25 * bench.random.uniform(8, 16, N)
    for number in range(RATE_HZ):
        bench.run(1 / RATE_HZ, load * number / RATE_HZ)
    seen: list[float] = []
    calm = bench.run(30, load, each=lambda calm: seen.append(float(calm.touched[:36].mean())))
    assert min(seen) > 0.95
    assert not calm.touched[36:].any()


@pytest.mark.parametrize("per_min", [-1.0, 1.0])
def test_a_bottle_that_is_emptied_slowly_is_held_to_the_end_and_then_let_go(per_min: float) -> None:
    """Twelve minutes in which the patch drifts by as much as is left of the load, ten frames a second."""
    random, held = np.random.default_rng(3), np.arange(24) % 4 == 0
    baseline = Baseline(np.arange(24) // 12, np.zeros(24, int))
    gain, seen = 1 + 0.15 * random.standard_normal(24), []
    for number in range(7400):
        time_s = number / 10
        load = np.interp(time_s, [30, 31, 240, 660, 720, 720.3], [0, 30, 30, 9, 9, 0])
        values = np.round(60 + gain * per_min / 60 * time_s + load * held + 0.8 * random.standard_normal(24))
        calm = baseline.update(number * NS_PER_S // 10, values)
        if 32 < time_s < 720:
            seen.append(float(calm.touched[held].mean()))
    assert np.mean(seen) > 0.97
    assert not calm.touched.any()


@pytest.mark.parametrize(("counts", "gap_s"), [(-12, 0), (-40, 0), (-12, 10), (12, 10), (40, 10)])
def test_a_supply_that_sags_is_no_touch_and_changes_none(counts: float, gap_s: float) -> None:
    """All offsets step and return while fingers hold something: down, or while no samples come."""
    random, held = np.random.default_rng(5), (np.arange(N) % 12 < 3) & (MODULE < 2)
    baseline, gain = Baseline(MODULE, np.zeros(N, int)), 1 + 0.1 * random.standard_normal(N)
    for number in range(1000):
        time_s = number / 20
        values = (
            60 + 25 * held * (10 < time_s < 40) + counts * gain * (20 <= time_s < 30) + 30 * gain * (6 < time_s < 7.5)
        )
        time_ns = round((time_s + gap_s * (time_s >= 20) + gap_s * (time_s >= 30)) * 1e9)
        calm = baseline.update(time_ns, np.round(values + 0.8 * random.standard_normal(N)))
        if time_s > 8:
            assert not calm.touched[~held].any(), f"{time_s} s"
        if 10.2 < time_s < 39.9:
            assert calm.touched[held].all(), f"{time_s} s"
            assert np.abs(calm.value[held] - 25).max() < 4 + 0.3 * abs(counts), f"{time_s} s"


def test_a_hand_that_slams_shut_after_a_sag_of_the_supply_is_a_touch() -> None:
    bench = Bench()
    bench.run(10)
    bench.run(3, load=-40.0)
    bench.run(5)
    shares = list[float]()
    bench.run(5, load=40.0, each=lambda calm: shares.append(float(calm.touched.mean())))
    assert min(shares[4:]) == 1


@pytest.mark.parametrize("period_s", [0.1, 0.137])
@pytest.mark.parametrize(("step", "noise"), [(1.0, 0.8), (0.0, 0.1)])
def test_a_touch_is_felt_in_a_hum_that_changes_from_sample_to_sample(
    period_s: float, step: float, noise: float
) -> None:
    random, load = np.random.default_rng(6), on(5, 6, load=25.0) + on(30, load=12.0)
    baseline, gain = Baseline(MODULE, np.zeros(N, int), resolution=step), 1 + 0.3 * random.standard_normal(N)
    for number in range(20 * 50):
        time_s = number / 20
        hum = 10 * np.sin(2 * np.pi * time_s / period_s + 0.9)
        values = 60 + hum * gain.clip(0.1) + load * (30 <= time_s < 40) + noise * random.standard_normal(N)
        calm = baseline.update(number * 50_000_000, np.round(values) if step else values)
        if time_s > 8:
            assert not calm.touched[load == 0].any(), f"{time_s} s"
        if 30.5 < time_s < 40:
            assert calm.touched[load > 0].all(), f"{time_s} s"
            assert np.abs(calm.value - load).max() < 0.2 * load.max(), f"{time_s} s"
        if time_s > 41:
            assert not calm.touched.any(), f"{time_s} s"


def test_offsets_are_as_uncertain_as_they_are_wrong_while_taxels_drift_by_themselves() -> None:
    """Taxels begin to drift after 20 s, each at a speed of its own, as where a hand warms them; a grip of 2 minutes."""
    random = np.random.default_rng(3)
    module, speed = np.repeat(np.arange(4), 12), 0.003 * random.standard_normal(48)
    load = np.where(np.arange(48) % 12 < 6, 20.0, 0.0) * (module < 2)
    baseline = Baseline(module, np.zeros(48, int), resolution=0.0)
    held, free, doubts, errors = [], [], [], []
    for number in range(20 * 180):
        time_s = number / 20
        offset = 100 + speed * max(time_s - 20, 0)
        is_held = load * (time_s >= 60)
        calm = baseline.update(number * 50_000_000, offset + is_held + 0.1 * random.standard_normal(48))
        error = calm.baseline - offset
        is_right = np.abs(error) < 2 * np.hypot(calm.uncertainty, calm.noise)
        if time_s > 62:
            assert calm.touched[load > 0].all()
            held.append(is_right[load > 0])
            doubts.append(calm.uncertainty[load > 0])
            errors.append(error[load > 0])
        if time_s > 10:
            free.append(is_right[load == 0])
    assert np.mean(free) > 0.93
    assert np.mean(held) > 0.85
    assert np.mean(np.square(doubts)) < 4 * np.mean(np.square(errors))


def test_load_beside_a_touch_moves_no_uncertain_offset() -> None:
    bench = Bench(noise=4)
    bench.run(6)
    bench.run(1, on(0, load=400))
    state = bench.baseline.state()
    state["variance"][5] = 900
    bench.baseline.restore(state, np.arange(N))
    bench.run(1, on(0, load=400) + on(5, load=-40))
    for load in range(-40, 100, 5):
        bench.run(0.02, on(0, load=400) + on(5, load=load))
    assert abs(bench.calm.baseline[5] - 15) < 12


@pytest.mark.parametrize("noise", [0.3, 0.8, 2.0])
def test_heat_and_sweat_beside_a_grip_are_no_touch_but_a_press_there_is(noise: float) -> None:
    bench = Bench(noise=noise)
    bench.run(6)
    for risen in np.linspace(0, 48, 60 * RATE_HZ):
        bench.run(1 / RATE_HZ, on(0, 1, 2, load=400) + on(3, 4, 5, 6, load=risen))
        assert not bench.calm.touched[3:].any()
    bench.run(1, on(0, 1, 2, load=400) + on(3, 4, 5, 6, load=48) + on(4))
    assert np.flatnonzero(bench.calm.touched).tolist() == [0, 1, 2, 4]
    assert bench.calm.value[4] == pytest.approx(25, abs=8)


def test_load_that_moves_to_other_taxels_as_a_grip_loosens_is_no_remainder() -> None:
    bench = Bench()
    bench.run(6)
    bench.run(60, on(0, 1, 2, load=400))
    bench.run(1, on(0, 1, 2, load=90))
    for moved in np.linspace(0, 50, 50 * RATE_HZ):
        bench.run(1 / RATE_HZ, on(0, 1, 2, load=90 - moved) + on(3, 4, load=moved))
    assert bench.calm.touched[:5].all()
    assert np.abs(bench.calm.baseline[:5] - 15).max() < 3
