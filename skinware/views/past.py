"""The last ten seconds of a driver's values, as somebody who looks at them saw them."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from skinware.realtime import NS_PER_S

LENGTH_S = 10.0
_FRAMES = 320
"""Kept at most: ten seconds at 32 pictures a second."""


class Past:
    """Values of n sensors, frame by frame; the oldest are forgotten.

    Args:
        n: sensors.
        dtype: of their values.
    """

    def __init__(self, n: int, dtype: npt.DTypeLike) -> None:
        self._values: npt.NDArray[Any] = np.zeros((_FRAMES, n), dtype)
        self._time_ns = np.zeros(_FRAMES, np.int64)
        self._count = 0

    def add(self, values: npt.NDArray[Any], time_ns: int) -> None:
        """Keep a frame.

        Args:
            values: (n,) raw.
            time_ns: when it was published, later than all before it.
        """
        row = self._count % _FRAMES
        self._values[row], self._time_ns[row] = values, time_ns
        self._count += 1

    def series(self, position: int) -> tuple[npt.NDArray[np.int64], npt.NDArray[Any]]:
        """(k,) int64 ns and (k,): times and raw values of a sensor in the last ten seconds before the newest frame."""
        rows = self._rows()
        return self._time_ns[rows], self._values[rows, position]

    def noise(self, positions: list[int]) -> npt.NDArray[np.float64]:
        """(k,) float64: standard deviation of the raw values of sensors, as they go from frame to frame.

        NaN before there are three frames.
        """
        rows = self._rows()
        if len(rows) < 3:
            return np.full(len(positions), np.nan)
        values = self._values[np.ix_(rows, np.array(positions, np.int64))].astype(np.float64)
        noise: npt.NDArray[np.float64] = np.diff(values, axis=0).std(axis=0) / np.sqrt(2)
        return noise

    def _rows(self) -> npt.NDArray[np.int64]:
        """Rows of the last ten seconds, the oldest first."""
        rows = np.arange(max(0, self._count - _FRAMES), self._count) % _FRAMES
        if not len(rows):
            return rows
        times = self._time_ns[rows]
        recent: npt.NDArray[np.int64] = rows[times >= times[-1] - LENGTH_S * NS_PER_S]
        return recent
