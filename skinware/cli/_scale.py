"""From values to the levels of a heat map: how far from rest, in the range of the type, or as the hardware counts."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from skinware.cli._heat_map import levels_of

Floats = npt.NDArray[np.float32]
Levels = npt.NDArray[np.uint8]

CHANGE, RANGE, RAW = "change", "range", "raw"
SCALES = (CHANGE, RANGE, RAW)
"""Names of the scales, in the order in which they take turns."""

_LEAST_SPAN = 8
"""Of a scale of changes, in multiples of the noise."""
_FORGET_S = 20.0
_STEPS = (1, 1.5, 2, 3, 4, 6, 8, 10)


@dataclass(frozen=True)
class Scaled:
    """What is drawn.

    Attributes:
        levels: (n,) uint8.
        values: what stands for the lowest, the middle (if it is not half of the highest) and the highest level.
    """

    levels: Levels
    values: tuple[float, ...]


class ChangeScale:
    """How far values are from rest: from the noise to the greatest change seen lately, rounded up.

    Levels go with the square root: the lightest touch can be told from none, and a light one from a hard one.
    """

    def __init__(self) -> None:
        self._greatest = 0.0
        self._time_ns = 0

    def draw(
        self, change: Floats, fresh: npt.NDArray[np.bool_], noise: float, time_ns: int, before: Levels | None
    ) -> Scaled:
        """Levels of changes.

        Args:
            change: (n,) physical, 0 or more.
            fresh: (n,) bool; others do not count for the scale.
            noise: up to here nothing is shown.
            time_ns: of the frame: what was seen is forgotten slowly.
            before: the levels drawn so far.
        """
        passed_s = max(0, time_ns - self._time_ns) / 1e9
        self._time_ns = time_ns
        self._greatest *= math.exp(-passed_s / _FORGET_S)
        self._greatest = max(self._greatest, float(change[fresh].max(initial=0)))
        span = rounded_up(max(self._greatest, _LEAST_SPAN * noise))
        felt = np.sqrt(np.maximum(change - np.float32(noise), 0))
        levels = levels_of(felt, 0.0, math.sqrt(max(span - noise, 1e-30)), before)
        return Scaled(levels, (0.0, span / 4, span))


class ValueScale:
    """The values themselves: between two limits where they are known, otherwise between the extremes seen so far."""

    def __init__(self) -> None:
        self._low, self._high = math.inf, -math.inf

    def draw(
        self, values: Floats, fresh: npt.NDArray[np.bool_], limits: tuple[float, float], before: Levels | None
    ) -> Scaled:
        """Levels of values.

        Args:
            values: (n,).
            fresh: (n,) bool; others do not count for the scale.
            limits: what is level 0 and what the highest; infinite where it is not known.
            before: the levels drawn so far.
        """
        low, high = limits
        if not math.isfinite(low) or not math.isfinite(high):
            counting = values[fresh & np.isfinite(values)]
            self._low = min(self._low, float(counting.min(initial=math.inf)))
            self._high = max(self._high, float(counting.max(initial=-math.inf)))
            low, high = (self._low, self._high) if self._low <= self._high else (0.0, 1.0)
        return Scaled(levels_of(values, low, high, before), (low, high))


def rounded_up(value: float) -> float:
    """The next of a few round numbers, of any size."""
    if not value > 0 or not math.isfinite(value):
        return 1.0
    unit = 10.0 ** math.floor(math.log10(value))
    return next(step * unit for step in _STEPS if step * unit >= value * (1 - 1e-9))
