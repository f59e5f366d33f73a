"""What emulated devices feel while a driver is tested."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from skinware_drivers.testing.wire import Pattern
from skinware_drivers.virtual.emulator import each_value

Values = npt.NDArray[np.int64]


def limits(emulator: Any, n_values: int) -> tuple[Values, Values]:
    """Least and greatest value that each sensor of a device can send."""
    lowest = each_value("lowest", getattr(emulator, "lowest", 0), n_values)
    return lowest, each_value("full_scale", emulator.full_scale, n_values)


def lively(emulator: Any) -> Pattern:
    """Another random value for every sensor, device and burst: whatever is mixed up shows."""

    def feel(number: int, cycle: int, n_values: int) -> Values:
        lowest, highest = limits(emulator, n_values)
        return np.random.default_rng([number, cycle, 7]).integers(lowest, highest, n_values, endpoint=True)

    return feel


def extreme(emulator: Any) -> Pattern:
    """Values at the ends of the range, and bit patterns, by turns; between them, lively ones."""
    between = lively(emulator)

    def feel(number: int, cycle: int, n_values: int) -> Values:
        lowest, highest = limits(emulator, n_values)
        odd = np.arange(n_values) % 2
        middle = lowest + (highest - lowest + 1) // 2
        moments = (
            lowest,
            highest,
            lowest | (highest & 0x5555_5555) if (lowest == 0).all() else 0x55,
            lowest | (highest & 0xAAAA_AAAA) if (lowest == 0).all() else -0x56,
            np.where(odd, lowest, highest),
            np.where(odd, highest, lowest),
            middle,
            middle - 1,
            -1,
            1,
        )
        which, is_between = divmod(cycle, 2)
        if is_between:
            return between(number, cycle, n_values)
        return np.clip(moments[which % len(moments)], lowest, highest)

    return feel
