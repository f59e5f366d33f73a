"""Judge whether frames come in time, to separate cycles that have no counter.

Two halves of different cycles come within the maximum age of each other only if the first was held up by at least a
period minus that age. So each frame is judged by the time since the frame of its kind before:

* within the maximum age: the sender catches up, and two of its cycles fit into that age;
* about a period: in time, up to the delay that such a half would need;
* about two or more periods: frames before were lost, or this one was held up;
* otherwise: this one was held up.

Frames are a cycle if none comes soon or was held up, and at least one comes in time. (If the order is not given, all
must come in time: there, the end of a cycle and the beginning of the next look like one.)
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from skinware.realtime import NS_PER_S
from skinware_drivers.layout import Cycle

Indices = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]

_NEVER_NS = -(1 << 62)
_MARGIN = 8
"""One part in so many of the time by which a frame may be early or late is left for the spacing inside a cycle."""


class Judgement(NamedTuple):
    """How frames come, compared with those of their kind before.

    Attributes:
        soon: (m,) bool: within the maximum age of the one before.
        held_up: (m,) bool: too late for that.
        doubtful: (m,) bool: held up, or after one that was lost.
        spacing_ns: (m,) int64, time since the frame of the same kind before.
    """

    soon: Flags
    held_up: Flags
    doubtful: Flags
    spacing_ns: Indices


class Punctuality:
    """When each kind of frame of each module came last, and how long after the one before.

    Args:
        cycle: of the frames.
        period_s: nominal time from one cycle of a module to the next; a module may always be slower.
        n_modules: number of modules.
    """

    def __init__(self, cycle: Cycle, period_s: float, n_modules: int) -> None:
        self._n = len(cycle.members)
        self.all_as_they_should = cycle.order != "given"
        self.period_ns = round(period_s * NS_PER_S)
        self.reach_ns = round(cycle.reach_s * NS_PER_S)
        self.margin_ns = (self.period_ns - self.reach_ns) // _MARGIN
        self.soon_ns = round(cycle.maximum_age_s * NS_PER_S) + self.margin_ns
        self.last_ns = np.full(n_modules * self._n, _NEVER_NS, np.int64)
        self.spacings_ns = np.full(n_modules * self._n, self.period_ns, np.int64)

    def judge(self, kind: Indices, time_ns: Indices) -> Judgement:
        """Judge frames.

        Args:
            kind: (m,) module * members + place in the cycle, of each frame, in order of arrival.
            time_ns: (m,) stamps.
        """
        order = np.argsort(kind, kind="stable")
        kind, time_ns = kind[order], time_ns[order]
        follows = np.flatnonzero(kind[1:] == kind[:-1]) + 1
        before_ns, usual_ns = self.last_ns[kind], self.spacings_ns[kind]
        before_ns[follows] = time_ns[follows - 1]
        spacing_ns = time_ns - before_ns
        spacing_ns[before_ns == _NEVER_NS] = self.period_ns
        usual_ns[follows] = spacing_ns[follows - 1]
        soon = spacing_ns <= self.soon_ns
        late = spacing_ns >= 2 * np.maximum(usual_ns, self.period_ns) - self.reach_ns - self.margin_ns
        held_up = late
        if not self.all_as_they_should and late.any():
            beside_ns = np.abs((spacing_ns + self.period_ns // 2) % self.period_ns - self.period_ns // 2)
            held_up = late & (2 * beside_ns >= self.period_ns - self.reach_ns)
        back = np.empty_like(order)
        back[order] = np.arange(len(order))
        return Judgement(soon[back], held_up[back], late[back], spacing_ns[back])

    def remember(self, kind: Indices, time_ns: Indices, spacing_ns: Indices) -> None:
        """Remember frames that came in this order and are not judged again."""
        self.spacings_ns[kind] = spacing_ns
        self.last_ns[kind] = time_ns

    def forget(self, modules: Indices) -> None:
        kinds = (modules[:, None] * self._n + np.arange(self._n)).reshape(-1)
        self.last_ns[kinds] = _NEVER_NS
        self.spacings_ns[kinds] = self.period_ns
