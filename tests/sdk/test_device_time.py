"""Device stamps on our clock: simulated devices whose true times are known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skinware_drivers.native.device_time import DeviceClock

S, MS = 1_000_000_000, 1_000_000
Times = npt.NDArray[np.int64]


@dataclass
class Run:
    """What a simulated device sent: stamps, times of receipt, and the truth."""

    stamps: Times
    received: Times
    true: Times


def run(
    seconds: float,
    *,
    rate_hz: float = 100.0,
    drift: float = 0.0,
    unit_s: float = 1e-6,
    modulo: int = 1 << 32,
    first_stamp: int = 0,
    begin_ns: int = 5_000 * S,
    seed: int = 0,
    stalls: bool = False,
    least_delay_ns: int = 200_000,
) -> Run:
    """A device whose clock is too fast by ``drift``, behind USB: frames of 1 ms, jitter, sometimes a stall."""
    random = np.random.default_rng(seed)
    n = int(seconds * rate_hz)
    true = begin_ns + (np.arange(n) * S / rate_hz).astype(np.int64)
    ticks = ((true - begin_ns) * (1 + drift) / S / unit_s).astype(np.int64)
    delay = least_delay_ns + random.exponential(300_000, n).astype(np.int64) + random.integers(0, MS, n)
    received = true + delay
    if stalls:
        for at in range(3 * S, int(seconds * S), 7 * S):
            begin, end = begin_ns + at, begin_ns + at + S // 2
            inside = (received > begin) & (received < end)
            received[inside] = end
    return Run((ticks + first_stamp) % modulo, np.maximum.accumulate(received), true)


def converted(clock: DeviceClock, device: Run, batch: int = 7) -> Times:
    """The times that a clock tells, batch by batch; holds what it always promises."""
    parts = [
        clock.convert(device.stamps[at : at + batch], device.received[at : at + batch])
        for at in range(0, len(device.stamps), batch)
    ]
    told = np.concatenate(parts)
    assert (told <= device.received).all(), "a time after the receipt"
    assert (np.diff(told) >= 0).all(), "a time that goes back"
    return told


@pytest.mark.thorough
@pytest.mark.parametrize("drift", [-200e-6, -20e-6, 0.0, 50e-6, 200e-6])
@pytest.mark.parametrize("stalls", [False, True])
def test_times_are_the_true_ones_but_for_the_shortest_delay(drift: float, stalls: bool) -> None:
    device = run(100, drift=drift, stalls=stalls)
    clock = DeviceClock(1e-6)
    error = converted(clock, device) - device.true
    settled = error[1500:]
    assert abs(settled - 200_000).max() < 300_000  # ns; frames came up to 0.5 s late
    assert clock.state.drift == pytest.approx(-drift, abs=8e-6)
    assert clock.state.restarts == 0
    early = error[300:1500]
    assert abs(early - 200_000).max() < 1_000_000


def test_the_times_are_steadier_than_the_receipt() -> None:
    device = run(60, stalls=True, drift=80e-6)
    told = converted(DeviceClock(1e-6), device)
    period = np.diff(told)[1500:]
    assert np.percentile(abs(period - 10 * MS), 99) < 30_000
    assert np.percentile(abs(np.diff(device.received)[1500:] - 10 * MS), 99) > 1_000_000


@pytest.mark.thorough
@pytest.mark.parametrize(("unit_s", "modulo"), [(1e-3, 1 << 16), (1e-6, 1 << 24), (1e-4, 60_000), (1e-6, 1 << 32)])
def test_stamps_wrap_around(unit_s: float, modulo: int) -> None:
    device = run(90, unit_s=unit_s, modulo=modulo, first_stamp=modulo - 1000, drift=100e-6)
    clock = DeviceClock(unit_s, modulo)
    error = converted(clock, device) - device.true
    assert clock.state.restarts == 0
    assert abs(error[1500:] - 200_000).max() < 300_000 + unit_s * S


@pytest.mark.thorough
@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 1000), lost=st.floats(0, 0.9), repeated=st.floats(0, 0.3), batch=st.integers(1, 400))
def test_lost_and_repeated_frames_change_nothing(seed: int, lost: float, repeated: float, batch: int) -> None:
    device = run(30, unit_s=1e-3, modulo=1 << 16, seed=seed, drift=-100e-6, stalls=True)
    random = np.random.default_rng(seed)
    times = np.where(random.random(len(device.true)) < repeated, 2, 1) * (random.random(len(device.true)) >= lost)
    thinned = Run(*(np.repeat(column, times) for column in (device.stamps, device.received, device.true)))
    clock = DeviceClock(1e-3, 1 << 16)
    told = converted(clock, thinned, batch)
    assert clock.state.restarts == 0
    settled = (told - thinned.true)[thinned.true > thinned.true[0] + 12 * S] if len(told) else told
    assert (abs(settled - 200_000) < 3 * MS).all()


def test_a_long_gap_of_several_turns() -> None:
    device = run(200, unit_s=1e-3, modulo=1 << 16, drift=30e-6)
    gap = (device.true < device.true[0] + 20 * S) | (device.true > device.true[0] + 190 * S)
    clock = DeviceClock(1e-3, 1 << 16)
    part = Run(device.stamps[gap], device.received[gap], device.true[gap])
    error = converted(clock, part) - part.true
    assert clock.state.restarts == 0
    assert abs(error[-500:] - 200_000).max() < 2 * MS


@pytest.mark.thorough
@pytest.mark.parametrize("uptime_s", [0.3, 20.0])
@pytest.mark.parametrize("batch", [1, 13, 10_000])
def test_a_device_that_restarts_is_followed_at_once(uptime_s: float, batch: int) -> None:
    first = run(uptime_s, drift=150e-6, first_stamp=70_000)
    second = run(40, drift=-150e-6, begin_ns=5_000 * S + round((uptime_s + 0.8) * S), seed=1)
    both = Run(
        *(np.concatenate([getattr(r, name) for r in (first, second)]) for name in ("stamps", "received", "true"))
    )
    clock = DeviceClock(1e-6)
    told = converted(clock, both, batch)
    assert clock.state.restarts == 1
    error = (told - both.true)[len(first.true) :]
    assert error.max() < 3 * MS
    assert abs(error[1500:] - 200_000).max() < 300_000
    assert clock.state.drift == pytest.approx(150e-6, abs=20e-6)


def test_a_clock_that_is_set_forward_begins_anew() -> None:
    first = run(10)
    second = run(30, begin_ns=5_010 * S, first_stamp=2_000_000_000, seed=1)
    clock = DeviceClock(1e-6)
    converted(clock, first)
    error = converted(clock, second) - second.true
    assert clock.state.restarts == 1
    assert abs(error[1500:] - 200_000).max() < 300_000


def test_the_first_frames_may_be_late_ones() -> None:
    """A stream that begins with a burst of old frames: later ones show that."""
    device = run(30)
    device.received[:50] = device.received[49]
    clock = DeviceClock(1e-6)
    told = converted(clock, device)
    error = told - device.true
    assert abs(error[100:] - 200_000).max() < 1 * MS


@pytest.mark.parametrize("us_per_s", [0, 1000])  # stands still, and counts milliseconds
def test_a_clock_that_does_not_go_is_not_believed_for_long(us_per_s: int) -> None:
    clock = DeviceClock(1e-6)
    received = 5_000 * S + np.arange(1, 100) * S // 10
    told = np.array([int(clock.convert([7 + n * us_per_s // 10], received[n : n + 1])[0]) for n in range(99)])
    assert (received - told).max() <= 3 * S
    assert (np.diff(told) >= 0).all()
    assert (told[31:] == received[31:]).all()
    assert clock.state.stops == 1
    assert clock.state.restarts == 0


@pytest.mark.parametrize("held_up_s", [6, 15, 45])
def test_what_was_held_up_for_long_has_the_time_at_which_it_was_stamped(held_up_s: int) -> None:
    device = run(90)
    end = device.true[0] + (20 + held_up_s) * S
    held_up = (device.true > device.true[0] + 20 * S) & (device.true < end)
    device.received[held_up] = end
    clock = DeviceClock(1e-6)
    error = converted(clock, device) - device.true
    assert clock.state.stops == clock.state.restarts == 0
    assert abs(error[1500:] - 200_000).max() < 300_000


def test_frames_from_before_this_machine_booted() -> None:
    received = [-MS, 0, 2 * S]
    assert DeviceClock(1e-6).convert([5, 1005, 2_001_005], received).tolist() == received


def test_nothing_gives_nothing() -> None:
    assert DeviceClock(1e-3).convert([], []).tolist() == []
    assert DeviceClock(1e-3).convert([5], [123]).tolist() == [123]
