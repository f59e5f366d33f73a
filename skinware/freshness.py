"""What is fresh: status, the driver's life and age together, in one place for snapshots, views, recordings and bridges.

A status alone cannot tell: it is as of the frame, and a driver that hangs leaves it at 0.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

_PERIODS = 3
_LEAST_NS = 200_000_000
_WITHOUT_PERIOD_NS = 1_000_000_000
AHEAD_NS = 200_000_000
"""How far ahead of the clock a stamp may be: clocks of two machines differ a little. Beyond it, no age is known."""
LONGEST_PERIOD_S = 86_400.0
"""That anything may have: a day."""


def age_limit_ns(period_ns: int) -> int:
    """How old data may be and still count as fresh: three periods, and at least 0.2 s.

    A driver marks sensors ``STALE`` after the same time. :meth:`skinware.Structure.age_limits_ns` has that of each
    sensor.

    Args:
        period_ns: nominal time between two updates of the data; 0 if it has none: then 1 s.
    """
    return max(_PERIODS * period_ns, _LEAST_NS) if period_ns > 0 else _WITHOUT_PERIOD_NS


def is_fresh(
    status: npt.NDArray[np.uint8],
    time_ns: npt.NDArray[np.int64],
    *,
    at_ns: int | npt.NDArray[np.int64],
    max_age_ns: int | npt.NDArray[np.int64],
    alive: bool = True,
) -> npt.NDArray[np.bool_]:
    """Which of n sensors are fresh.

    Args:
        status: (..., n) bits of :class:`skinware.Status`.
        time_ns: (..., n) time of each sensor's data (that of its update group), 0: never seen.
        at_ns: the moment at which they are looked at, on the clock of ``time_ns``.
            Stamps of more than 0.2 s later are not fresh.
        max_age_ns: the age beyond which nothing is fresh, or (n,) that of each sensor; see ``age_limit_ns``.
        alive: the driver lived when the frame was taken.

    Returns:
        (..., n) bool.
    """
    if not alive:
        return np.zeros(status.shape, bool)
    is_recent = (time_ns >= at_ns - max_age_ns) & (time_ns <= at_ns + AHEAD_NS)
    fresh: npt.NDArray[np.bool_] = (status == 0) & (time_ns > 0) & is_recent
    return fresh
