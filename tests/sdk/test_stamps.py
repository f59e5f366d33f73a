"""Kernel stamps on CLOCK_MONOTONIC, with clocks that the test sets."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from hypothesis import given
from hypothesis import strategies as st

from tests.sdk.stamping import Stamper

SECOND = 10**9
WALL_NS = 1_700_000_000 * SECOND
SLEW_NS = 2_000_000


class Clocks:
    """CLOCK_MONOTONIC, and a CLOCK_REALTIME that people set."""

    def __init__(self) -> None:
        self.monotonic_ns = 1000 * SECOND
        self.offset_ns = WALL_NS

    def stamper(self, has_clock: bool = False) -> Stamper:
        return Stamper(has_clock, -self.offset_ns, self.monotonic_ns)

    def read(self, stamper: Stamper, arrived: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
        return stamper.read(arrived, -self.offset_ns, self.monotonic_ns)


def control(clocks: Clocks, times_ns: list[int], hardware_ns: list[int] | None = None) -> npt.NDArray[np.int64]:
    """What the kernel gives with frames that arrive at these times, by the clock as it is set now."""
    made = np.zeros((len(times_ns), 8), np.int64)
    made[:, 2], made[:, 3] = np.divmod(np.array(times_ns) + clocks.offset_ns, SECOND)
    if hardware_ns is not None:
        made[:, 6], made[:, 7] = np.divmod(np.array(hardware_ns), SECOND)
    return made


@given(st.lists(st.tuples(st.integers(-(10**15), 10**15), st.integers(1, 10**8)), min_size=1, max_size=20))
def test_no_step_moves_a_stamp_out_of_its_poll(steps: list[tuple[int, int]]) -> None:
    clocks = Clocks()
    stamper = clocks.stamper()
    last_ns = np.int64(clocks.monotonic_ns)
    for step_ns, pause_ns in steps:
        before_ns = clocks.monotonic_ns
        arrived = control(clocks, [before_ns + pause_ns // 3, before_ns + pause_ns // 2])
        clocks.monotonic_ns += pause_ns
        clocks.offset_ns += step_ns
        read = clocks.read(stamper, arrived)
        window_ns = clocks.monotonic_ns - int(last_ns)  # every time in it is a possible one
        assert (np.diff(np.append(last_ns, read)) >= 0).all()
        last_ns = read[-1]
        assert last_ns <= clocks.monotonic_ns
        if abs(step_ns) > window_ns + SLEW_NS or step_ns == 0:
            assert read.tolist() == [before_ns + pause_ns // 3, before_ns + pause_ns // 2]


def test_frames_before_and_after_a_step_in_one_batch() -> None:
    clocks = Clocks()
    stamper = clocks.stamper()
    start_ns = clocks.monotonic_ns
    early = control(clocks, [start_ns + 1_000_000])
    clocks.offset_ns -= 3600 * SECOND
    late = control(clocks, [start_ns + 2_000_000])
    clocks.monotonic_ns += 5_000_000
    assert clocks.read(stamper, np.concatenate([early, late])).tolist() == [start_ns + 1_000_000, start_ns + 2_000_000]


def test_frames_that_came_before_the_kernel_stamped_are_not_later_than_those_after_them() -> None:
    clocks = Clocks()
    stamper = clocks.stamper()
    start_ns = clocks.monotonic_ns
    when_read = [start_ns + 5_000_000, start_ns + 5_001_000]
    when_arrived = [start_ns + 1_000_000, start_ns + 2_000_000]
    clocks.monotonic_ns += 6_000_000
    expected = [when_arrived[0], when_arrived[0], *when_arrived]
    assert clocks.read(stamper, control(clocks, when_read + when_arrived)).tolist() == expected


def test_hardware_stamps_are_on_our_clock_whatever_happens_to_the_wall_clock() -> None:
    clocks = Clocks()
    stamper = clocks.stamper(has_clock=True)
    generator = np.random.default_rng(11)
    errors = []
    for number in range(1500):
        true_ns = clocks.monotonic_ns + 1_000_000
        delays = generator.exponential(1e6, 4).astype(int).tolist()
        sent = [true_ns + 100_000 * n for n in range(4)]
        seen = np.maximum.accumulate([t + d for t, d in zip(sent, delays, strict=True)]).tolist()
        arrived = control(clocks, seen, [t * 10001 // 10000 - 777 for t in sent])
        clocks.monotonic_ns = max(seen) + 2_000_000
        if number % 100 == 99:
            clocks.offset_ns += 3600 * SECOND if number % 200 == 99 else -3600 * SECOND
        errors.append(clocks.read(stamper, arrived) - sent)
    settled = np.abs(np.concatenate(errors[500:]))
    assert settled.max() < 150_000


def test_a_frame_without_any_stamp_is_as_old_as_its_poll() -> None:
    clocks = Clocks()
    stamper = clocks.stamper(has_clock=True)
    clocks.monotonic_ns += 5_000_000
    assert clocks.read(stamper, np.zeros((2, 8), np.int64)).tolist() == [clocks.monotonic_ns] * 2
