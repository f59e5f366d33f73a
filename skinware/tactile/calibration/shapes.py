"""Find the shapes of rigid modules, and the poses that bring a shape onto measured places."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from skinware.tactile.arrays import Doubles, Whole

LEAST_TAXELS = 4
"""Measured places that the pose of a module needs."""
_OUTLIER_M = 0.002
_ROUNDS = 5
_FLAT = 0.02  # share of the first extent of a shape below which its second makes it a line, which has no side up


@dataclass(frozen=True)
class Shape:
    """The shape of a module, in axes of its own.

    Attributes:
        taxel: (k,) its taxels.
        place_m: (k, 3) their places, with the mean at 0.
        normal: (k, 3) of length 1, NaN where it is not known.
    """

    taxel: Whole
    place_m: Doubles
    normal: Doubles


def shapes_of(
    module: npt.NDArray[np.integer], kind: Sequence[str], position_m: Doubles, normal: Doubles
) -> dict[int, Shape]:
    """Return the shapes of modules, by number, where the places of all of their taxels are known.

    A module without places has the shape of one of the same kind with as many taxels, in the same order.

    Args:
        module: (n,) module of each taxel.
        kind: kind of each module, by its number; empty: like no other.
        position_m: (n, 3), NaN where it is not known.
        normal: (n, 3), NaN where it is not known.
    """
    shapes: dict[int, Shape] = {}
    like: dict[tuple[str, int], Shape] = {}
    numbers = np.unique(module).tolist()
    for number in numbers:
        taxel = np.flatnonzero(module == number)
        places = position_m[taxel]
        if not np.isfinite(places).all() or not _has_extent(places):
            continue
        shapes[number] = Shape(taxel, places - places.mean(axis=0), normal[taxel])
        like.setdefault((kind[number], len(taxel)), shapes[number])
    for number in numbers:
        taxel = np.flatnonzero(module == number)
        lent = like.get((kind[number], len(taxel))) if kind[number] else None
        if number not in shapes and lent is not None:
            shapes[number] = Shape(taxel, lent.place_m, lent.normal)
    return shapes


def _has_extent(places: Doubles) -> bool:
    """Whether places determine a pose: they are neither on a line nor at one point."""
    if len(places) < LEAST_TAXELS:
        return False
    extents = np.linalg.svd(places - places.mean(axis=0), compute_uv=False)
    return bool(extents[1] > _FLAT * extents[0] > 0)


@dataclass(frozen=True)
class Pose:
    """The pose of a module: (3, 3) rotation and (3,) origin, m."""

    rotation: Doubles
    origin_m: Doubles

    def places_m(self, shape: Shape) -> Doubles:
        """Return (k, 3) the places of the taxels of a shape."""
        places: Doubles = shape.place_m @ self.rotation.T + self.origin_m
        return places

    def normals(self, shape: Shape) -> Doubles:
        """Return (k, 3) their normals."""
        normals: Doubles = shape.normal @ self.rotation.T
        return normals


def fitted(shape: Shape, measured_m: Doubles, weight: Doubles) -> Pose | None:
    """Return the pose that brings a shape onto measured places; None if they are too few, or on a line.

    Places far from where the shape says lose their weight: 1 / (1 + (distance / 2 mm)^2), in 5 rounds.

    Args:
        shape: shape of the module.
        measured_m: (k, 3) places of its taxels, NaN where there is none.
        weight: (k,) weight of each.
    """
    known = np.isfinite(measured_m).all(axis=1) & (weight > 0)
    if known.sum() < LEAST_TAXELS or not _has_extent(shape.place_m[known]):
        return None
    source, target, given = shape.place_m[known], measured_m[known], weight[known] / weight[known].sum()
    now = given
    for _ in range(_ROUNDS):
        pose = rigid(source, target, now)
        distance = np.linalg.norm(source @ pose.rotation.T + pose.origin_m - target, axis=1)
        now = given / (1 + (distance / _OUTLIER_M) ** 2)
    return pose


def rigid(source: Doubles, target: Doubles, weight: Doubles) -> Pose:
    """Return the pose that brings (k, 3) places onto others, by weighted least squares (Procrustes)."""
    share = weight / weight.sum()
    from_m, to_m = share @ source, share @ target
    u, _, vt = np.linalg.svd((target - to_m).T @ ((source - from_m) * share[:, None]))
    turn = np.diag([1.0, 1.0, np.linalg.det(u) * np.linalg.det(vt)])
    rotation = u @ turn @ vt
    return Pose(rotation, to_m - rotation @ from_m)
