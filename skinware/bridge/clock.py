"""The other machine's clock, by questions to and fro: pure arithmetic.

Each question tells an offset that is wrong by at most half of its round trip. The shortest round trips tell most.
Clocks drift apart by some 10 parts in a million, so a line goes through the offsets of the shortest round trips of the
last minute. What it may be wrong by is told with it.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from skinware.realtime import NS_PER_S

_KEPT_NS = 60 * NS_PER_S
_SLOPE_FROM_NS = 5 * NS_PER_S
"""A line through points that are nearer to each other tells nothing."""
_SHARE = 0.1
_FEWEST = 8
_STEP_NS = 20_000_000
"""Offsets that contradict what was known by more than their bounds and this: the clock jumped, as with a new start."""
FAST_QUESTIONS, FAST_NS, SLOW_NS = 16, NS_PER_S // 8, NS_PER_S


@dataclass(frozen=True)
class Sample:
    """What one question told.

    Attributes:
        at_ns: our time in the middle of it.
        offset_ns: our clock minus the other.
        round_trip_ns: without the time that the other end took.
    """

    at_ns: int
    offset_ns: int
    round_trip_ns: int

    @staticmethod
    def of(asked_ns: int, heard_ns: int, answered_ns: int, returned_ns: int) -> Sample:
        """Of our times ``asked_ns`` and ``returned_ns`` and the other end's, ``heard_ns`` and ``answered_ns``."""
        offset_ns = ((asked_ns - heard_ns) + (returned_ns - answered_ns)) // 2
        round_trip_ns = max(0, (returned_ns - asked_ns) - (answered_ns - heard_ns))
        return Sample((asked_ns + returned_ns) // 2, offset_ns, round_trip_ns)


class PeerClock:
    """Moves times of another machine to ours.

    Attributes:
        error_ns: what ``here_ns`` may be wrong by.
    """

    def __init__(self) -> None:
        self._samples: deque[Sample] = deque()
        self._at_ns = 0
        self._offset_ns = 0.0
        self._slope = 0.0
        self.error_ns: int = 0

    @property
    def is_known(self) -> bool:
        """Whether anything is."""
        return bool(self._samples)

    @property
    def round_trip_ns(self) -> int:
        """The shortest that is known of, 0 if none is."""
        return min((sample.round_trip_ns for sample in self._samples), default=0)

    def pause_ns(self) -> int:
        """How long to wait before the next question."""
        return FAST_NS if len(self._samples) < FAST_QUESTIONS else SLOW_NS

    def offset_ns(self, at_ns: int) -> int:
        """Our clock minus the other, at one of our moments."""
        return round(self._offset_ns + self._slope * (at_ns - self._at_ns))

    def add(self, sample: Sample) -> None:
        """What a question told."""
        if self.is_known:
            away_ns = abs(sample.offset_ns - self.offset_ns(sample.at_ns))
            if away_ns > self.error_ns + sample.round_trip_ns // 2 + _STEP_NS:
                self._samples.clear()
        self._samples.append(sample)
        while sample.at_ns - self._samples[0].at_ns > _KEPT_NS:
            self._samples.popleft()
        self._fit(sample.at_ns)

    def _fit(self, at_ns: int) -> None:
        samples = self._samples
        count = max(_FEWEST, round(_SHARE * len(samples)))
        best = sorted(samples, key=lambda sample: sample.round_trip_ns)[:count]
        at = np.array([sample.at_ns - at_ns for sample in best], np.float64)
        base_ns = best[0].offset_ns
        offset = np.array([sample.offset_ns - base_ns for sample in best], np.float64)
        bound = np.array([sample.round_trip_ns / 2 for sample in best], np.float64)
        weight = 1 / np.maximum(bound, 1000.0) ** 2
        middle = float(np.average(at, weights=weight))
        self._slope = 0.0
        if np.ptp(at) >= _SLOPE_FROM_NS:
            spread = np.average((at - middle) ** 2, weights=weight)
            self._slope = float(np.average((at - middle) * offset, weights=weight) / spread)
        self._at_ns = at_ns
        self._offset_ns = base_ns + float(np.average(offset, weights=weight)) - self._slope * middle
        away = np.abs(offset + base_ns - (self._offset_ns + self._slope * at))
        self.error_ns = round(float((bound + away).min() + abs(middle) * self._drift()))

    def _drift(self) -> float:
        """What the slope may be wrong by: nothing where there is a line, the worst of ordinary clocks where not."""
        return 0.0 if self._slope else 100e-6
