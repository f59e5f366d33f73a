"""Order a recording by CLOCK_MONOTONIC, and notice what the other clocks of the machine do.

CLOCK_MONOTONIC never jumps. MCAP tools see it plus one constant: the difference to the wall clock when the recording
began. The wall clock of each message is only a label beside it.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, NamedTuple

from skinware.realtime import NS_PER_S

_READINGS = 3
_LEAST_STEP_NS = NS_PER_S // 20  # a busy machine may delay a reading by less

STEPPED, SUSPENDED = "clock_stepped", "suspended"
"""Events that belong to no service."""


class Clocks(NamedTuple):
    """Clocks of the machine at one moment, ns.

    Attributes:
        realtime_ns: CLOCK_REALTIME, the wall clock.
        boottime_ns: CLOCK_BOOTTIME: CLOCK_MONOTONIC plus the time in which the machine was suspended.
    """

    monotonic_ns: int
    realtime_ns: int
    boottime_ns: int


def read_clocks() -> Clocks:
    """Read all clocks a few times, and return the reading that took the shortest time."""
    readings = []
    for _ in range(_READINGS):
        before_ns = time.monotonic_ns()
        realtime_ns, boottime_ns = time.time_ns(), time.clock_gettime_ns(time.CLOCK_BOOTTIME)
        after_ns = time.monotonic_ns()
        readings.append((after_ns - before_ns, Clocks((before_ns + after_ns) // 2, realtime_ns, boottime_ns)))
    return min(readings)[1]


class TimeAxis:
    """The times of a recording's messages; ``clocks``: the last reading."""

    def __init__(self, read: Callable[[], Clocks] = read_clocks) -> None:
        self._read = read
        self.clocks: Clocks = read()
        self._origin_ns = self.clocks.realtime_ns - self.clocks.monotonic_ns

    def log_ns(self, monotonic_ns: int) -> int:
        """Return the time that orders a message: ns since 1970 by a wall clock that was never set since."""
        return monotonic_ns + self._origin_ns

    def wall_ns(self, monotonic_ns: int) -> int:
        return monotonic_ns + self.clocks.realtime_ns - self.clocks.monotonic_ns

    def look(self) -> list[dict[str, Any]]:
        """Read the clocks again. Return an event if the machine was suspended, and one if the wall clock was set."""
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
