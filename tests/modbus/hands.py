"""Modbus skins for tests: a small array, and a hand of two units with several matrices."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from skinware.sensor_types import PRESSURE
from skinware_drivers import Module, NoOptions, Patch, taxels
from skinware_drivers.modbus import ModbusAdapter, Registers
from skinware_drivers.virtual import Device, ModbusEmulator, SerialEmulatorOptions, on_a_grid

ARRAY_AT, N_ARRAY = 7, 36
MATRICES = (9, 96, 80, 45)
"""Taxels of the matrices of a finger, one after the other."""
FINGER_AT = 3000
UNITS = (1, 2)


class Array(ModbusAdapter[NoOptions]):
    """6 x 6 taxels in input registers."""

    types = (PRESSURE.measured(unit="counts", maximum=4095),)
    dtype = np.uint16
    patches = (Patch("array", [Module(taxels(N_ARRAY))]),)
    registers = (Registers(ARRAY_AT, N_ARRAY, function=4),)
    timeout_s = 0.03


class EmulatedArray(ModbusEmulator[SerialEmulatorOptions]):
    full_scale = 4095
    swing = 3000
    function = 4

    def places(self) -> npt.NDArray[np.float64]:
        return on_a_grid(N_ARRAY, columns=6)

    def registers(self, device: Device, values: Sequence[int]) -> Mapping[int, int]:
        return {7 + number: value for number, value in enumerate(values)}


def _finger(unit: int) -> Patch:
    first, modules = unit << 12, []
    for key, count in enumerate(MATRICES):
        modules.append(Module(taxels(count, first_uid=first), key=key, kind=f"matrix of {count}"))
        first += count
    return Patch(f"finger {unit}", modules, key=unit)


def _blocks(unit: int) -> list[Registers]:
    starts = [FINGER_AT + 2 * sum(MATRICES[:key]) for key in range(len(MATRICES))]
    return [
        Registers(start, count, unit=unit, patch=unit, module=key)
        for key, (start, count) in enumerate(zip(starts, MATRICES, strict=True))
    ]


class Hand(ModbusAdapter[NoOptions]):
    """Two fingers on one line, whose addresses count bytes."""

    types = (PRESSURE.measured(unit="counts", maximum=4095),)
    dtype = np.uint16
    address_step = 2
    timeout_s = 0.05
    patches = tuple(map(_finger, UNITS))
    registers = tuple(block for unit in UNITS for block in _blocks(unit))


class EmulatedHand(ModbusEmulator[SerialEmulatorOptions]):
    full_scale = 4095
    swing = 3000
    numbers = UNITS
    step = 2

    def places(self) -> npt.NDArray[np.float64]:
        return on_a_grid(230, columns=10)

    def registers(self, device: Device, values: Sequence[int]) -> Mapping[int, int]:
        return {3000 + 2 * number: value for number, value in enumerate(values)}
