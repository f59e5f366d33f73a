"""Decide whether frames are pushed or pulled, and how many are asked for at once, from ages alone.

On a fast link pushed frames are the youngest. On a slow one they grow old in queues; then the newest frame is asked
for, packed, and only as many at once as the link takes. A probe is a question for a frame in the form in which it would
be pushed: the time that its answer takes beyond an empty answer shows how fast the link is.

The delay of the link itself says nothing for or against a mode. A link is judged by the time that frames wait in its
queues: their age minus the least age lately. As many questions are open as a round trip has periods, so that each frame
finds one.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field

from skinware.realtime import NS_PER_S, now_ns

_LOOK_NS = 2 * NS_PER_S
_EVERY_NS = NS_PER_S // 4
_OLD_PERIODS = 3
_LEAST_OLD_NS = 30_000_000
_WITHOUT_PERIOD_NS = 100_000_000
_SHARE = 0.5
"""Share of the period that a frame may take on its way if it is to be pushed."""
_PROBES = 3
"""Probes of which the fastest counts: the others may have waited for something else."""
_SHARE_OF_ROUND_TRIP = 0.25
"""Share of a round trip that frames may wait: on a long link they come unevenly."""
_MOST_SPARE_NS = 300_000_000
"""Questions that wait on the robot end after half a second there."""
_FEW = 8
_KEPT_NS = 30 * NS_PER_S
"""How long the least age is remembered: clocks drift, and routes change."""
MOST_OPEN, _LEAST_PERIOD_NS = 512, 1_000_000
"""Questions for frames; a shorter period does not add more."""
_LATE_LOOKS, _SHORTEST_REST, _LONGEST_REST = 3, 4, 128
"""Looks in a row at which frames are late before fewer are asked for, since TCP begins slowly and machines are busy at
times; and the number of looks before more are asked for again."""
_ONE_FLIGHT, _LONG_NS = 14_000, 30_000_000
"""Bytes that TCP sends before it waits for an acknowledgement; the shortest round trip that counts as long."""
_FIRST_RETRY_NS, _LAST_RETRY_NS = 10 * NS_PER_S, 320 * NS_PER_S


@dataclass
class Pulls:
    """Questions for frames that wait for an answer: by number, and for a probe, the time until which it may come."""

    count: int = 0
    open: dict[int, int] = field(default_factory=dict)
    probe_until_ns: int = 0

    def begin(self, timeout_s: float) -> int:
        self.count += 1
        self.open[self.count] = now_ns() + round(timeout_s * NS_PER_S)
        return self.count

    def end(self, number: int, is_answered: bool) -> bool:
        """Close a question; return whether it was open.

        Answers come in order: an answer also closes earlier questions, which the link has dropped.
        """
        is_open = self.open.pop(number, None) is not None
        if is_answered:
            self.open = {later: until_ns for later, until_ns in self.open.items() if later > number}
        return is_open


class _QueueTimes:
    """Estimates from ages how long frames wait in queues."""

    def __init__(self) -> None:
        self.ages: deque[tuple[int, int]] = deque()  # (when, age)
        self._least: deque[tuple[int, int]] = deque()  # (when, least age), at looks
        self.since_ns: int = 0

    def add(self, at_ns: int, age_ns: int, kept_ns: int) -> None:
        self.since_ns = self.since_ns or at_ns
        self.ages.append((at_ns, age_ns))
        while at_ns - self.ages[0][0] > kept_ns:
            self.ages.popleft()

    def look(self, at_ns: int) -> int:
        """Return the time that all but a few of the frames waited.

        In a queue that does not drain, all frames wait. Behind a packet that TCP sends again only some do, and fewer
        questions would not help them.
        """
        ages = sorted(age for _, age in self.ages)
        self._least.append((at_ns, ages[0]))
        while at_ns - self._least[0][0] > _KEPT_NS:
            self._least.popleft()
        return ages[len(ages) // _FEW] - min(age for _, age in self._least)


class Pacing:
    """The mode of one service. It begins with pulling one frame at a time, which fills no queue.

    Args:
        period_ns: of the writer, 0 if it has none.
        fixed: ``push`` or ``pull`` if a person chose it; None: the mode follows the link.
        size: of a frame as it would be pushed, bytes.
    """

    def __init__(self, period_ns: int, fixed: str | None = None, size: int = 0) -> None:
        self._period_ns, self.fixed, self._size = max(0, period_ns), fixed, size
        self.pulls: bool = fixed != "push"
        self.open: int = 1
        self._queue = _QueueTimes()
        self._took: list[int] = []
        self._retry_ns = _FIRST_RETRY_NS
        self._looked_ns = self._probe_ns = 0
        self._late = 0  # looks in a row at which frames waited
        self._rest, self._next_rest = 0, _SHORTEST_REST  # looks before more are asked for at once

    @property
    def mode(self) -> str:
        return "pull" if self.pulls else "push"

    def wants_probe(self, at_ns: int, round_trip_ns: int) -> bool:
        """Return whether to probe the link now.

        On a long link a large frame holds up the next ones for several round trips, and pulling is as good as pushing.
        """
        may_probe = self._size <= _ONE_FLIGHT or round_trip_ns <= _LONG_NS
        return self.pulls and self.fixed is None and may_probe and at_ns >= self._probe_ns

    def probed(self, at_ns: int, took_ns: int) -> bool:
        """Take the time of a probe beyond that of an empty answer; return whether the mode changed."""
        most_ns = _SHARE * (self._period_ns or _WITHOUT_PERIOD_NS)
        self._took.append(took_ns)
        if len(self._took) < _PROBES and took_ns > most_ns:
            return False
        fastest_ns, self._took = min(self._took), []
        if not self.pulls or fastest_ns > most_ns:
            self._retry_later(at_ns)
            return False
        self.pulls, self._queue = False, _QueueTimes()
        return True

    def arrived(self, at_ns: int, age_ns: int, round_trip_ns: int) -> bool:
        """Take the age of a frame that came; return whether the mode changed.

        Args:
            age_ns: since its publication on the robot.
            round_trip_ns: the shortest of the link.
        """
        if self.pulls:
            self._adjust_open(at_ns, age_ns, round_trip_ns)
            return False
        if self.fixed:
            return False
        self._queue.add(at_ns, age_ns, _LOOK_NS)
        if at_ns - self._queue.since_ns < _LOOK_NS or at_ns - self._looked_ns < _EVERY_NS:
            return False
        self._looked_ns = at_ns
        old_ns = max(_OLD_PERIODS * self._period_ns, _LEAST_OLD_NS) if self._period_ns else _WITHOUT_PERIOD_NS
        if self._queue.look(at_ns) <= max(old_ns, _SHARE_OF_ROUND_TRIP * round_trip_ns):
            return False
        self._retry_later(at_ns)
        self.pulls, self._queue = True, _QueueTimes()
        return True

    def _retry_later(self, at_ns: int) -> None:
        self._probe_ns = at_ns + self._retry_ns
        self._retry_ns = min(2 * self._retry_ns, _LAST_RETRY_NS)

    def _adjust_open(self, at_ns: int, age_ns: int, round_trip_ns: int) -> None:
        """Open as many questions as a round trip has periods, unless frames wait in queues then.

        As many more wait on the robot for frames to come, since TCP may hold them back for a round trip.
        """
        period_ns = self._period_ns or _WITHOUT_PERIOD_NS
        every_ns = max(_EVERY_NS, 5 * round_trip_ns // 4)
        self._queue.add(at_ns, age_ns, every_ns)
        wanted = math.ceil((round_trip_ns + min(round_trip_ns, _MOST_SPARE_NS)) / max(period_ns, _LEAST_PERIOD_NS)) + 2
        wanted = min(MOST_OPEN, wanted)
        self.open = min(self.open, wanted)
        if at_ns - self._looked_ns < every_ns:
            return
        self._looked_ns = at_ns
        most_ns = max(_OLD_PERIODS * period_ns / 2, _LEAST_OLD_NS / 2, _SHARE_OF_ROUND_TRIP * round_trip_ns)
        is_late = self._queue.look(at_ns) > most_ns
        self._queue.ages.clear()
        self._late = self._late + 1 if is_late else 0
        self._rest -= 1
        if self._late >= _LATE_LOOKS and self.open > 1:
            self.open = max(1, min(self.open - 1, self.open * 3 // 4))
            self._late, self._rest, self._next_rest = 0, self._next_rest, min(2 * self._next_rest, _LONGEST_REST)
        elif not is_late and self.open < wanted and self._rest <= 0:
            is_first = self._next_rest == _SHORTEST_REST
            self.open = min(wanted, 2 * self.open if is_first else self.open + max(1, self.open // 4))
        elif self._rest < -_LONGEST_REST:
            self._next_rest = _SHORTEST_REST
