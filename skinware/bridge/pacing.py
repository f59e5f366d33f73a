"""Whether frames are pushed or pulled: pure decisions from what was seen.

Pushed frames are the youngest where the link is fast enough. Where it is not, they wait in queues, and grow old there;
then each is asked for: the newest, one at a time, and the link is never given more than it takes.
"""

from __future__ import annotations

from collections import deque

from skinware.realtime import NS_PER_S

_LOOK_NS = 2 * NS_PER_S
_EVERY_NS = NS_PER_S // 4
_OLD_PERIODS = 3
_LEAST_OLD_NS = 30_000_000
_WITHOUT_PERIOD_NS = 100_000_000
_ENOUGH = 0.95
_FIRST_RETRY_NS, _LAST_RETRY_NS = 10 * NS_PER_S, 320 * NS_PER_S


class Pacing:
    """The mode of one service.

    Args:
        period_ns: of its writer, 0 if it has none.
        fixed: ``push`` or ``pull``, if a person wants it; None: it finds out.

    Attributes:
        pulls: frames are to be asked for.
    """

    def __init__(self, period_ns: int, fixed: str | None = None) -> None:
        self._period_ns, self._fixed = period_ns, fixed
        self.pulls: bool = fixed == "pull"
        self._seen: deque[tuple[int, int, int]] = deque()  # (when, age, count of the robot)
        self._retry_ns = _FIRST_RETRY_NS
        self._since_ns = self._looked_ns = 0

    @property
    def mode(self) -> str:
        """``push`` or ``pull``."""
        return "pull" if self.pulls else "push"

    def saw(self, at_ns: int, age_ns: int, count: int) -> bool:
        """A frame came; whether that changes the mode.

        Args:
            at_ns: now.
            age_ns: since it was published on the robot.
            count: the robot's number of it, over generations.
        """
        if self._fixed:
            return False
        self._since_ns = self._since_ns or at_ns
        self._seen.append((at_ns, age_ns, count))
        while at_ns - self._seen[0][0] > _LOOK_NS:
            self._seen.popleft()
        if at_ns - self._since_ns < _LOOK_NS or at_ns - self._looked_ns < _EVERY_NS:
            return False
        self._looked_ns = at_ns
        return self._should_push(at_ns) if self.pulls else self._should_pull(at_ns)

    def _should_pull(self, at_ns: int) -> bool:
        ages = sorted(age for _, age, _ in self._seen)
        limit_ns = max(_OLD_PERIODS * self._period_ns, _LEAST_OLD_NS) if self._period_ns else _WITHOUT_PERIOD_NS
        if ages[len(ages) // 2] <= limit_ns:
            return False
        if at_ns - self._since_ns < 2 * _LOOK_NS:  # pushing was tried again, and at once was too much again
            self._retry_ns = min(2 * self._retry_ns, _LAST_RETRY_NS)
        return self._change(at_ns, True)

    def _should_push(self, at_ns: int) -> bool:
        """The link takes nearly all there is."""
        if at_ns - self._since_ns < self._retry_ns:
            return False
        published = self._seen[-1][2] - self._seen[0][2]
        if published <= 0 or (len(self._seen) - 1) / published < _ENOUGH:
            return False
        return self._change(at_ns, False)

    def _change(self, at_ns: int, pulls: bool) -> bool:
        self.pulls = pulls
        self._since_ns = at_ns
        self._seen.clear()
        return True
