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
ASPECT = 1.4
"""Of what is laid out flat: so many times as wide as high, like the windows that show it."""
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
        self._low, self._high = 0.0, 0.0  # its y
        self._placed: dict[tuple[str, str], Placed] = {}
        self._arrange_frames([s.geometry for s, _ in drivers.values() if s.geometry is not None])
        flat = {
            name: [laid_out(structure, quantity.index[~quantity.geometry.known]) for quantity in quantities]
            for name, (structure, quantities) in drivers.items()
        }
        corners = self._arrange_flat({name: _size(places) for name, places in flat.items() if any(map(len, places))})
        for name, (_, quantities) in drivers.items():
            self._place(name, quantities, flat[name], corners.get(name, np.zeros(3)))

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
            at = pose[:3, :3] @ corners + pose[:3, 3:]
            self._right = max(self._right, at[0].max())
            self._low, self._high = min(self._low, at[1].min()), max(self._high, at[1].max())

    def _way_right(self, left: float, width: float) -> float:
        """How far something has to go so that it is on the right of all that is placed."""
        gap = max(_BETWEEN_ISLANDS * width, 2 * _BETWEEN_PATCHES * FLAT_PITCH_M)
        return max(0.0, float(self._right + gap - left))

    def _arrange_flat(self, sizes: Mapping[str, tuple[float, float]]) -> dict[str, Pose]:
        """(3,) for each driver: the upper left corner of what is laid out flat, beside all that has places."""
        gap = max([_BETWEEN_ISLANDS * width for width, _ in sizes.values()], default=0.0)
        gap = max(gap, 2 * _BETWEEN_PATCHES * FLAT_PITCH_M)
        corners = on_shelves(list(sizes.values()), gap)
        left = max(0.0, float(self._right + gap))
        top = 0.0
        if np.isfinite(self._right):  # it stands beside the middle of what has places
            high = max((height - up for (_, up), (_, height) in zip(corners, sizes.values(), strict=True)), default=0.0)
            top = (self._low + self._high + high) / 2
        return {name: np.array([left + right, top + up, 0.0]) for name, (right, up) in zip(sizes, corners, strict=True)}

    def _place(
        self, driver: str, quantities: Sequence[Quantity], flat: Sequence[Places], corner: npt.NDArray[np.float64]
    ) -> None:
        for quantity, places in zip(quantities, flat, strict=True):
            geometry = quantity.geometry
            position, normal = geometry.position_m.copy(), geometry.normal.copy()
            for frame in _frames(geometry):
                rows, pose = geometry.known & (geometry.frame == frame), self.pose(frame)
                position[rows] = position[rows] @ pose[:3, :3].T + pose[:3, 3]
                normal[rows] = normal[rows] @ pose[:3, :3].T
            position[~geometry.known] = places + corner
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

    Modules of a patch are together, in lines; patches stand side by side on shelves. The upper left corner is at 0, 0.

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
    _, of_patch, counts = np.unique(structure.module_patch[modules], return_inverse=True, return_counts=True)
    per_line = [_per_line(count, width, height) for count in counts.tolist()]
    sizes = [
        (min(count, line) * width, -(-count // line) * height) for count, line in zip(counts, per_line, strict=True)
    ]
    corners, placed = on_shelves(sizes, _BETWEEN_PATCHES), [0] * len(counts)
    for shape, group, patch in zip(shapes, groups, of_patch.tolist(), strict=True):
        row, column = divmod(placed[patch], per_line[patch])
        placed[patch] += 1
        right, up = corners[patch]
        cells = np.array(shape.cells, np.float32)
        position[group, 0] = right + column * width + cells[:, 1] / 2
        position[group, 1] = up - row * height - cells[:, 0] * (_ROWS_OF_TRIANGLES if (cells[:, 1] % 2).any() else 1.0)
    return position * np.float32(FLAT_PITCH_M)


def on_shelves(sizes: Sequence[tuple[float, float]], gap: float) -> list[tuple[float, float]]:
    """The upper left corners of boxes that stand in lines in their order, so that all fit into a small window.

    Args:
        sizes: width and height of each.
        gap: between them.

    Returns:
        How far each is to the right and up; the first is at 0, 0, and others are below it at negative heights.
    """
    widths = np.cumsum([width + gap for width, _ in sizes]).tolist()
    shelves = (_shelves(sizes, gap, longest) for longest in widths)
    return min(shelves, key=lambda found: _window(found, sizes), default=[])


def _shelves(sizes: Sequence[tuple[float, float]], gap: float, longest: float) -> list[tuple[float, float]]:
    """Likewise, in lines of a known length."""
    corners, right, top, tallest = [], 0.0, 0.0, 0.0
    for width, height in sizes:
        if right and right + width > longest:
            right, top, tallest = 0.0, top - tallest - gap, 0.0
        corners.append((right, top))
        right, tallest = right + width + gap, max(tallest, height)
    return corners


def _window(corners: Sequence[tuple[float, float]], sizes: Sequence[tuple[float, float]]) -> float:
    """How high a window must be that shows all boxes."""
    wide = max(right + width for (right, _), (width, _) in zip(corners, sizes, strict=True))
    high = max(height - up for (_, up), (_, height) in zip(corners, sizes, strict=True))
    return max(wide / ASPECT, high)


def _per_line(count: int, width: float, height: float) -> int:
    """How many of some boxes of one size stand in a line, so that all fit into a small window."""
    return min(range(1, count + 1), key=lambda line: max(line * width / ASPECT, -(-count // line) * height))


def _size(flat: Sequence[Places]) -> tuple[float, float]:
    """Width and height of what is laid out, m."""
    places = np.concatenate(flat)
    return float(places[:, 0].max()), -float(places[:, 1].min())


__all__ = ["ASPECT", "FLAT_PITCH_M", "Placed", "Pose", "Scene", "laid_out", "on_shelves"]
