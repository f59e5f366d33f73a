"""Whether this process was attending: what falls silent while nobody listens has not fallen silent."""

from __future__ import annotations

import logging
import time
from typing import NamedTuple

from skinware.realtime import NS_PER_S, now_ns

log: logging.Logger = logging.getLogger("skinware.driver")

_HELD_UP_NS = NS_PER_S // 10
"""Half of the shortest time after which anything counts as silent."""
_WORTH_A_LINE_NS = NS_PER_S


class HoldUp(NamedTuple):
    """A time in which this process did nothing.

    Attributes:
        since_ns: when it was last known to attend, CLOCK_MONOTONIC ns.
        asleep_ns: for how long the machine was suspended, which CLOCK_MONOTONIC does not count.
    """

    since_ns: int
    asleep_ns: int


class Attention:
    """Notices when this process was stopped, had no processor time, or slept with its machine."""

    def __init__(self) -> None:
        self._looked_ns = now_ns()
        self._slept_ns = _slept_ns()

    def look(self, due_ns: int | None) -> HoldUp | None:
        """Look at the clocks.

        Args:
            due_ns: when the event loop should have looked at the latest, CLOCK_MONOTONIC ns; None: at no certain time.

        Returns:
            What has held this process up since it last looked; None: nothing worth the name.
        """
        time_ns, slept_ns, since_ns = now_ns(), _slept_ns(), self._looked_ns
        late_ns = 0 if due_ns is None else time_ns - max(due_ns, since_ns)
        asleep_ns = slept_ns - self._slept_ns
        self._looked_ns, self._slept_ns = time_ns, slept_ns
        if max(late_ns, asleep_ns) <= _HELD_UP_NS:
            return None
        if asleep_ns > _HELD_UP_NS:
            log.warning("this machine was suspended for %.1f s: silence is counted from now on", asleep_ns / NS_PER_S)
        elif late_ns > _WORTH_A_LINE_NS:
            log.warning(
                "this process was held up for %.1f s (stopped, or without processor time): silence is counted from"
                " now on",
                late_ns / NS_PER_S,
            )
        return HoldUp(since_ns, max(0, asleep_ns))


def _slept_ns() -> int:
    """How long the machine has been suspended since it booted."""
    return time.clock_gettime_ns(time.CLOCK_BOOTTIME) - time.clock_gettime_ns(time.CLOCK_MONOTONIC)
