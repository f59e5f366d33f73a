"""Reports patches that send steadily more than their period allows: two devices with one identifier, perhaps."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from skinware.realtime import NS_PER_S, now_ns
from skinware.structure import Structure

_WINDOW_NS = 5 * NS_PER_S
_STEADILY = 3
"""Windows in a row: what waited while a driver was held up comes in one."""
_MUCH = 1.6


class Doubles:
    """Compares how many updates each patch sends with how many its period allows.

    Frames of two devices with one identifier, and one counter if they have any, cannot be told apart one by one.

    Args:
        structure: what is in service.
        period_ns: the driver's period, above 0.
        clock: CLOCK_MONOTONIC ns.
    """

    def __init__(self, structure: Structure, period_ns: int, clock: Callable[[], int] = now_ns) -> None:
        self._clock = clock
        periods_ns = np.where(structure.group_period_ns > 0, structure.group_period_ns, max(1, period_ns))
        self._due_per_ns = np.bincount(structure.group_patch, 1 / periods_ns, structure.n_patches)
        self._before = np.zeros(structure.n_patches, np.int64)
        self._before_ns = clock()
        self._windows = np.zeros(structure.n_patches, np.int64)

    def look(self, updates: npt.NDArray[np.int64]) -> list[tuple[int, float]]:
        """Look at what was counted, as often as one likes.

        Args:
            updates: (n_patches,) int64, updates of each patch so far.

        Returns:
            (patch, how many times more than is due) of patches that are to be reported: each once.
        """
        time_ns = self._clock()
        passed_ns = time_ns - self._before_ns
        if passed_ns < _WINDOW_NS:
            return []
        ratio = (updates - self._before) / np.maximum(self._due_per_ns * passed_ns, 1)
        self._before, self._before_ns = updates.copy(), time_ns
        self._windows = np.where(self._windows < _STEADILY, (self._windows + 1) * (ratio > _MUCH), _STEADILY + 1)
        return [(patch, float(ratio[patch])) for patch in np.flatnonzero(self._windows == _STEADILY).tolist()]
