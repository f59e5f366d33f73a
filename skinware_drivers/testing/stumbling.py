"""A sender that now and then loses a run of frames, stands still, and catches up."""

from __future__ import annotations

import random

from skinware_drivers.virtual.hardware import WireFrame

_LONGEST_HOLD = 2.5
_BETWEEN = 6
_LOSES_ONLY = 0.3


class Stumbling:
    """What such a sender makes of its frames; all chance comes from one seed.

    Args:
        period_ns: from burst to burst.
        frames: of a burst; it loses up to twice as many in a row.

    Attributes:
        stumbles: how often it happened.
    """

    def __init__(self, period_ns: int, frames: int) -> None:
        self._period_ns = period_ns
        self._frames = frames
        self._random = random.Random(4)
        self._held: list[WireFrame] = []
        self._next_ns = 0
        self._until_ns = 0
        self._skip = self._lose = 0
        self.stumbles = 0

    @property
    def due_ns(self) -> int | None:
        """When it goes on; None: it does not stand still."""
        return self._until_ns if self._held else None

    def pass_on(self, frames: list[WireFrame], now_ns: int) -> list[WireFrame]:
        self._next_ns = self._next_ns or now_ns + self._pause_ns()
        for frame in frames:
            if frame.time_ns >= self._next_ns:
                self._stumble(frame.time_ns)
            if self._skip:
                self._skip -= 1
            elif self._lose:
                self._lose -= 1
                continue
            self._held.append(frame)
        if now_ns < self._until_ns:
            return []
        passed, self._held = self._held, []
        return [frame._replace(time_ns=max(frame.time_ns, self._until_ns)) for frame in passed]

    def _stumble(self, time_ns: int) -> None:
        self.stumbles += 1
        if self._random.random() > _LOSES_ONLY:
            self._until_ns = time_ns + round(self._random.uniform(0, _LONGEST_HOLD) * self._period_ns)
        self._skip = self._random.randrange(self._frames)
        near = self._random.choice((-1, 0, 0, 0, 1))
        self._lose = max(1, min(2 * self._frames, self._frames * self._random.choice((0, 1, 1, 2)) + near))
        self._next_ns = max(time_ns, self._until_ns) + self._pause_ns()

    def _pause_ns(self) -> int:
        return round(_BETWEEN * self._period_ns * self._random.uniform(0.8, 1.6))
