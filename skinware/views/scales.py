"""What a scale of colours goes from and to: of changes from rest, and of values."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float32]

_LEAST_SPAN = 8
"""Of a scale of changes, in multiples of the noise."""
_FORGET_S = 20.0
_STEPS = (1, 1.5, 2, 3, 4, 6, 8, 10)


class ChangeSpan:
    """The greatest change from rest seen lately, rounded up; forgotten slowly."""

    def __init__(self) -> None:
        self._greatest = 0.0
        self._time_ns = 0

    def follow(self, change: Floats, noise: float, time_ns: int) -> float:
        """The span with what is new.

        Args:
            change: (k,) physical, 0 or more, of the sensors that count.
            noise: how far values move by themselves: the span is at least 8 times as much.
            time_ns: of the frame.
        """
        passed_s = max(0, time_ns - self._time_ns) / 1e9
        self._time_ns = time_ns
        self._greatest *= math.exp(-passed_s / _FORGET_S)
        self._greatest = max(self._greatest, float(change.max(initial=0)))
        return rounded_up(max(self._greatest, _LEAST_SPAN * noise))


class ValueLimits:
    """Two limits where they are known, otherwise the extremes seen so far."""

    def __init__(self) -> None:
        self._low, self._high = math.inf, -math.inf

    def follow(self, values: Floats, limits: tuple[float, float]) -> tuple[float, float]:
        """The limits with what is new.

        Args:
            values: (k,) of the sensors that count.
            limits: infinite where they are not known.
        """
        if all(map(math.isfinite, limits)):
            return limits
        counting = values[np.isfinite(values)]
        self._low = min(self._low, float(counting.min(initial=math.inf)))
        self._high = max(self._high, float(counting.max(initial=-math.inf)))
        return (self._low, self._high) if self._low <= self._high else (0.0, 1.0)


def rounded_up(value: float) -> float:
    """The next of a few round numbers, of any size."""
    if not value > 0 or not math.isfinite(value):
        return 1.0
    unit = 10.0 ** math.floor(math.log10(value))
    return next(step * unit for step in _STEPS if step * unit >= value * (1 - 1e-9))
