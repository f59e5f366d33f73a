"""Whether frames are pushed or pulled: pure decisions from what was seen.

Pushed frames are the youngest where the link is fast enough. Where it is not, they wait in queues, and grow old there;
then each is asked for: the newest, one at a time and packed, and the link is never given more than it takes. Which it
is shows a frame that is asked for as it would be pushed: how long it is on its way.
"""

from __future__ import annotations

from collections import deque

from skinware.realtime import NS_PER_S

_LOOK_NS = 2 * NS_PER_S
_EVERY_NS = NS_PER_S // 4
_OLD_PERIODS = 3
_LEAST_OLD_NS = 30_000_000
_WITHOUT_PERIOD_NS = 100_000_000
_SHARE = 0.5
"""Of the period, what a frame may take on its way if it is to be pushed."""
_PROBES = 3
"""The fastest of so many tells: others had to wait for something else."""
_FIRST_RETRY_NS, _LAST_RETRY_NS = 10 * NS_PER_S, 320 * NS_PER_S


class Pacing:
    """The mode of one service. It begins with pulling, which fills no queue.

    Args:
        period_ns: of its writer, 0 if it has none.
        fixed: ``push`` or ``pull``, if a person wants it; None: it finds out.

    Attributes:
        pulls: frames are to be asked for.
    """

    def __init__(self, period_ns: int, fixed: str | None = None) -> None:
        self._period_ns, self._fixed = period_ns, fixed
        self.pulls: bool = fixed != "push"
        self._ages: deque[tuple[int, int]] = deque()  # (when, age)
        self._took: list[int] = []
        self._retry_ns = _FIRST_RETRY_NS
        self._since_ns = self._looked_ns = self._probe_ns = 0

    @property
    def mode(self) -> str:
        """``push`` or ``pull``."""
        return "pull" if self.pulls else "push"

    def wants_probe(self, at_ns: int) -> bool:
        """Whether a frame is to be asked for as it would be pushed, now."""
        return self.pulls and self._fixed is None and at_ns >= self._probe_ns

    def probed(self, at_ns: int, took_ns: int) -> bool:
        """How long such a frame was on its way, beyond what an empty answer takes; whether that changes the mode."""
        self._took.append(took_ns)
        if len(self._took) < _PROBES and took_ns > self._most_ns:
            return False
        fastest_ns, self._took = min(self._took), []
        if not self.pulls or fastest_ns > self._most_ns:
            self._probe_ns = at_ns + self._retry_ns
            self._retry_ns = min(2 * self._retry_ns, _LAST_RETRY_NS)
            return False
        return self._change(at_ns, False)

    def saw(self, at_ns: int, age_ns: int) -> bool:
        """A pushed frame came; whether that changes the mode.

        Args:
            at_ns: now.
            age_ns: since it was published on the robot.
        """
        if self._fixed or self.pulls:
            return False
        self._ages.append((at_ns, age_ns))
        while at_ns - self._ages[0][0] > _LOOK_NS:
            self._ages.popleft()
        if at_ns - self._since_ns < _LOOK_NS or at_ns - self._looked_ns < _EVERY_NS:
            return False
        self._looked_ns = at_ns
        ages = sorted(age for _, age in self._ages)
        limit_ns = max(_OLD_PERIODS * self._period_ns, _LEAST_OLD_NS) if self._period_ns else _WITHOUT_PERIOD_NS
        if ages[len(ages) // 2] <= limit_ns:
            return False
        self._probe_ns = at_ns + self._retry_ns
        self._retry_ns = min(2 * self._retry_ns, _LAST_RETRY_NS)
        return self._change(at_ns, True)

    @property
    def _most_ns(self) -> float:
        return _SHARE * (self._period_ns or _WITHOUT_PERIOD_NS)

    def _change(self, at_ns: int, pulls: bool) -> bool:
        self.pulls = pulls
        self._since_ns = at_ns
        self._ages.clear()
        return True


__all__ = ["Pacing"]
