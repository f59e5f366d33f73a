"""Emulated tactile arrays of DFRobot (SEN0704, SEN0705).

Source: DFRobot/DFRobot_TactileSensor; the vectors in tests/modbus/test_dfrobot.py.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta

from skinware.errors import ConfigurationError
from skinware_drivers.virtual import Device, ModbusEmulator, Places, SerialEmulatorOptions, on_a_grid


class EmulatedDfrobotOptions(SerialEmulatorOptions, frozen=True, forbid_unknown_fields=True, kw_only=True):
    units: Annotated[tuple[int, ...], Meta(description="numbers of the arrays")] = (1,)
    shapes: Annotated[tuple[Literal["4x8", "6x6"], ...], Meta(description="rows and columns of each, or of all")] = (
        "6x6",
    )
    unready: Annotated[tuple[int, ...], Meta(description="arrays that never become ready, and send 0")] = ()
    swapped: Annotated[bool, Meta(description="send the low byte of a register first")] = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self.shapes) not in (1, len(self.units)):
            raise ConfigurationError("option shapes: give one, or one for each of the units")


class EmulatedDfrobot(ModbusEmulator[EmulatedDfrobotOptions]):
    """Arrays on one line. Values: the cells of a 6x6, if any, then those of a 4x8, each from the top row down.

    An array uses those of its own shape.
    """

    full_scale: int = 4095
    rest = 20
    swing = 3000
    function = 4
    numbered_by = "units"

    def __init__(self, options: EmulatedDfrobotOptions, **more: object) -> None:
        shapes = options.shapes * len(options.units) if len(options.shapes) == 1 else options.shapes
        self._is_square = {unit: shape == "6x6" for unit, shape in zip(options.units, shapes, strict=True)}
        super().__init__(options, **more)

    def places(self) -> Places:
        of_shape = {True: on_a_grid(36, 6), False: on_a_grid(32, 8)}
        return np.concatenate([places for shape, places in of_shape.items() if shape in self._is_square.values()])

    def beside(self, device: Device) -> Mapping[int, int]:
        is_ready = device.number not in self.options.unready
        return self._sent({0: 0x0343, 1: 0x3343, 5: 0x1000, 6: int(is_ready), 43: int(self._is_square[device.number])})

    def registers(self, device: Device, values: Sequence[int]) -> Mapping[int, int]:
        is_square = self._is_square[device.number]
        columns = 6 if is_square else 8
        cells = values[:36] if is_square else values[-32:]
        if device.number in self.options.unready:
            cells = [0] * len(cells)
        rows = [cells[first : first + columns] for first in range(0, len(cells), columns)]
        return self._sent(dict(enumerate((cell for row in reversed(rows) for cell in row), 7)))

    def _sent(self, registers: Mapping[int, int]) -> Mapping[int, int]:
        if not self.options.swapped:
            return registers
        return {address: value >> 8 | (value & 0xFF) << 8 for address, value in registers.items()}
