"""How often in a row something failed, and until when it is left alone."""

from __future__ import annotations

from skinware.realtime import NS_PER_S
from skinware_drivers.running.guard import Backoff

_PATIENT_TIMES = 3
_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.25, 2.0


class Trouble:
    """One thing that fails.

    Attributes:
        times: in a row.
        until_ns: when it may be tried again.
    """

    def __init__(self) -> None:
        self.times = 0
        self.until_ns = 0
        self._pauses = Backoff(_FIRST_PAUSE_S, _LONGEST_PAUSE_S)

    def again(self, time_ns: int) -> None:
        self.times += 1
        if self.times >= _PATIENT_TIMES:
            self.until_ns = time_ns + round(self._pauses.next_s() * NS_PER_S)
