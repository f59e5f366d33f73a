"""A controller's clock on ours: against simulated clocks whose truth is known."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.sdk.stamping import Stamper

Stamps = npt.NDArray[np.int64]
START_NS = 5_000_000_000_000
LONGEST_DELAY_NS = 100_000_000


def wire_times(seconds: float, period_s: float = 0.002, start_ns: int = START_NS) -> Stamps:
    return start_ns + np.arange(1, round(seconds / period_s), dtype=np.int64) * round(period_s * 1e9)


def counter(true_ns: Stamps, drift: float, zero_ns: int = 123_456_789) -> Stamps:
    """What a controller whose clock is too fast by ``drift`` stamps."""
    return np.asarray(zero_ns + np.rint((true_ns - START_NS) * (1 + drift)).astype(np.int64))


def kernel(true_ns: Stamps, generator: np.random.Generator, mean_delay_ns: float = 500_000) -> Stamps:
    """What the kernel stamps: later, in order, and now and then much later."""
    delay = generator.exponential(mean_delay_ns, len(true_ns))
    delay[generator.random(len(true_ns)) < 0.01] += 20e6
    return np.asarray(np.maximum.accumulate(true_ns + delay.astype(np.int64)))


def convert(hardware: Stamps, software: Stamps, batch: int = 16) -> Stamps:
    """Return (n,) int64, CLOCK_MONOTONIC ns; each batch is read when its last frame has come."""
    stamper = Stamper(True, 0, 0)
    control = np.zeros((len(hardware), 8), np.int64)
    control[:, 3], control[:, 7] = software, hardware
    parts = [
        stamper.read(control[first : first + batch], 0, int(software[first : first + batch][-1]))
        for first in range(0, len(hardware), batch)
    ]
    return np.concatenate(parts)


@pytest.mark.thorough
@pytest.mark.parametrize("drift", [0.0, 2e-4, -2e-4])
@pytest.mark.parametrize("batch", [1, 64])
def test_stamps_are_far_better_than_the_kernels(drift: float, batch: int) -> None:
    true_ns = wire_times(20.0)
    hardware, software = counter(true_ns, drift), kernel(true_ns, np.random.default_rng(7))
    error = convert(hardware, software, batch) - true_ns
    settled = true_ns > START_NS + 2 * 10**9
    late = (software - true_ns)[settled]
    assert np.abs(error[settled]).max() < 60_000  # ns; of the kernel's:
    assert np.median(late) > 300_000
    assert late.max() > 20_000_000
    assert (error <= software - true_ns).all()
    assert np.abs(error[~settled]).max() < 1_500_000  # as long as the drift is not known


def test_a_clock_that_drifts_otherwise_with_its_warmth_is_followed() -> None:
    true_ns = wire_times(60.0)
    seconds = (true_ns - START_NS) / 1e9
    wander_ns = 20e-6 * 1e9 * 30 / np.pi * (1 - np.cos(np.pi * seconds / 30))  # between 0 and 40 ppm over a minute
    hardware = 10**9 + (true_ns - START_NS) + np.rint(wander_ns).astype(np.int64)
    error = convert(hardware, kernel(true_ns, np.random.default_rng(8))) - true_ns
    assert np.abs(error[seconds > 5]).max() < 250_000


@pytest.mark.parametrize("jump_ns", [-(10**9), 10**9, -(10**15), 200_000_000, 50_000_000])
def test_a_clock_that_is_set_is_followed_at_once(jump_ns: int) -> None:
    true_ns = wire_times(10.0)
    hardware = counter(true_ns, 1e-4, zero_ns=10**16)
    hardware[len(hardware) // 2 :] += jump_ns
    software = kernel(true_ns, np.random.default_rng(9))
    stamps = convert(hardware, software)
    assert (stamps <= software).all()
    assert (stamps >= software - LONGEST_DELAY_NS).all()
    error = np.abs(stamps - true_ns)
    again = true_ns > true_ns[len(true_ns) // 2] + 10**9
    assert error[again].max() < 200_000


def test_frames_without_a_hardware_stamp_keep_the_kernels() -> None:
    true_ns = wire_times(4.0)
    hardware, software = counter(true_ns, 1e-4), kernel(true_ns, np.random.default_rng(10))
    hardware[::3] = 0
    stamps = convert(hardware, software)
    assert (stamps[::3] == software[::3]).all()
    rest = np.ones(len(stamps), bool)
    rest[::3] = False
    assert (stamps[rest] < software[rest]).mean() > 0.9
    nothing = np.zeros(5, np.int64)
    assert (convert(nothing, software[:5]) == software[:5]).all()


@given(st.lists(st.tuples(st.integers(0, 2**62), st.integers(0, 10**10)), min_size=1, max_size=60), st.integers(1, 20))
def test_no_clock_whatsoever_puts_a_frame_after_the_kernel_or_long_before(
    stamps: list[tuple[int, int]], batch: int
) -> None:
    hardware = np.array([stamp for stamp, _ in stamps], np.int64)
    software = START_NS + np.cumsum(np.array([step for _, step in stamps], np.int64))
    converted = convert(hardware, software, batch)
    assert (converted <= software).all()
    assert (converted >= software - LONGEST_DELAY_NS).all()
