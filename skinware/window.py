"""The last frames of one sensor type as one array."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from skinware.driver_snapshot import DriverSnapshot
from skinware.errors import ConfigurationError
from skinware.snapshot import Snapshot


class Window:
    """The last frames of one sensor type, for filters and other computations that need past values.

    Add frames of one driver (``in_order`` returns every one) or snapshots of a skin::

        window = Window("pressure", 100)
        for frame in reader.in_order():
            window.add(frame)
            slow = window.physical.mean(axis=0)

    Args:
        type_name: which sensors.
        length: how many frames to keep, N.

    Raises:
        ConfigurationError: a length below 1.
    """

    def __init__(self, type_name: str, length: int) -> None:
        if length < 1:
            raise ConfigurationError(f"a window of {length} frames: give at least 1")
        self.type_name = type_name
        self.length = length
        self._of: object = None
        self._added = 0
        self._time_ns = np.zeros(length, np.int64)
        self._physical: npt.NDArray[Any] = np.zeros((length, 0), np.float32)
        self._fresh = np.zeros((length, 0), bool)

    def add(self, frame: DriverSnapshot | Snapshot) -> None:
        """Take a frame in; the oldest gives way.

        A frame of another structure, or a snapshot of another layout, empties the window first: its sensors are others.

        Raises:
            StructureError: it has no sensors of the type, or has them in different units.
        """
        physical, fresh = frame.physical(self.type_name), frame.fresh(self.type_name)
        of = frame.layout if isinstance(frame, Snapshot) else frame.structure
        if of is not self._of:
            self._of, self._added = of, 0
            self._physical = np.zeros((self.length, len(physical)), physical.dtype)
            self._fresh = np.zeros(self._physical.shape, bool)
        row = self._added % self.length
        self._time_ns[row] = np.max(frame.acquired_ns)
        self._physical[row], self._fresh[row] = physical, fresh
        self._added += 1

    def __len__(self) -> int:
        """Frames in it: N as soon as so many were added."""
        return min(self._added, self.length)

    @property
    def physical(self) -> npt.NDArray[np.floating[Any]]:
        """(len, n) physical values, the oldest frame first; a copy."""
        return self._in_order(self._physical)

    @property
    def fresh(self) -> npt.NDArray[np.bool_]:
        """(len, n) bool: which could be trusted when their frame was added; a copy."""
        return self._in_order(self._fresh)

    @property
    def time_ns(self) -> npt.NDArray[np.int64]:
        """(len,) int64: time of the newest data of each frame, CLOCK_MONOTONIC ns; a copy."""
        return self._in_order(self._time_ns)

    def _in_order(self, rows: npt.NDArray[Any]) -> npt.NDArray[Any]:
        if self._added <= self.length:
            return rows[: self._added].copy()
        return np.roll(rows, -(self._added % self.length), axis=0)

    def __repr__(self) -> str:
        return f"<Window of {self.type_name}: {len(self)} of {self.length} frames>"
