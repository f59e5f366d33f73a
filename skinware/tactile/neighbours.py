"""Find which taxels lie beside and between which, and which touched taxels hang together."""

from __future__ import annotations

import ctypes
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from skinware import native
from skinware.errors import ConfigurationError
from skinware.geometry import Geometry
from skinware.native import give_arrays, read_structs
from skinware.tactile.arrays import Arrays, Doubles, Flags, Whole

STRUCTS = read_structs([Path(native.__file__).with_name("contacts.h")])
"""The structs of contacts.h."""
_components = native.core().quick.skinware_components
_components.argtypes = ctypes.c_void_p, ctypes.c_int64, *(ctypes.c_void_p,) * 2
_components.restype = ctypes.c_int64

NONE = -1
"""Fills up the rows of a table."""

_REACH = 1.8  # pitches within which taxels are neighbours: two rings of a lattice of squares or triangles
_OPPOSITE = -0.2  # scalar product of two normals below which their taxels lie on different sides of a thin part
_MOST_AT_ONE_PLACE = 32  # taxels at one place: files give a place to more of them only where their places are not known
_MOST_CANDIDATES = 10_000_000
_MOST_CELLS = 1 << 62
_PITCH_SAMPLE = 128

Table = npt.NDArray[np.int32]


def neighbours(geometry: Geometry, radius_m: float | None = None) -> Table:
    """Find (n, k) int32 the taxels within a radius of each other, in one frame, and not on opposite sides of a part.

    Taxels at one place are neighbours. A taxel without a known place has none, nor has one of more than 32 that share
    a place: files have such places for taxels whose real ones are not known.

    Args:
        geometry: places of the n taxels, in their order.
        radius_m: m; default: in each frame 1.8 times its pitch (:func:`pitch_m`).

    Raises:
        ConfigurationError: a radius that is not above 0, or so large that nearly all taxels are neighbours; places too
            far apart for it.
    """
    n = len(geometry)
    if radius_m is None:
        radius = pitch_m(geometry) * _REACH
        radius[np.isnan(radius)] = 1.0  # one place in the frame, or none
    elif 0 < radius_m < np.inf:
        radius = np.full(n, float(radius_m))
    else:
        raise ConfigurationError(f"neighbours within {radius_m} m: give a radius above 0")
    rows, frame = _placed(geometry)
    one, other = _pairs_within_1(frame, geometry.position_m[rows] / radius[rows, None])
    return _table(*_on_one_side(geometry.normal, rows[one], rows[other]), n)


def posed(geometry: Geometry, poses: Mapping[str, npt.ArrayLike]) -> Geometry:
    """Return a geometry with the places of several frames in one, so that contacts across their border are found.

    Args:
        geometry: places of n taxels. Those in frames without a pose stay.
        poses: by name of a frame, (4, 4) its pose in the one that they share, ``common``.

    Raises:
        ConfigurationError: a pose that is not (4, 4) finite numbers.
    """
    position, normal, frames = geometry.position_m.copy(), geometry.normal.copy(), geometry.frame.astype(object)
    for name, given in poses.items():
        pose = np.asarray(given, np.float64)
        if pose.shape != (4, 4) or not np.isfinite(pose).all():
            raise ConfigurationError(f"pose of frame {name!r}: give (4, 4) finite numbers")
        rows = geometry.frame == name
        position[rows] = position[rows] @ pose[:3, :3].T + pose[:3, 3]
        normal[rows] = normal[rows] @ pose[:3, :3].T
        frames[rows] = "common"
    return replace(geometry, position_m=position, normal=normal, frame=frames.astype(str))


def neighbours_of_pairs(pairs: npt.ArrayLike, n: int) -> Table:
    """Make (n, k) int32, a table of neighbours, from a topology.

    Args:
        pairs: (m, 2) integers, taxels that lie beside each other, in any order and any number of times.
        n: number of taxels.

    Raises:
        ConfigurationError: not pairs of integers from 0 to n - 1.
    """
    given = np.asarray(pairs)
    if not given.size:
        given = np.zeros((0, 2), np.int64)
    if given.ndim != 2 or given.shape[1] != 2 or given.dtype.kind not in "iu":
        raise ConfigurationError(f"pairs of neighbours: give (m, 2) integers, not {given.shape} of {given.dtype}")
    outside = ((given < 0) | (given >= n)).any(axis=1)
    if outside.any():
        row = int(np.argmax(outside))
        raise ConfigurationError(f"pair {row} of neighbours, {given[row].tolist()}: there are only {n} taxels")
    one, other = given.astype(np.int64).T
    return _table(one[one != other], other[one != other], n)


