"""The axis on which a recording is ordered, and what the other clocks of the machine do meanwhile.

Everything is ordered by CLOCK_MONOTONIC, which never jumps. What MCAP tools see as time is that clock plus one number
for the whole recording: what made it the wall clock when the recording began. The wall clock of each moment is only a
label beside it.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, NamedTuple

from skinware.realtime import NS_PER_S

_READINGS = 3
_LEAST_STEP_NS = NS_PER_S // 20
"""Smaller steps than a busy machine may put between two readings."""

STEPPED, SUSPENDED = "clock_stepped", "suspended"
"""Events of no service."""


class Clocks(NamedTuple):
    """Clocks of the machine at the same moment, ns.

    Attributes:
        monotonic_ns: CLOCK_MONOTONIC, the time of frames.
        realtime_ns: CLOCK_REALTIME, the wall clock.
        boottime_ns: CLOCK_BOOTTIME: the first one, and how long the machine was suspended since it started.
    """

    monotonic_ns: int
    realtime_ns: int
    boottime_ns: int


def read_clocks() -> Clocks:
    """Read all clocks, of several readings the one that took the shortest time."""
    return min((_reading() for _ in range(_READINGS)), key=lambda reading: reading[0])[1]


def _reading() -> tuple[int, Clocks]:
    """How long it took to read the clocks, and what they were."""
    before_ns = time.monotonic_ns()
    realtime_ns, boottime_ns = time.time_ns(), time.clock_gettime_ns(time.CLOCK_BOOTTIME)
    after_ns = time.monotonic_ns()
    return after_ns - before_ns, Clocks((before_ns + after_ns) // 2, realtime_ns, boottime_ns)


class TimeAxis:
    """The times of a recording's messages.

    Args:
        read: gives the clocks.

    Attributes:
        clocks: when they were read last.
    """

    def __init__(self, read: Callable[[], Clocks] = read_clocks) -> None:
        self._read = read
        self.clocks: Clocks = read()
        self._origin_ns = self.clocks.realtime_ns - self.clocks.monotonic_ns

    def log_ns(self, monotonic_ns: int) -> int:
        """Return the time by which a message is ordered: ns since 1970, if the wall clock had never been set since."""
        return monotonic_ns + self._origin_ns

    def wall_ns(self, monotonic_ns: int) -> int:
        return monotonic_ns + self.clocks.realtime_ns - self.clocks.monotonic_ns

    def look(self) -> list[dict[str, Any]]:
        """Read the clocks again.

        Returns:
            An event if the machine was suspended meanwhile, and one if the wall clock was set.
        """
        before, now = self.clocks, self._read()
        self.clocks = now
        passed_ns = now.monotonic_ns - before.monotonic_ns
        suspended_ns = now.boottime_ns - before.boottime_ns - passed_ns
        stepped_ns = now.realtime_ns - before.realtime_ns - passed_ns - suspended_ns
        found = [(SUSPENDED, "for_ns", suspended_ns), (STEPPED, "by_ns", stepped_ns)]
        return [
            {"event": event, "service": "", "time_ns": now.monotonic_ns, name: value_ns}
            for event, name, value_ns in found
            if abs(value_ns) >= _LEAST_STEP_NS
        ]
