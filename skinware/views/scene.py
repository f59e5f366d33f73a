"""Where everything is: the taxels of all drivers in one space; those without known places laid out flat."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from skinware.geometry import Geometry
from skinware.structure import Structure
from skinware.views.quantities import Quantity
from skinware.views.shapes import shape_of

Places = npt.NDArray[np.float32]
Pose = npt.NDArray[np.float64]
"""(4, 4): where a coordinate frame is."""

FLAT_PITCH_M = 0.0065
"""Between sensors that are laid out flat."""
_BETWEEN_MODULES = 1.5
_BETWEEN_PATCHES = 3.0
"""In pitches."""
_ROWS_OF_TRIANGLES = 3**0.5 / 2
"""From row to row, where each is shifted by half a sensor."""
_BETWEEN_ISLANDS = 0.15
"""Of the width of what is beside each other; at least some pitches."""


@dataclass(frozen=True, eq=False)
class Placed:
    """The places of the n taxels of a quantity.

    Attributes:
        position: (n, 3) float32, m.
        normal: (n, 3) float32, outwards, of length 1; NaN where nobody knows.
        radius: (n,) float32, m; NaN where nobody knows.
        is_known: whether the places of most of them are known; the others are laid out flat.
        spacing_m: from a taxel to the nearest other, usually.
    """

    position: Places
    normal: Places
    radius: Places
    is_known: bool
    spacing_m: float


class Scene:
    """Places of all taxels.

    What has places in one coordinate frame stays together. Frames with a pose are where it says; the first other one is
    where its numbers say, and the rest of the frames, then drivers without places, come beside it, so that nothing is
    drawn over something else.

    Args:
        drivers: structure and quantities of each driver, by name.
        poses: of coordinate frames, by name.
    """

    def __init__(
        self, drivers: Mapping[str, tuple[Structure, Sequence[Quantity]]], poses: Mapping[str, Pose] | None = None
    ) -> None:
        self._poses = dict(poses or {})
        self._right = -np.inf  # how far what is placed so far reaches
        self._placed: dict[tuple[str, str], Placed] = {}
        self._arrange_frames([s.geometry for s, _ in drivers.values() if s.geometry is not None])
        for name, (structure, quantities) in drivers.items():
            self._place(name, structure, quantities)

    def of(self, driver: str, quantity: str) -> Placed:
        """Where the taxels of a driver's quantity are."""
        return self._placed[driver, quantity]

    def pose(self, frame: str) -> Pose:
        """(4, 4): where a coordinate frame is; where its numbers say, if nobody knows it."""
        return self._poses.get(frame, np.eye(4))

    def _arrange_frames(self, geometries: Sequence[Geometry]) -> None:
        """Give a pose to each frame that has none."""
        boxes: dict[str, tuple[Pose, Pose]] = {}
        for geometry in geometries:
            for frame in _frames(geometry):
                at = geometry.position_m[geometry.known & (geometry.frame == frame)]
                low, high = boxes.get(frame, (at[0], at[0]))
                boxes[frame] = np.minimum(low, at.min(axis=0)), np.maximum(high, at.max(axis=0))
        for frame in sorted(boxes, key=lambda frame: (frame not in self._poses, frame)):
            corners = np.array(np.meshgrid(*zip(*boxes[frame], strict=True))).reshape(3, -1)
            if frame not in self._poses:
                self._poses[frame] = np.eye(4)
                self._poses[frame][0, 3] = self._way_right(corners[0].min(), np.ptp(corners[0]))
            pose = self._poses[frame]
            self._right = max(self._right, (pose[:3, :3] @ corners + pose[:3, 3:])[0].max())

    def _way_right(self, left: float, width: float) -> float:
        """How far something has to go so that it is on the right of all that is placed."""
        gap = max(_BETWEEN_ISLANDS * width, 2 * _BETWEEN_PATCHES * FLAT_PITCH_M)
        return max(0.0, float(self._right + gap - left))

    def _place(self, driver: str, structure: Structure, quantities: Sequence[Quantity]) -> None:
        flat = [laid_out(structure, quantity.index[~quantity.geometry.known]) for quantity in quantities]
        width = max((float(places[:, 0].max()) for places in flat if len(places)), default=None)
        shift = 0.0 if width is None else self._way_right(0.0, width)
        if width is not None:
            self._right = max(self._right, shift + width)
        for quantity, places in zip(quantities, flat, strict=True):
            geometry = quantity.geometry
            position, normal = geometry.position_m.copy(), geometry.normal.copy()
            for frame in _frames(geometry):
                rows, pose = geometry.known & (geometry.frame == frame), self.pose(frame)
                position[rows] = position[rows] @ pose[:3, :3].T + pose[:3, 3]
                normal[rows] = normal[rows] @ pose[:3, :3].T
            position[~geometry.known] = places + np.array([shift, 0, 0])
            normal[~geometry.known] = 0, 0, 1
            self._placed[driver, quantity.name] = Placed(
                position.astype(np.float32),
                normal.astype(np.float32),
                geometry.radius_m.astype(np.float32),
                bool(2 * geometry.known.sum() > len(quantity)),
                FLAT_PITCH_M if np.isnan(quantity.pitch_m) else quantity.pitch_m,
            )


def _frames(geometry: Geometry) -> list[str]:
    """The coordinate frames of the places that are known."""
    return list(dict.fromkeys(geometry.frame[geometry.known].tolist()))


def laid_out(structure: Structure, sensors: npt.NDArray[np.int64]) -> Places:
    """(k, 3) float32, m: places of sensors side by side in the plane z = 0, module by module in their shapes.

    Modules of a patch are beside each other, patches below each other; the upper left corner is at 0, 0.

    Args:
        structure: of the driver.
        sensors: (k,) positions in a frame.
    """
    position = np.zeros((len(sensors), 3), np.float32)
    if not len(sensors):
        return position
    order = np.lexsort((structure.sensor_module[sensors], structure.sensor_patch[sensors]))
    in_order = structure.sensor_module[sensors][order]
    starts = np.flatnonzero(np.diff(in_order, prepend=in_order[0] + 1))
    modules, groups = in_order[starts], np.split(order, starts[1:])
    shapes = [
        shape_of(structure.module_kind[module].decode(), len(group))
        for module, group in zip(modules.tolist(), groups, strict=True)
    ]
    width = max(shape.halves for shape in shapes) / 2 + _BETWEEN_MODULES
    height = max(shape.rows for shape in shapes) + _BETWEEN_MODULES
    patch = structure.module_patch[modules]
    longest = int(np.bincount(patch).max())
    n_patches = len(np.unique(patch))
    per_line = max(1, min(longest, round(float(np.sqrt(longest * n_patches * height / width)) + 0.5)))
    top, column, last = 0.0, 0, int(patch[0])
    for shape, group, of_patch in zip(shapes, groups, patch.tolist(), strict=True):
        if of_patch != last:
            top, column, last = top - height - _BETWEEN_PATCHES, 0, of_patch
        elif column == per_line:
            top, column = top - height, 0
        cells = np.array(shape.cells, np.float32)
        position[group, 0] = column * width + cells[:, 1] / 2
        position[group, 1] = top - cells[:, 0] * (_ROWS_OF_TRIANGLES if (cells[:, 1] % 2).any() else 1.0)
        column += 1
    return position * np.float32(FLAT_PITCH_M)


__all__ = ["FLAT_PITCH_M", "Placed", "Pose", "Scene", "laid_out"]
