"""Place the taxels of a simulated skin: plates, and a forearm of triangles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from skinware.errors import ConfigurationError
from skinware.geometry import Geometry
from skinware.structure import Structure
from skinware.tactile.arrays import Doubles, Whole

Taxels = slice | npt.ArrayLike
"""Some of n taxels: an index of an array of them (numbers, a slice, a mask)."""

PITCH_M = 0.0065
"""Distance between neighbouring taxels of a ROBOSKIN triangle."""
SIDE_M = 0.03
"""Side of a ROBOSKIN triangle."""
_CELLS = ((2, 5), (3, 6), (3, 4), (2, 3), (3, 2), (3, 0), (2, 1), (1, 2), (0, 3), (1, 4))
"""The ten taxels of a triangle in the order of their channels: row from its tip, and column in halves of a pitch."""
TRIANGLE_M = np.array([[(half - 3) / 2, (2 - row) * np.sqrt(0.75)] for row, half in _CELLS]) * PITCH_M
"""(10, 2) places of the taxels of a triangle, from its centre, seen from outside, its tip up, m."""
_PADS = ((3, 4, 6), (7, 8, 9))
CHANNELS_M = np.insert(TRIANGLE_M, [6, 9], [TRIANGLE_M[list(corners)].mean(axis=0) for corners in _PADS], axis=0)
"""(12, 2) the same for all channels: the thermal pads, 6 and 10, lie between three taxels each (an assumption)."""


@dataclass(frozen=True)
class Surface:
    """n taxels of one type, in the driver's order.

    Attributes:
        position_m: (n, 3) float64, m; NaN: not known, and no push reaches the taxel.
        normal: (n, 3) float64, outwards, of length 1; NaN: not known.
        module: (n,) int64, from 0 without gaps.
        patch: (n,) int64, from 0 without gaps; a module is of one patch.

    Raises:
        ConfigurationError: the arrays do not fit each other, or a module is in two patches.
    """

    position_m: Doubles
    normal: Doubles
    module: Whole
    patch: Whole

    def __post_init__(self) -> None:
        n = len(self.position_m)
        if self.position_m.shape != (n, 3) or self.normal.shape != (n, 3):
            raise ConfigurationError(f"positions {self.position_m.shape}, normals {self.normal.shape}: give (n, 3)")
        for name, of in (("module", self.module), ("patch", self.patch)):
            if of.shape != (n,):
                raise ConfigurationError(f"{n} taxels, but {name} has the shape {of.shape}")
            if n and not np.array_equal(np.unique(of), np.arange(of.max() + 1)):
                raise ConfigurationError(f"{name} must count from 0 without gaps")
        if len(np.unique(np.stack([self.module, self.patch]), axis=1).T) != self.n_modules:
            raise ConfigurationError("a module is in two patches")

    @classmethod
    def at(
        cls,
        position_m: npt.ArrayLike,
        *,
        normal: npt.ArrayLike | None = None,
        module: npt.ArrayLike | None = None,
        patch: npt.ArrayLike | None = None,
    ) -> Surface:
        """Make a surface of taxels at given places; by default without normals, as one module and one patch."""
        position = np.array(position_m, np.float64).reshape(-1, 3)
        nothing = np.zeros(len(position), np.int64)
        return cls(
            position_m=position,
            normal=np.full_like(position, np.nan) if normal is None else np.array(normal, np.float64),
            module=nothing if module is None else np.array(module, np.int64),
            patch=nothing if patch is None else np.array(patch, np.int64),
        )

    @classmethod
    def of(cls, structure: Structure, type_name: str, geometry: Geometry | None = None) -> Surface:
        """Make a surface of the taxels of one type of a driver, at the places of ``geometry`` or of the structure.

        Raises:
            StructureError: the driver has no such type.
        """
        index = structure.index(type_name)
        geometry = structure.geometry if geometry is None else geometry
        n = len(structure.sensor_uid[index])
        nowhere = np.full((n, 3), np.nan)
        places = geometry.of(structure, type_name) if geometry is not None else None
        return cls(
            position_m=nowhere if places is None else places.position_m,
            normal=nowhere if places is None else places.normal,
            module=_numbered(structure.sensor_module[index]),
            patch=_numbered(structure.sensor_patch[index]),
        )

    def __len__(self) -> int:
        return len(self.position_m)

    @property
    def n_modules(self) -> int:
        """Number of modules."""
        return int(self.module.max()) + 1 if len(self) else 0

    @property
    def n_patches(self) -> int:
        """Number of patches."""
        return int(self.patch.max()) + 1 if len(self) else 0

    def geometry(self, frame: str = "world", type_name: str = "pressure") -> Geometry:
        """Return the places of the n taxels in a coordinate frame, with the uids 0 to n - 1."""
        n = len(self)
        places = Geometry.unknown([type_name] * n, np.arange(n, dtype=np.uint64))
        places.position_m[:], places.normal[:], places.frame[:] = self.position_m, self.normal, frame
        return places

    def taxels(self, some: Taxels) -> Whole:
        """Return the numbers of some taxels; raises ConfigurationError if there are no such taxels."""
        try:
            found: Whole = np.arange(len(self))[some if isinstance(some, slice) else np.asarray(some)]
        except IndexError as error:
            raise ConfigurationError(f"of {len(self)} taxels: {error}") from None
        return np.atleast_1d(found)


def grid(
    modules: int = 1,
    rows: int = 3,
    columns: int = 4,
    *,
    patches: int = 1,
    pitch_m: float = PITCH_M,
    gap_m: float = 0.05,
) -> Surface:
    """Make flat rectangular modules in a row along x, facing +z, an equal share of them for each patch.

    Args:
        modules: number of modules.
        rows: rows of taxels in a module, along y.
        columns: columns of taxels in a module, along x.
        patches: number of patches.
        pitch_m: distance of neighbours in a module.
        gap_m: distance of the last column of a module from the first of the next.
    """
    y, x = np.divmod(np.arange(rows * columns), columns)
    module = np.repeat(np.arange(modules), rows * columns)
    width_m = (columns - 1) * pitch_m + gap_m
    places = np.stack([np.tile(x, modules) * pitch_m + module * width_m, np.tile(y, modules) * pitch_m], axis=1)
    return _flat(places, module, modules, patches)


def triangles(modules: int = 1, *, patches: int = 1) -> Surface:
    """Make a flat strip of ROBOSKIN triangles of ten taxels along x, facing +z, every second one upside down."""
    places = [
        TRIANGLE_M * (-1 if number % 2 else 1) + [number * SIDE_M / 2, number % 2 * SIDE_M / np.sqrt(12)]
        for number in range(modules)
    ]
    return _flat(np.concatenate(places), np.repeat(np.arange(modules), len(TRIANGLE_M)), modules, patches)


def _flat(places: npt.NDArray[Any], module: Whole, modules: int, patches: int) -> Surface:
    position = np.zeros((len(places), 3))
    position[:, :2] = places
    normal = np.zeros_like(position)
    normal[:, 2] = 1
    return Surface(position, normal, module, module * patches // modules)


def _numbered(of: npt.NDArray[Any]) -> Whole:
    return np.unique(of, return_inverse=True)[1].astype(np.int64)


TRIANGLES = 16
"""Triangles on each board."""
ARM_FRAME = "arm"
"""Coordinate frame of the arm: x from the elbow to the fingertips, z up."""

_HEIGHT_M = SIDE_M * np.sqrt(0.75)
_FACES = 6
_AXIS_TO_FACE_M = _HEIGHT_M / 2 / np.tan(np.pi / _FACES)
_WRIST_M, _HALF_HAND_M = 0.16, 0.0125
_BETWEEN_ARMS_M = 0.25
_PARTS = 4
_HAND = 3
_HAND_STRIP = 4
_TOURS = ((*range(8), *range(15, 7, -1)), (0, 1, 2, 3, 7, 6, 5, 4, 8, 9, 10, 11, 15, 14, 13, 12))


def arm(boards: Sequence[int] = (0, 1, 2, 3), *, pads: bool = False) -> Surface:
    """Make boards of 16 triangles on a forearm (boards 0 to 2) and a hand (board 3); 4 to 7 are an arm beside it.

    The forearm is a prism of six faces, 135 mm long and 52 mm wide; each board covers two of them with a strip of
    eight triangles each. The hand has two strips of four on its palm (triangles 0 to 7) and two on its back. Patches
    are the boards in their order, modules their triangles.

    Args:
        boards: their numbers; below 0 they are on arms on the other side.
        pads: with the thermal pads: 12 sensors a triangle instead of 10.
    """
    flat = CHANNELS_M if pads else TRIANGLE_M
    parts = [_triangle(board, triangle, flat) for board in boards for triangle in range(TRIANGLES)]
    module = np.repeat(np.arange(len(parts)), len(flat))
    return Surface(
        np.concatenate([position for position, _ in parts]),
        np.repeat([normal for _, normal in parts], len(flat), axis=0),
        module,
        module // TRIANGLES,
    )


def arm_path(board: int) -> Doubles:
    """Return (16, 3) the middles of a board's triangles in the order of a closed walk over them, m."""
    middle = np.zeros((1, 2))
    tour = _TOURS[board % _PARTS == _HAND]
    return np.concatenate([_triangle(board, triangle, middle)[0] for triangle in tour])


