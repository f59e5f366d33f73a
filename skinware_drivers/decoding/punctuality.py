"""Whether frames come when they should: what tells cycles apart where no counter does.

Two halves of different cycles come within the maximum age of each other only if the first was held up by a period less
that age, or longer. So a frame that comes *late* (so much later after the frame of its kind before) may be such a half;
and one that comes *soon* (within the maximum age of that frame) is of a sender that catches up: two of its cycles fit
into that age. A cycle of frames that come soon is not joined, nor one of which all come late: what was lost between
cannot be known. (In an order that is not given, it is not joined if one of them is late.)
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from skinware.realtime import NS_PER_S
from skinware_drivers.layout import Cycle

Indices = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]

_NEVER_NS = -(1 << 62)


class Punctuality:
    """When each kind of frame of each module came last, and how long after the one before.

    Args:
        cycle: what the frames are members of.
        period_s: nominal time from one cycle of a module to the next; modules that are slower all the time may be.
        n_modules: number of modules.
    """

    def __init__(self, cycle: Cycle, period_s: float, n_modules: int) -> None:
        self._n = len(cycle.members)
        self._period_ns = round(period_s * NS_PER_S)
        self._soon_ns = round(cycle.maximum_age_s * NS_PER_S)
        self._reach_ns = round(cycle.reach_s * NS_PER_S)
        self._last_ns = np.full(n_modules * self._n, _NEVER_NS, np.int64)
        self._spacing_ns = np.full(n_modules * self._n, self._period_ns, np.int64)

    def judge(self, kind: Indices, time_ns: Indices) -> tuple[Flags, Flags]:
        """Tell which frames come soon and which late.

        Args:
            kind: (m,) module * members + place in the cycle, of each frame, in order of arrival.
            time_ns: (m,) stamps.

        Returns:
            (m,) bool: soon; (m,) bool: late.
        """
        order, follows, spacing_ns = self._spacings(kind, time_ns)
        usual_ns = np.where(follows, np.roll(spacing_ns, 1), self._spacing_ns[kind[order]])
        soon, late = np.empty(len(kind), bool), np.empty(len(kind), bool)
        soon[order] = spacing_ns <= self._soon_ns
        late[order] = spacing_ns >= 2 * np.maximum(usual_ns, self._period_ns) - self._reach_ns
        return soon, late

    def remember(self, kind: Indices, time_ns: Indices) -> None:
        """These frames have come, in this order, and will not be judged again."""
        order, _, spacing_ns = self._spacings(kind, time_ns)
        self._spacing_ns[kind[order]] = spacing_ns
        self._last_ns[kind[order]] = time_ns[order]

    def forget(self, modules: Indices) -> None:
        """These modules have restarted, and their time with them."""
        kinds = (modules[:, None] * self._n + np.arange(self._n)).reshape(-1)
        self._last_ns[kinds] = _NEVER_NS
        self._spacing_ns[kinds] = self._period_ns

    def _spacings(self, kind: Indices, time_ns: Indices) -> tuple[Indices, Flags, Indices]:
        """The frames kind by kind, which of them follow one of the same kind, and the time since that, ns."""
        order = np.argsort(kind, kind="stable")
        kind, time_ns = kind[order], time_ns[order]
        follows = np.zeros(len(kind), bool)
        follows[1:] = kind[1:] == kind[:-1]
        before_ns = np.where(follows, np.roll(time_ns, 1), self._last_ns[kind])
        return order, follows, np.where(before_ns == _NEVER_NS, self._period_ns, time_ns - before_ns)
