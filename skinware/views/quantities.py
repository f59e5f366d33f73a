"""What the sensors of a driver measure at a place: one value, and where the hardware tells it, shear beside it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from skinware._columns import Index
from skinware.geometry import Geometry
from skinware.sensor_types import PRESSURE, SHEAR_X, SHEAR_Y, SensorType
from skinware.structure import Structure
from skinware.tactile.neighbours import pitch_m


@dataclass(frozen=True, eq=False)
class Quantity:
    """A picture of a skin: n taxels, each with a value, and with a vector where sensors of three axes lie together.

    Attributes:
        name: for people: ``pressure``; ``force`` of ``force_x``, ``force_y`` and ``force_z``.
        type: of the value: of three axes the one along the normal.
        index: (n,) int64, positions in a frame of the n sensors that tell the values.
        where: the same, as a slice where it is one.
        geometry: places of the n taxels.
        axes: names of the types of the two axes within the skin; none where the skin has no such sensors.
        shear: (n, 2) int64, positions of the sensors of these axes, -1 where there is none.
    """

    name: str
    type: SensorType
    index: npt.NDArray[np.int64]
    where: Index
    geometry: Geometry
    axes: tuple[str, ...]
    shear: npt.NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.index)

    @cached_property
    def pitch_m(self) -> float:
        """From a taxel to the nearest other, usually, m; NaN where places are not known."""
        pitch = pitch_m(self.geometry)
        pitch = pitch[pitch > 0]
        return float(np.median(pitch)) if len(pitch) else float("nan")


def quantities_of(structure: Structure) -> tuple[Quantity, ...]:
    """All pictures that there are of a skin, in the order of its types; at least one."""
    types = {t.name: t for t in structure.types if (structure.sensor_type == t.id).any()}
    names: dict[str, str] = {}
    axes: dict[str, tuple[str, str]] = {}
    for name in types:
        prefix = name.removesuffix("_z")
        beside = (SHEAR_X.name, SHEAR_Y.name) if name == PRESSURE.name else (f"{prefix}_x", f"{prefix}_y")
        if (prefix != name or name == PRESSURE.name) and types.keys() >= set(beside):
            names[name], axes[name] = prefix, beside
    shown = [name for name in types if not any(name in pair for pair in axes.values())]
    positions = np.arange(structure.n_sensors)
    return tuple(
        Quantity(
            names.get(name, name),
            types[name],
            positions[structure.index(name)],
            structure.index(name),
            _geometry(structure, name),
            axes.get(name, ()),
            _beside(structure, name, axes.get(name, ())),
        )
        for name in shown
    )


def _geometry(structure: Structure, name: str) -> Geometry:
    where = structure.index(name)
    if structure.geometry is not None:
        return structure.geometry[where]
    uid = structure.sensor_uid[where]
    return Geometry.unknown([name] * len(uid), uid)


def _beside(structure: Structure, name: str, axes: tuple[str, ...]) -> npt.NDArray[np.int64]:
    """(n, 2) positions of the sensors of two axes that have the uids of those of a type; (n, 0) without axes."""
    uid = structure.sensor_uid[structure.index(name)].tolist()
    columns = []
    for axis in axes:
        positions = np.arange(structure.n_sensors)[structure.index(axis)].tolist()
        of_uid = dict(zip(structure.sensor_uid[positions].tolist(), positions, strict=True))
        columns.append([of_uid.get(one, -1) for one in uid])
    return np.array(columns, np.int64).reshape(len(axes), len(uid)).T
