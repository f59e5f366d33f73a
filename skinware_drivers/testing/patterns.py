"""What emulated devices feel while a driver is tested."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from skinware_drivers.testing.wire import Pattern

Values = npt.NDArray[np.int64]


def limits(emulator: Any, n_values: int) -> tuple[Values, Values]:
    """Least and greatest value that each sensor of a device can send."""
    lowest, highest = getattr(emulator, "lowest", 0), emulator.full_scale
    return np.broadcast_to(np.int64(lowest), n_values), np.broadcast_to(np.int64(highest), n_values)


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
            lowest | (highest & 0x5555_5555) if (lowest == 0).all() else np.minimum(0x55, highest),
            lowest | (highest & 0xAAAA_AAAA) if (lowest == 0).all() else np.maximum(-0x56, lowest),
            np.where(odd, lowest, highest),
            np.where(odd, highest, lowest),
            middle,
            middle - 1,
            np.clip(-1, lowest, highest),
            np.clip(1, lowest, highest),
        )
        which, is_between = divmod(cycle, 2)
        return between(number, cycle, n_values) if is_between else np.array(moments[which % len(moments)])

    return feel


__all__ = ["extreme", "limits", "lively"]
