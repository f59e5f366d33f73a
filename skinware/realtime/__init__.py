"""Time, periods and scheduling: CLOCK_MONOTONIC in ns, absolute deadlines, and what keeps a loop on time.

::

    from skinware.realtime import Periodic, Profile

    Profile.fifo(50, cpus=[1]).apply()  # before any other thread is started
    for _ in Periodic(rate_hz=1000):
        ...
"""

from skinware.realtime._clock import NS_PER_S, TURN_S, WAIT_SLICE_NS, Periodic, boot, now_ns, period_ns, short_turns
from skinware.realtime._profile import Profile, Refusal, cpus_from_text

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
