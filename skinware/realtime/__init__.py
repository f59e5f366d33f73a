"""Time, periods and scheduling: CLOCK_MONOTONIC in ns, absolute deadlines, and what keeps a loop on time.

::

    from skinware.realtime import Periodic, Profile

    Profile.fifo(50, cpus=[1]).apply()  # before any other thread is started
    for _ in Periodic(rate_hz=1000):
        ...
"""

from skinware.realtime._clock import NS_PER_S, WAIT_SLICE_NS, Periodic, boot, now_ns, period_ns
from skinware.realtime._cpus import cpus_from_text
from skinware.realtime._kernel import Refusal
from skinware.realtime._profile import Profile
from skinware.realtime._turns import TURN_S, short_turns

__all__ = [
    "NS_PER_S",
    "TURN_S",
    "WAIT_SLICE_NS",
    "Periodic",
    "Profile",
    "Refusal",
    "boot",
    "cpus_from_text",
    "now_ns",
    "period_ns",
    "short_turns",
]