def pitch_m(geometry: Geometry) -> Doubles:
    """Return (n,) m the pitch of each taxel's frame, the median distance from a place to the nearest other on its side.

    NaN where the place is not known, or is the only one of its frame.
    """
    pitch = np.full(len(geometry), np.nan)
    rows, frame = _placed(geometry)
    for number in np.unique(frame):
        of_frame = rows[frame == number]
        places, first = np.unique(geometry.position_m[of_frame], axis=0, return_index=True)
        normal = geometry.normal[of_frame[first]]
        sample = np.unique(np.linspace(0, len(places) - 1, _PITCH_SAMPLE).astype(np.int64))
        squares = np.zeros((len(sample), len(places)))
        for axis in range(3):
            squares += (places[sample, axis, None] - places[None, :, axis]) ** 2
        squares[np.arange(len(sample)), sample] = np.inf
        squares[normal[sample] @ normal.T < _OPPOSITE] = np.inf
        nearest = squares.min(axis=1)
        if np.isfinite(nearest).any():
            pitch[of_frame] = np.sqrt(np.median(nearest[np.isfinite(nearest)]))
    return pitch


def area_m2(geometry: Geometry) -> Doubles:
    """Return (n,) m2 the area of skin that each taxel stands for, an estimate from the pitch of its frame.

    A frame counts as a lattice of triangles if enough places have five or more others at the pitch, else as one of
    squares. Taxels at one place share its area. NaN where :func:`pitch_m` is.
    """
    area = np.full(len(geometry), np.nan)
    rows, frame = _placed(geometry)
    if not len(rows):
        return area
    pitch = pitch_m(geometry)[rows]
    places, first, place, sharing = np.unique(
        np.column_stack([frame, geometry.position_m[rows]]),
        axis=0,
        return_index=True,
        return_inverse=True,
        return_counts=True,
    )
    at_pitch = places[:, 1:] / np.where(np.isnan(pitch), 1.0, 1.2 * pitch)[first, None]
    one, other = _on_one_side(geometry.normal[rows[first]], *_pairs_within_1(frame[first], at_pitch))
    beside = np.bincount(np.concatenate([one, other]), minlength=len(places))
    for number in np.unique(frame):
        is_triangles = np.percentile(beside[frame[first] == number], 90, method="higher") >= 5
        of_frame = frame == number
        area[rows[of_frame]] = pitch[of_frame] ** 2 * (np.sqrt(0.75) if is_triangles else 1.0)
    area[rows] /= sharing[place.reshape(-1)]
    return area


def _placed(geometry: Geometry) -> tuple[Whole, Whole]:
    rows = np.flatnonzero(np.isfinite(geometry.position_m).all(axis=1))
    _, frame = np.unique(geometry.frame[rows].astype(str), return_inverse=True)
    if not len(rows):
        return rows, frame
    _, place, sharing = np.unique(
        np.column_stack([frame, geometry.position_m[rows]]), axis=0, return_inverse=True, return_counts=True
    )
    own = sharing[place.reshape(-1)] <= _MOST_AT_ONE_PLACE
    return rows[own], frame[own]


def _on_one_side(normal: Doubles, one: Whole, other: Whole) -> tuple[Whole, Whole]:
    """The pairs that do not lie on opposite sides of a part, as far as their normals are known."""
    opposite = np.einsum("ij,ij->i", normal[one], normal[other]) < _OPPOSITE
    return one[~opposite], other[~opposite]


def _pairs_within_1(frame: Whole, places: Doubles) -> tuple[Whole, Whole]:
    """All pairs of rows of one frame whose places are at most 1 apart, each pair once.

    Places are sorted into cells of side 1. The keys of the cells along z follow each other, so that one search finds
    three cells.
    """
    nothing = np.zeros(0, np.int64)
    if not len(places):
        return nothing, nothing
    corner = places - places.min(axis=0)
    sizes = [int(size) + 4 for size in corner.max(axis=0)]
    if (int(frame.max()) + 1) * sizes[0] * sizes[1] * sizes[2] > _MOST_CELLS:
        raise ConfigurationError("places too far apart for the radius of neighbours: is one of them not in metres?")
    x, y, z = corner.astype(np.int64).T + 1
    key = ((frame * sizes[0] + x) * sizes[1] + y) * sizes[2] + z
    order = np.argsort(key, kind="stable")
    key = key[order]
    ones, others, count = [], [], 0
    for column in (0, sizes[2], sizes[1] * sizes[2], (sizes[1] - 1) * sizes[2], (sizes[1] + 1) * sizes[2]):
        first = np.searchsorted(key, key + column - 1) if column else np.arange(1, len(key) + 1)
        last = np.searchsorted(key, key + column + 1, side="right")
        length = last - first
        count += int(length.sum())
        if count > _MOST_CANDIDATES:
            raise ConfigurationError("nearly all taxels are neighbours: give a smaller radius")
        ones.append(np.repeat(np.arange(len(key)), length))
        others.append(np.arange(len(ones[-1])) + np.repeat(first - (np.cumsum(length) - length), length))
    one, other = order[np.concatenate(ones)], order[np.concatenate(others)]
    near = ((places[one] - places[other]) ** 2).sum(axis=1) <= 1.0
    return one[near], other[near]


