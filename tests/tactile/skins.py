"""Skins with places, made up for tests."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from skinware.geometry import Geometry
from skinware.tactile.tracking import TrackingSettings

PITCH_M = 0.0065
AT_ONCE = TrackingSettings(frames=1)
"""A touch of a single frame is a contact."""


def placed(position_m: npt.ArrayLike, frame: npt.ArrayLike = "chest", normal: npt.ArrayLike | None = None) -> Geometry:
    """A geometry of taxels at these places; NaN: not known."""
    position = np.array(position_m, float).reshape(-1, 3)
    geometry = Geometry.unknown(["pressure"] * len(position), np.arange(len(position), dtype=np.uint64))
    geometry.position_m[:] = position
    geometry.frame[:] = frame
    if normal is not None:
        geometry.normal[:] = normal
    return geometry


def triangles(rows: int, columns: int, pitch_m: float = PITCH_M) -> npt.NDArray[np.float64]:
    """(rows * columns, 3) m: a flat lattice of equilateral triangles, row by row."""
    row, column = np.divmod(np.arange(rows * columns), columns)
    x, y = (column + row % 2 / 2) * pitch_m, row * pitch_m * np.sqrt(0.75)
    return np.column_stack([x, y, np.zeros(rows * columns)])


def pressed(
    position_m: npt.NDArray[np.float64], at_m: npt.ArrayLike, radius_m: float, load: float = 10.0
) -> npt.NDArray[np.float64]:
    """(n,) values: a cone over each of the places ``at_m``, 0 beyond the radius."""
    away_m = np.linalg.norm(position_m[:, None] - np.array(at_m, float).reshape(-1, 3), axis=2)
    cones: npt.NDArray[np.float64] = load * np.clip(1 - away_m / radius_m, 0, None)
    highest: npt.NDArray[np.float64] = cones.max(axis=1, initial=0.0)
    return highest
