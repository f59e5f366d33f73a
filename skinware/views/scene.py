"""Place the taxels of all drivers in one space; lay out flat those without known places."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
import numpy.typing as npt

from skinware.geometry import Geometry
from skinware.matrices import filled_by
from skinware.nominal_hand import PARTS, NominalHand
from skinware.structure import Structure
from skinware.views.quantities import Quantity

Cell = tuple[int, int]
"""Row, and column in halves of a sensor: rows of a triangle are shifted by half a sensor."""

_TRIANGLE = ((2, 5), (3, 6), (3, 4), (2, 3), (3, 2), (3, 0), (2, 1), (1, 2), (0, 3), (1, 4))
"""The ten taxels of a ROBOSKIN triangle in the order of their channels (0 to 5, 7 to 9, 11), seen from outside.

They lie 6.5 mm apart in rows of one, two, three and four, as in the published positions of an iCub's skin.
"""
_FINGERTIP = ((3, 2), (3, 4), (3, 6), (3, 8), (3, 0), (2, 6), (2, 4), (2, 2), (1, 2), (1, 4), (1, 6), (0, 4))
"""The twelve taxels of a ROBOSKIN fingertip, unrolled, its tip above, as in the map that its maker publishes."""

_BY_KIND = {("triangle", 10): _TRIANGLE, ("fingertip", 12): _FINGERTIP}


@dataclass(frozen=True)
class ModuleShape:
    """The places of the sensors of a module, in the order of a snapshot; ``halves``: width in halves of a sensor."""

    cells: tuple[Cell, ...]
    rows: int
    halves: int


@cache
def shape_of(kind: str, count: int) -> ModuleShape:
    """Return the shape of a module.

    Args:
        kind: of the module: ``triangle``, ``fingertip``, rows and columns as ``4x6``; any other is drawn as a block.
    """
    known = _BY_KIND.get((kind, count))
    if known is not None:
        return ModuleShape(known, 1 + max(row for row, _ in known), 2 + max(half for _, half in known))
    grid = filled_by(kind, count)
    if grid is not None:
        return rows_of(count, grid[1])
    return rows_of(count, block_columns(count))


@cache
def rows_of(count: int, columns: int) -> ModuleShape:
    cells = tuple((number // columns, 2 * (number % columns)) for number in range(count))
    return ModuleShape(cells, math.ceil(count / columns), 2 * columns)


def block_columns(count: int) -> int:
    """Return the columns of a compact block of ``count`` sensors with few empty places."""
    narrowest = math.isqrt(count - 1) + 1
    widest = max(narrowest, int(2.5 * math.sqrt(count)))
    return min(range(narrowest, widest + 1), key=lambda columns: (-count % columns, columns))


Places = npt.NDArray[np.float32]
Pose = npt.NDArray[np.float64]
"""(4, 4): the place of a coordinate frame."""

FLAT_PITCH_M = 0.0065
"""Distance between sensors that are laid out flat."""
_BETWEEN_MODULES = 1.5
_BETWEEN_PATCHES = 3.0
"""In pitches."""
ASPECT = 1.4
"""Width of a flat layout divided by its height, as of the windows that show it."""
_ROWS_OF_TRIANGLES = 3**0.5 / 2
"""Distance of rows that are shifted by half a sensor, in pitches."""
_BETWEEN_ISLANDS = 0.15
"""Gap between bodies, as a part of the width of the right one; at least some pitches."""
_NOMINAL = "_nominal"
"""In the name of a coordinate frame that each driver has for itself, such as ``right_hand_nominal``."""
_IDENTITY = np.eye(4)
_BEHIND_M = 0.0015
"""Distance of outlines behind the taxels."""
_SAME_PLACE_M = 1e-4


@dataclass(frozen=True, eq=False)
class Placed:
    """The places of the n taxels of a quantity.

    Attributes:
        position: (n, 3) float32, m.
        normal: (n, 3) float32, outwards, of length 1; NaN where it is not known.
        is_known: whether the places of most of them are known; the others are laid out flat.
        spacing_m: usual distance from a taxel to the nearest other.
    """

    position: Places
    normal: Places
    is_known: bool
    spacing_m: float


class Scene:
    """Places of all taxels.

    Taxels with places in one coordinate frame are one body, also those of several drivers. A driver is a body of its
    own in a nominal frame, and where its taxels would lie on those of another driver. The first body of a frame with a
    pose is placed by that pose, and the first other body by its own coordinates. All further bodies stand beside them
    in the order of their drivers, then taxels without places. So nothing covers anything else.
    """

    def __init__(
        self, drivers: Mapping[str, tuple[Structure, Sequence[Quantity]]], poses: Mapping[str, Pose] | None = None
    ) -> None:
        self._poses = dict(poses or {})
        self._right = -np.inf  # the right end of everything that is placed so far
        self._low, self._high = 0.0, 0.0  # its y
        self._placed: dict[tuple[str, str], Placed] = {}
        self._pose_of: dict[tuple[str, str], Pose] = {}  # by driver and frame
        self._outlines: dict[tuple[str, str], list[npt.NDArray[np.float64]]] = {}
        self._arrange_bodies(_bodies({name: s.geometry for name, (s, _) in drivers.items() if s.geometry is not None}))
        flat = {
            name: [laid_out(structure, quantity.index[~quantity.geometry.known]) for quantity in quantities]
            for name, (structure, quantities) in drivers.items()
        }
        sizes = {}
        for name, places in flat.items():
            if any(map(len, places)):
                at = np.concatenate(places)
                sizes[name] = float(at[:, 0].max()), -float(at[:, 1].min())
        corners = self._arrange_flat(sizes)
        for name, (_, quantities) in drivers.items():
            self._place(name, quantities, flat[name], corners.get(name, np.zeros(3)))

    def of(self, driver: str, quantity: str) -> Placed:
        return self._placed[driver, quantity]

    def pose(self, driver: str, frame: str) -> Pose:
        """Return (4, 4), the place of a driver's coordinate frame; the identity for a frame without its taxels."""
        return self._pose_of.get((driver, frame), _IDENTITY)

    def outlines(self, driver: str) -> list[Places]:
        """Return (k, 3) m: the corners of the fingers and palms of a driver's nominal hands, behind its taxels."""
        found = []
        for (name, frame), outlines in self._outlines.items():
            if name == driver:
                pose = self.pose(driver, frame)
                behind = [(at - [0, 0, _BEHIND_M]) @ pose[:3, :3].T + pose[:3, 3] for at in outlines]
                found += [at.astype(np.float32) for at in behind]
        return found

    def _arrange_bodies(self, bodies: Sequence[_Body]) -> None:
        for body in sorted(bodies, key=lambda body: not self._is_placed(body)):
            pose = self._poses.get(body.frame, np.eye(4)).copy()
            hand, outlines = NominalHand.in_frame(body.frame), []
            if hand is not None:  # the parts of a nominal hand on which the taxels are, and the palm
                parts = {*hand.parts_at(body.at).tolist(), len(PARTS) - 1}
                outlines = [hand.outline(name) for number, name in enumerate(PARTS) if number in parts]
            self._outlines |= {(driver, body.frame): outlines for driver in body.drivers if outlines}
            places = np.concatenate([body.at, *outlines])
            corners = np.array(np.meshgrid(*zip(places.min(axis=0), places.max(axis=0), strict=True))).reshape(3, -1)
            at = pose[:3, :3] @ corners + pose[:3, 3:]
            if not self._is_placed(body):
                gap = max(_BETWEEN_ISLANDS * np.ptp(at[0]), 2 * _BETWEEN_PATCHES * FLAT_PITCH_M)
                away = max(0.0, float(self._right + gap - at[0].min()))  # to the right of everything so far
                pose[0, 3] += away
                at[0] += away
            self._pose_of |= {(driver, body.frame): pose for driver in body.drivers}
            self._right = max(self._right, at[0].max())
            self._low, self._high = min(self._low, at[1].min()), max(self._high, at[1].max())

    def _is_placed(self, body: _Body) -> bool:
        return body.is_first and body.frame in self._poses

    def _arrange_flat(self, sizes: Mapping[str, tuple[float, float]]) -> dict[str, Pose]:
        """Return (3,) for each driver: the upper left corner of its flat layout, beside everything with places."""
        gap = max([_BETWEEN_ISLANDS * width for width, _ in sizes.values()], default=0.0)
        gap = max(gap, 2 * _BETWEEN_PATCHES * FLAT_PITCH_M)
        corners = on_shelves(list(sizes.values()), gap)
        left = max(0.0, float(self._right + gap))
        top = 0.0
        if np.isfinite(self._right):  # beside the middle of everything with places
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
                rows, pose = geometry.known & (geometry.frame == frame), self.pose(driver, frame)
                position[rows] = position[rows] @ pose[:3, :3].T + pose[:3, 3]
                normal[rows] = normal[rows] @ pose[:3, :3].T
            position[~geometry.known] = places + corner
            normal[~geometry.known] = 0, 0, 1
            self._placed[driver, quantity.name] = Placed(
                position.astype(np.float32),
                normal.astype(np.float32),
                bool(2 * geometry.known.sum() > len(quantity)),
                FLAT_PITCH_M if np.isnan(quantity.pitch_m) else quantity.pitch_m,
            )


