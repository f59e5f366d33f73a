"""Sensor types: the shared catalogue, and the meaning of a driver's raw counts.

An identifier is ``vendor << 12 | number`` (20 + 12 bits), as in Skinware 2.0. Vendor 0 is the shared catalogue:
an algorithm that asks for ``pressure`` works with every skin whose driver uses it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from skinware.errors import StructureError

MAX_NAME_BYTES = 32
MAX_UNIT_BYTES = 16


@dataclass(frozen=True, slots=True)
class SensorType:
    """One sensor type as one driver delivers it.

    The physical value of a raw value is ``offset + scale * raw``, in ``unit``.

    Attributes:
        name: lower-case name, at most 32 bytes.
        id: ``vendor << 12 | number``; 0 is invalid.
        unit: unit of the physical value (``Pa``, ``counts`` where the hardware has no calibrated unit).
        scale: physical units per raw count.
        offset: physical value of raw 0.
        minimum: smallest physical value the sensor can report.
        maximum: largest physical value the sensor can report.

    Raises:
        StructureError: a name or unit that is empty or too long, an id of 0 or beyond 32 bits, a scale of 0.
    """

    name: str
    id: int
    unit: str
    scale: float = 1.0
    offset: float = 0.0
    minimum: float = -math.inf
    maximum: float = math.inf

    def __post_init__(self) -> None:
        if not self.name or len(self.name.encode()) > MAX_NAME_BYTES:
            raise StructureError(f"sensor type name {self.name!r}: give 1 to {MAX_NAME_BYTES} bytes")
        if len(self.unit.encode()) > MAX_UNIT_BYTES:
            raise StructureError(f"unit {self.unit!r} of type {self.name!r}: at most {MAX_UNIT_BYTES} bytes")
        if not 0 < self.id < 1 << 32:
            raise StructureError(f"id {self.id} of type {self.name!r}: give vendor << 12 | number, 1 to 2**32-1")
        if self.scale == 0 or not math.isfinite(self.scale) or not math.isfinite(self.offset):
            raise StructureError(f"type {self.name!r}: scale must be finite and not 0, offset finite")

    def measured(
        self,
        *,
        unit: str | None = None,
        scale: float = 1.0,
        offset: float = 0.0,
        minimum: float = -math.inf,
        maximum: float = math.inf,
    ) -> SensorType:
        """This catalogue type with the unit, scale and range of one driver's hardware."""
        return replace(
            self,
            unit=self.unit if unit is None else unit,
            scale=scale,
            offset=offset,
            minimum=minimum,
            maximum=maximum,
        )


PRESSURE = SensorType("pressure", 1, "Pa")
SHEAR_X = SensorType("shear_x", 2, "Pa")
SHEAR_Y = SensorType("shear_y", 3, "Pa")
PROXIMITY = SensorType("proximity", 4, "m")
TEMPERATURE = SensorType("temperature", 5, "degC")
ACCELERATION_X = SensorType("acceleration_x", 6, "m/s2")
ACCELERATION_Y = SensorType("acceleration_y", 7, "m/s2")
ACCELERATION_Z = SensorType("acceleration_z", 8, "m/s2")
ANGULAR_RATE_X = SensorType("angular_rate_x", 9, "rad/s")
ANGULAR_RATE_Y = SensorType("angular_rate_y", 10, "rad/s")
ANGULAR_RATE_Z = SensorType("angular_rate_z", 11, "rad/s")
MAGNETIC_FIELD_X = SensorType("magnetic_field_x", 12, "T")
MAGNETIC_FIELD_Y = SensorType("magnetic_field_y", 13, "T")
MAGNETIC_FIELD_Z = SensorType("magnetic_field_z", 14, "T")

FORCE_X = SensorType("force_x", 15, "N")
FORCE_Y = SensorType("force_y", 16, "N")
FORCE_Z = SensorType("force_z", 17, "N")
"""Along the normal of the skin, for devices that measure forces; ``force_x`` and ``force_y`` lie in the skin."""

ACCELERATION = (ACCELERATION_X, ACCELERATION_Y, ACCELERATION_Z)
ANGULAR_RATE = (ANGULAR_RATE_X, ANGULAR_RATE_Y, ANGULAR_RATE_Z)
MAGNETIC_FIELD = (MAGNETIC_FIELD_X, MAGNETIC_FIELD_Y, MAGNETIC_FIELD_Z)
FORCE = (FORCE_X, FORCE_Y, FORCE_Z)

CATALOGUE: dict[str, SensorType] = {
    t.name: t
    for t in (
        *(PRESSURE, SHEAR_X, SHEAR_Y, PROXIMITY, TEMPERATURE),
        *ACCELERATION,
        *ANGULAR_RATE,
        *MAGNETIC_FIELD,
        *FORCE,
    )
}
"""The types of vendor 0, by name."""

NOT_TOUCH = ("temperature", "acceleration", "angular_rate")
"""Beginnings of the names of types that no touch changes: their sensors are no taxels, and have no rest."""


def name_in_module(type_name: str, number: int, is_only: bool) -> str:
    """Return a sensor's name in its module, by its number from the lowest; empty: that of the module says all."""
    by_type = type_name.startswith(NOT_TOUCH)
    if is_only:
        return type_name if by_type else ""
    return f"{type_name if by_type else 'taxel'} {number}"