def _triangle(board: int, triangle: int, flat: Doubles) -> tuple[Doubles, Doubles]:
    """(k, 3) points of a triangle, given as (k, 2) in its plane; and its normal."""
    number, part = divmod(board, _PARTS)
    if part == _HAND:
        strip, along = divmod(triangle, _HAND_STRIP)
        up = -1.0 if strip < 2 else 1.0  # the palm is below
        normal = np.array([0.0, 0.0, up])
        centre = np.array([_WRIST_M, 0, 0]) + _HALF_HAND_M * normal
        across_m = (strip % 2 - 0.5) * _HEIGHT_M
    else:
        face, along = divmod(triangle, TRIANGLES // 2)
        angle = (2 * part + face) * (2 * np.pi / _FACES)
        normal = np.array([0.0, np.cos(angle), np.sin(angle)])
        centre = _AXIS_TO_FACE_M * normal
        across_m = 0.0
    u = np.array([1.0, 0.0, 0.0])
    v = np.cross(normal, u)
    turned = -1 if triangle % 2 else 1
    x = turned * flat[:, 0] + (along + 1) * SIDE_M / 2
    y = turned * flat[:, 1] + across_m - turned * _HEIGHT_M / 6
    position = centre + x[:, np.newaxis] * u + y[:, np.newaxis] * v
    position[:, 1] += number * _BETWEEN_ARMS_M
    return position, normal
