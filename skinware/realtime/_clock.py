"""CLOCK_MONOTONIC in int64 ns, loops that keep absolute deadlines, and short turns of the interpreter beside them."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from skinware.errors import ConfigurationError

NS_PER_S = 1_000_000_000

WAIT_SLICE_NS = 50_000_000
"""No wait in this package lasts longer than this without looking around (signals, close, a dead peer)."""


def now_ns() -> int:
    """CLOCK_MONOTONIC in ns: the time base of every frame."""
    return time.monotonic_ns()


def boot() -> str:
    """Return which start of the machine CLOCK_MONOTONIC counts from: a number that no other start has."""
    return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()


def period_ns(rate_hz: float) -> int:
    """Period of a rate.

    Raises:
        ConfigurationError: the rate is not above 0 and at most 100 kHz.
    """
    if not 0 < rate_hz <= 100_000:
        raise ConfigurationError(f"rate of {rate_hz} Hz: give more than 0 and at most 100000")
    return max(1, round(NS_PER_S / rate_hz))


class Periodic:
    """Absolute deadlines of a periodic loop: no drift, and no catch-up burst after a late period.

    Attributes:
        missed: periods that were skipped because the loop came back too late.
        deadline_ns: the next deadline.
    """

    def __init__(self, rate_hz: float, start_ns: int | None = None) -> None:
        self.period_ns: int = period_ns(rate_hz)
        self.deadline_ns: int = (now_ns() if start_ns is None else start_ns) + self.period_ns
        self.missed: int = 0

    def advance(self, time_ns: int) -> None:
        """Move to the first deadline after ``time_ns``; those that are jumped over count as missed."""
        late = max(0, time_ns - self.deadline_ns) // self.period_ns
        self.missed += late
        self.deadline_ns += (late + 1) * self.period_ns

    def wait(self, stopped: Callable[[], bool] = lambda: False) -> bool:
        """Sleep until the deadline, then move on to the next one.

        Args:
            stopped: asked at least every 50 ms; True ends the wait.

        Returns:
            False if ``stopped`` said so before the deadline.
        """
        while True:
            if stopped():
                return False
            remaining_ns = self.deadline_ns - now_ns()
            if remaining_ns <= 0:
                break
            time.sleep(min(remaining_ns, WAIT_SLICE_NS) / NS_PER_S)
        self.advance(now_ns())
        return True

    def __iter__(self) -> Iterator[int]:
        """Yield 0, 1, 2 ... one per period."""
        count = 0
        while self.wait():
            yield count
            count += 1


TURN_S = 1e-4
_before_s: list[float] = []


@contextmanager
def short_turns() -> Iterator[None]:
    """Let no thread keep the interpreter for longer than ``TURN_S`` when another wants it; Python's default is 5 ms.

    Beside a thread that computes, whoever lets go of the interpreter waits that long for it: a reader after each sleep,
    a driver dozens of times for a batch (numpy lets go for arrays of some length, and so do system calls). That is too
    long for a ring of 8 slots at 1 kHz, or the receive buffer of a fast bus (docs/benchmarks.md). It holds for the
    whole process, until the last one has ended.
    """
    _before_s.append(sys.getswitchinterval())
    sys.setswitchinterval(min(TURN_S, _before_s[-1]))
    try:
        yield
    finally:
        sys.setswitchinterval(_before_s.pop())
