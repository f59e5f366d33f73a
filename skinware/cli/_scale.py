"""From values to the levels of a heat map: how far from rest, in the range of the type, or as the hardware counts."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from skinware.cli._heat_map import levels_of
from skinware.views.scales import ChangeSpan, ValueLimits

Floats = npt.NDArray[np.float32]
Levels = npt.NDArray[np.uint8]

CHANGE, RANGE, RAW = "change", "range", "raw"
SCALES = (CHANGE, RANGE, RAW)
"""Names of the scales, in the order in which they take turns."""


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
        self._span = ChangeSpan()

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
        span = self._span.follow(change[fresh], noise, time_ns)
        felt = np.sqrt(np.maximum(change - np.float32(noise), 0))
        levels = levels_of(felt, 0.0, math.sqrt(max(span - noise, 1e-30)), before)
        return Scaled(levels, (0.0, span / 4, span))


class ValueScale:
    """The values themselves: between two limits where they are known, otherwise between the extremes seen so far."""

    def __init__(self) -> None:
        self._limits = ValueLimits()

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
        low, high = self._limits.follow(values[fresh], limits)
        return Scaled(levels_of(values, low, high, before), (low, high))