@dataclass(eq=False)
class _Body:
    """The drivers whose taxels are together in a coordinate frame, and the (n, 3) places of their taxels, m."""

    frame: str
    is_first: bool
    drivers: list[str]
    at: npt.NDArray[np.float64]


def _bodies(geometries: Mapping[str, Geometry]) -> list[_Body]:
    found: list[_Body] = []
    for driver, geometry in geometries.items():
        for frame in sorted(_frames(geometry)):
            bodies = [body for body in found if body.frame == frame]
            at = geometry.position_m[geometry.known & (geometry.frame == frame)]
            shared = [] if _NOMINAL in frame else [body for body in bodies if not _is_same(body.at, at)]
            if shared:
                shared[0].drivers.append(driver)
                shared[0].at = np.concatenate([shared[0].at, at])
            else:
                found.append(_Body(frame, not bodies, [driver], at))
    return found


def _is_same(one: npt.NDArray[np.float64], other: npt.NDArray[np.float64]) -> bool:
    """Return whether more than half of the smaller set of (n, 3) places are also in the other."""
    sets = [np.unique(np.round(at / _SAME_PLACE_M) + 0.0, axis=0) for at in (one, other)]
    common = sum(map(len, sets)) - len(np.unique(np.concatenate(sets), axis=0))
    return 2 * common > min(map(len, sets))