def _table(one: Whole, other: Whole, n: int) -> Table:
    pairs = np.sort(np.concatenate([one * n + other, other * n + one]))  # np.unique sorts ten times as long
    pairs = pairs[np.diff(pairs, prepend=-1) > 0]
    row, neighbour = pairs // max(n, 1), pairs % max(n, 1)
    return _filled(row, neighbour, n)


def _filled(row: Whole, number: npt.NDArray[np.integer], n: int) -> Table:
    """A table with numbers in n rows, given row by row."""
    count = np.bincount(row, minlength=n)
    table = np.full((n, int(count.max(initial=0))), NONE, np.int32)
    table[row, np.arange(len(row)) - (np.cumsum(count) - count)[row]] = number
    return table


def checked(table: npt.NDArray[Any], n: int) -> Table:
    """Return a table of neighbours of n taxels, made symmetric.

    Raises:
        ConfigurationError: another number of rows, or numbers outside -1 to n - 1.
    """
    if table.ndim != 2 or len(table) != n or table.dtype.kind not in "iu":
        raise ConfigurationError(
            f"neighbours of {n} taxels: give ({n}, k) integers, not {table.shape} of {table.dtype}"
        )
    row, column = np.nonzero(table != NONE)
    return neighbours_of_pairs(np.column_stack([row, table[row, column].astype(np.int64)]), n)


class Components:
    """Finds the components of touched taxels.

    Touched taxels of one module that have no neighbours at all hang together; without modules, each is alone.

    Args:
        n: number of taxels.
        neighbours: (n, k) int, -1 fills its rows; None: not known.
        module: (n,) int, the module of each taxel.

    Attributes:
        at: address of its ``struct components``, for C.

    Raises:
        ConfigurationError: the table is not one of n taxels.
    """

    def __init__(self, n: int, neighbours: npt.NDArray[Any] | None, module: npt.NDArray[Any] | None = None) -> None:
        table = np.zeros((n, 0), np.int32) if neighbours is None else checked(neighbours, n)
        row, column = np.nonzero(table > np.arange(n)[:, None])
        forward = _filled(row, table[row, column], n)  # each pair once, in the row of the lower number
        lonely, of_module = np.flatnonzero((table == NONE).all(axis=1)), np.full(n, NONE, np.int64)
        if module is not None:
            of_module[lonely] = np.unique(module[lonely], return_inverse=True)[1]
        given: Arrays = {"forward": forward, "module": of_module, "root": np.full(n, NONE, np.int64)}
        given["first"] = np.full(int(of_module.max(initial=NONE)) + 1, NONE, np.int64)
        self._words = words = STRUCTS["Components"]()
        words.n, words.width = n, forward.shape[1]
        self._kept = give_arrays(words, n, {}, given)
        self.at: int = ctypes.addressof(words)

    def of(self, touched: Whole) -> tuple[Whole, int]:
        """Return (m,) int64 the component of each of m taxels, counted from 0 in their order; and their number.

        ``touched`` is (m,) int64, ascending.
        """
        given, found = np.ascontiguousarray(touched, np.int64), np.zeros(len(touched), np.int64)
        return found, int(_components(self.at, len(given), given.ctypes.data, found.ctypes.data))


def without_holes(touched: Flags, neighbours: npt.NDArray[Any]) -> Flags:
    """Return (n,) bool the touched taxels and their holes: taxels most of whose (n, k) neighbours are among them.

    At the edge of a skin taxels have few neighbours. There, the number of such neighbours must be more than half of the
    usual number, or the result would grow along the edge.
    """
    is_neighbour = neighbours != NONE
    count = is_neighbour.sum(axis=1)
    usual = np.percentile(count, 90) if len(count) else 0
    enough = np.maximum(count, usual) / 2
    found = touched.astype(bool)
    while True:
        inside = (found[neighbours] & is_neighbour).sum(axis=1)
        holes = ~found & (inside > enough)
        if not holes.any():
            return found
        found |= holes
