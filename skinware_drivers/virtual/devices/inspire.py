"""An emulated RH56DFTP hand of Inspire Robots, whose addresses count bytes.

Source: the maker's manual PRJ-02-TS-U-010 V1.0.0; the vectors in tests/modbus/test_inspire.py.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated

from msgspec import Meta

from skinware_drivers.virtual import Device, ModbusEmulator, Places, SerialEmulatorOptions, on_pads

_FINGER = ((3, 3), (12, 8), (10, 8))
_THUMB = ((3, 3), (12, 8), (3, 3), (12, 8))
_PALM = (8, 14)
_SHAPES = (*_FINGER * 4, *_THUMB, _PALM)
"""Rows and columns, in the order of the registers: little, ring, middle, index finger, thumb, palm."""


class EmulatedInspireOptions(SerialEmulatorOptions, frozen=True, forbid_unknown_fields=True, kw_only=True):
    unit: Annotated[int, Meta(ge=0, le=255, description="number of the hand")] = 1
    zero: Annotated[tuple[int, ...], Meta(description="matrices that send only 0: 1 to 17, the last is the palm")] = ()
    swapped: Annotated[bool, Meta(description="send the low byte of a register first")] = False


class EmulatedInspire(ModbusEmulator[EmulatedInspireOptions]):
    """One hand. Values: those of the taxels, matrix by matrix, each row by row."""

    full_scale = 4096
    rest = 12
    swing = 3000
    speed_mbit_s = 100
    step = 2
    numbered_by = "unit"

    def places(self) -> Places:
        return on_pads(*[(rows * columns, columns) for rows, columns in _SHAPES])

    def registers(self, device: Device, values: Sequence[int]) -> Mapping[int, int]:  # noqa: ARG002
        """Return the registers from 3000 on, two addresses each."""
        sent: list[int] = []
        for number, (rows, columns) in enumerate(_SHAPES, 1):
            n = rows * columns
            matrix = [0] * n if number in self.options.zero else list(values[len(sent) : len(sent) + n])
            if (rows, columns) == _PALM:
                matrix = [
                    matrix[row * columns + column] for column in range(columns) for row in range(rows - 1, -1, -1)
                ]
            sent += matrix
        if self.options.swapped:
            sent = [value >> 8 | (value & 0xFF) << 8 for value in sent]
        return {3000 + 2 * number: value for number, value in enumerate(sent)}