def _frames(geometry: Geometry) -> list[str]:
    return list(dict.fromkeys(geometry.frame[geometry.known].tolist()))


def laid_out(structure: Structure, sensors: npt.NDArray[np.int64]) -> Places:
    """Return (k, 3) float32, m: places of sensors in the plane z = 0, module by module in their shapes.

    Modules of a patch are together, in lines; patches stand side by side on shelves. The upper left corner is at 0, 0.

    Args:
        sensors: (k,) positions in a snapshot.
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
    """Return the upper left corners of boxes that stand in lines in their order, so that all fit into a small window.

    Returns:
        The distance of each to the right and up; the first is at 0, 0, and lower ones have negative heights.
    """
    widths = np.cumsum([width + gap for width, _ in sizes]).tolist()
    shelves = (_shelves(sizes, gap, longest) for longest in widths)
    return min(shelves, key=lambda found: _window(found, sizes), default=[])


def _shelves(sizes: Sequence[tuple[float, float]], gap: float, longest: float) -> list[tuple[float, float]]:
    corners, right, top, tallest = [], 0.0, 0.0, 0.0
    for width, height in sizes:
        if right and right + width > longest:
            right, top, tallest = 0.0, top - tallest - gap, 0.0
        corners.append((right, top))
        right, tallest = right + width + gap, max(tallest, height)
    return corners


def _window(corners: Sequence[tuple[float, float]], sizes: Sequence[tuple[float, float]]) -> float:
    wide = max(right + width for (right, _), (width, _) in zip(corners, sizes, strict=True))
    high = max(height - up for (_, up), (_, height) in zip(corners, sizes, strict=True))
    return max(wide / ASPECT, high)


def _per_line(count: int, width: float, height: float) -> int:
    """Return the number of boxes of one size in a line, so that all fit into a small window."""
    return min(range(1, count + 1), key=lambda line: max(line * width / ASPECT, -(-count // line) * height))
