"""Write a calibration as a geometry file: a group with a confidence for each module, and a head with the residuals."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from msgspec.structs import replace

from skinware.geometry import GeometryGroup
from skinware.structure import Structure
from skinware.tactile.arrays import Doubles, Flags, Whole
from skinware.tactile.calibration.placing import Placement
from skinware.tactile.calibration.topology import Topology, unrolled_m

_DIGITS = 6


def confidence_of(error_m: Doubles, pitch_m: float) -> float:
    """Return the share of sensors within half a pitch of their places, if errors along the skin are normal.

    ``error_m`` is (k,) m, the expected error of each, root of the mean square.
    """
    within = 1 - np.exp(-((pitch_m / 2 / np.maximum(error_m, 1e-9)) ** 2))
    return round(float(within.mean()), 3)


def placed_groups(
    structure: Structure, type_name: str, placement: Placement, frame: str, pitch_m: float
) -> list[GeometryGroup]:
    """Return the groups of a geometry file, one for each module that has any place.

    Places are in the order of the structure, in the coordinate frame ``frame``; the pitch, m, is for confidences.
    """
    found, error_m = placement, placement.error_m
    groups = _groups(structure, type_name, found.known, found.position_m, found.normal, frame)
    return [replace(group, confidence=confidence_of(error_m[rows], pitch_m)) for group, rows in groups]


def unrolled_groups(structure: Structure, type_name: str, topology: Topology) -> list[GeometryGroup]:
    """Return the groups of a geometry file in which each piece of skin is a flat map of its own.

    The topology is in the order of the structure.
    """
    groups: list[GeometryGroup] = []
    for piece in range(topology.n_pieces):
        is_known = (topology.piece == piece) & topology.linked
        taxels = np.flatnonzero(is_known)
        position = np.full((len(topology.piece), 3), np.nan)
        position[taxels, :2], position[taxels, 2] = unrolled_m(topology, taxels), 0
        normal = np.full_like(position, np.nan)
        frame = f"piece {piece + 1}"
        groups += [group for group, _ in _groups(structure, type_name, is_known, position, normal, frame)]
    return groups


def placed_comment(structure: Structure, type_name: str, placement: Placement) -> str:
    """Return the quality of a placement in words: of the presses, and of each patch."""
    index = structure.patch_of(type_name)
    wrong = int(placement.wrong.sum())
    presses, residual = f"{len(placement.residual_m)} presses, {wrong} of them left out", 1e3 * placement.spread_m
    lines = [f"{presses}; median residual of the others {residual:.1f} mm", *placement.tool.words()]
    for patch, name in enumerate(structure.patch_names):
        of_patch = index == patch
        known = of_patch & placement.known
        if known.any():
            error_mm = 1e3 * np.median(placement.error_m[known])
            lines.append(f"{name}: {known.sum()} of {of_patch.sum()} placed, expected error {error_mm:.1f} mm")
        elif of_patch.any():
            lines.append(f"{name}: not placed")
    return "\n".join(lines)


def unrolled_comment(topology: Topology) -> str:
    """Return the contents of a file of maps in words."""
    sizes = ", ".join(str(int((topology.piece == piece).sum())) for piece in range(topology.n_pieces))
    lost, loose = int((topology.piece < 0).sum()), int(((topology.piece >= 0) & ~topology.linked).sum())
    return (
        "Found by stroking alone: each piece of skin is unrolled onto a plane of its own, and may be mirrored.\n"
        f"Pieces: {topology.n_pieces}, of {sizes or 'no'} sensors; not known: {lost};"
        f" neighbours: {len(topology.pairs)} pairs"
        + (f"\nNot placed: {loose} that were hardly felt together with the rest of their piece" if loose else "")
    )


def _groups(
    structure: Structure, type_name: str, wanted: Flags, position_m: Doubles, normal: Doubles, frame: str
) -> Iterator[tuple[GeometryGroup, Whole]]:
    """Yield a group for each module of wanted taxels, and these taxels."""
    uid, module = structure.sensor_uid[structure.index(type_name)], structure.module_of(type_name)
    for number in np.unique(module[wanted]).tolist():
        rows = np.flatnonzero(wanted & (module == number))
        places, normals = (
            tuple((x, y, z) for x, y, z in np.round(of[rows], _DIGITS).tolist()) for of in (position_m, normal)
        )
        group = GeometryGroup(
            type=type_name,
            frame=frame,
            uid=tuple(uid[rows].tolist()),
            position_m=places,
            normal=normals if np.isfinite(normal[rows]).all() else None,
            name=structure.module_names[number],
        )
        yield group, rows
