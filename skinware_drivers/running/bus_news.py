"""Tells people once what happened to a bus, and not a thousand times of a bus that comes and goes."""

from __future__ import annotations

import logging
from collections.abc import Callable

from skinware.realtime import NS_PER_S, now_ns
from skinware.status import BusReason

log: logging.Logger = logging.getLogger("skinware.driver")

LINES_AT_ONCE = 5
"""Lines about one bus before it has to be brief."""
LINE_EVERY_S = 10.0
"""From then on there is one line in this time, as long as there is anything to tell."""

WORDS = {
    BusReason.NOTHING_HEARD: "nothing is heard any more",
    BusReason.BUS_OFF: "bus-off: the controller met too many errors and left the wire (short circuit, another bit"
    " rate?); it is back by itself if restart-ms is set, else after: ip link set INTERFACE type can restart",
    BusReason.ERROR_PASSIVE: "error-passive: many errors (bad wires, another bit rate, nobody else on the wire?)",
    BusReason.ERROR_WARNING: "error-warning: more errors than there should be (termination, wires?)",
    BusReason.OVERFLOW: "the controller lost frames: this machine did not fetch them in time",
    BusReason.NO_ACKNOWLEDGEMENT: "nobody acknowledges what is sent (wires, power, another bit rate?)",
    BusReason.BUS_ERRORS: "broken frames are heard (another bit rate, termination, wires?)",
}
"""What a reason means, for people; the others come with words of their own."""


def reason_text(reason: BusReason) -> str:
    """A reason's name as people write it: ``bus-off``."""
    return reason.name.lower().replace("_", "-")


class Allowance:
    """How often something may be told: a few times at once, then now and then.

    Args:
        clock: CLOCK_MONOTONIC ns.
    """

    def __init__(self, clock: Callable[[], int] = now_ns) -> None:
        self._clock = clock
        self._interval_ns = round(LINE_EVERY_S * NS_PER_S)
        self._savings_ns = (LINES_AT_ONCE - 1) * self._interval_ns
        self._free_at_ns = clock() - self._savings_ns

    def take(self) -> bool:
        """Whether a line may be told now; it then is."""
        time_ns = self._clock()
        if time_ns < self._free_at_ns:
            return False
        self._free_at_ns = max(self._free_at_ns, time_ns - self._savings_ns) + self._interval_ns
        return True


class BusNews:
    """What is told of one bus, with a limit.

    The last change of a burst is always told, late if need be, with the number of those before it that were not.

    Args:
        clock: CLOCK_MONOTONIC ns.
    """

    def __init__(self, clock: Callable[[], int] = now_ns) -> None:
        self._allowance = Allowance(clock)
        self._untold = ""
        self._kept_back = 0

    def tell(self, text: str) -> None:
        if self._untold:
            self._kept_back += 1
        self._untold = text
        self.catch_up()

    def catch_up(self) -> None:
        """Tell what was kept back, if its time has come; to be called now and then."""
        if not self._untold or not self._allowance.take():
            return
        before = f" ({self._kept_back} changes before this one were not told)" if self._kept_back else ""
        log.warning("%s%s", self._untold, before)
        self._untold, self._kept_back = "", 0
