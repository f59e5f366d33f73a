"""Two tactile fingertips over Modbus, and their emulator: skin-driver --driver ./fingertips.py --bus virtual."""

from collections.abc import Mapping, Sequence

import numpy as np

from skinware.sensor_types import PRESSURE
from skinware_drivers import Module, NoOptions, Patch, taxels
from skinware_drivers.modbus import ModbusAdapter, Registers
from skinware_drivers.virtual import Device, ModbusEmulator, SerialEmulatorOptions, on_a_grid


class Fingertips(ModbusAdapter[NoOptions]):
    """Two matrices of 6 x 6 taxels in input registers, of units 1 and 2 on one line."""

    types = (PRESSURE.measured(unit="counts", maximum=4095),)
    dtype = np.uint16
    period_s = 0.02
    patches = tuple(Patch(f"finger {unit}", [Module(taxels(36, first_uid=unit << 8))], key=unit) for unit in (1, 2))
    registers = tuple(Registers(7, 36, unit=unit, function=4, patch=unit) for unit in (1, 2))


class EmulatedFingertips(ModbusEmulator[SerialEmulatorOptions]):
    numbers = (1, 2)  # units
    function = 4
    full_scale = 4095
    swing = 3000

    def places(self):
        return on_a_grid(36, columns=6)

    def registers(self, device: Device, values: Sequence[int]) -> Mapping[int, int]:
        return {7 + number: value for number, value in enumerate(values)}
