"""Kernel stamps on CLOCK_MONOTONIC, with clocks that the test sets."""

from __future__ import annotations

import time

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skinware_drivers.can import receiving
from skinware_drivers.can.receiving import Stamper

SECOND = 10**9
WALL_NS = 1_700_000_000 * SECOND


class Clocks:
    """CLOCK_MONOTONIC, and a CLOCK_REALTIME that people set."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.monotonic_ns = 1000 * SECOND
        self.offset_ns = WALL_NS
        self.pauses: list[int] = []
        monkeypatch.setattr(receiving, "now_ns", lambda: self.monotonic_ns)
        monkeypatch.setattr(time, "time_ns", self._read_wall)

    def _read_wall(self) -> int:
        value = self.monotonic_ns + self.offset_ns
        if self.pauses:
            self.monotonic_ns += self.pauses.pop()
        return value


def control(clocks: Clocks, times_ns: list[int], hardware_ns: list[int] | None = None) -> npt.NDArray[np.int64]:
    """What the kernel gives with frames that arrive at these times, by the clock as it is set now."""
    made = np.zeros((len(times_ns), 8), np.int64)
    made[:, 2], made[:, 3] = np.divmod(np.array(times_ns) + clocks.offset_ns, SECOND)
    if hardware_ns is not None:
        made[:, 6], made[:, 7] = np.divmod(np.array(hardware_ns), SECOND)
    return made


@given(st.lists(st.tuples(st.integers(-(10**15), 10**15), st.integers(1, 10**8)), min_size=1, max_size=20))
def test_no_step_moves_a_stamp_out_of_its_poll(steps: list[tuple[int, int]]) -> None:
    with pytest.MonkeyPatch.context() as monkeypatch:
        clocks = Clocks(monkeypatch)
        stamper = Stamper()
        last_ns = np.int64(clocks.monotonic_ns)
        for step_ns, pause_ns in steps:
            before_ns = clocks.monotonic_ns
            arrived = control(clocks, [before_ns + pause_ns // 3, before_ns + pause_ns // 2])
            clocks.monotonic_ns += pause_ns
            clocks.offset_ns += step_ns
            read = stamper.read(arrived)
            window_ns = clocks.monotonic_ns - int(last_ns)  # every time in it is a possible one
            assert (np.diff(np.append(last_ns, read)) >= 0).all()
            last_ns = read[-1]
            assert last_ns <= clocks.monotonic_ns
            if abs(step_ns) > window_ns + receiving._SLEW_NS or step_ns == 0:
                assert read.tolist() == [before_ns + pause_ns // 3, before_ns + pause_ns // 2]


def test_frames_before_and_after_a_step_in_one_batch(monkeypatch: pytest.MonkeyPatch) -> None:
    clocks = Clocks(monkeypatch)
    stamper = Stamper()
    start_ns = clocks.monotonic_ns
    early = control(clocks, [start_ns + 1_000_000])
    clocks.offset_ns -= 3600 * SECOND
    late = control(clocks, [start_ns + 2_000_000])
    clocks.monotonic_ns += 5_000_000
    assert stamper.read(np.concatenate([early, late])).tolist() == [start_ns + 1_000_000, start_ns + 2_000_000]


def test_frames_that_came_before_the_kernel_stamped_are_not_later_than_those_after_them(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    clocks = Clocks(monkeypatch)
    stamper = Stamper()
    start_ns = clocks.monotonic_ns
    when_read = [start_ns + 5_000_000, start_ns + 5_001_000]
    when_arrived = [start_ns + 1_000_000, start_ns + 2_000_000]
    clocks.monotonic_ns += 6_000_000
    expected = [when_arrived[0], when_arrived[0], *when_arrived]
    assert stamper.read(control(clocks, when_read + when_arrived)).tolist() == expected


def test_a_pause_between_two_clock_reads_bends_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    clocks = Clocks(monkeypatch)
    stamper = Stamper()
    arrived_ns = clocks.monotonic_ns + 1_000_000
    arrived = control(clocks, [arrived_ns])
    clocks.monotonic_ns += 50_000_000
    clocks.pauses = [10_000_000]
    assert stamper.read(arrived).tolist() == [arrived_ns]


def test_hardware_stamps_are_on_our_clock_whatever_happens_to_the_wall_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    clocks = Clocks(monkeypatch)
    stamper = Stamper(hardware=True)
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
        errors.append(stamper.read(arrived) - sent)
    settled = np.abs(np.concatenate(errors[500:]))
    assert settled.max() < 150_000


def test_a_frame_without_any_stamp_is_as_old_as_its_poll(monkeypatch: pytest.MonkeyPatch) -> None:
    clocks = Clocks(monkeypatch)
    stamper = Stamper(hardware=True)
    clocks.monotonic_ns += 5_000_000
    assert stamper.read(np.zeros((2, 8), np.int64)).tolist() == [clocks.monotonic_ns] * 2
