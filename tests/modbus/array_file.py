"""A driver and its emulated device in a file of their own, as a person writes them first."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from skinware.sensor_types import PRESSURE
from skinware_drivers import Module, NoOptions, Patch, taxels
from skinware_drivers.modbus import ModbusAdapter, Registers
from skinware_drivers.virtual import Device, ModbusEmulator, SerialEmulatorOptions, on_a_grid


class Array(ModbusAdapter[NoOptions]):
    types = (PRESSURE.measured(unit="counts", maximum=4095),)
    dtype = np.uint16
    patches = (Patch("array", [Module(taxels(36))]),)
    registers = (Registers(7, 36, function=4),)


class EmulatedArray(ModbusEmulator[SerialEmulatorOptions]):
    full_scale = 4095
    swing = 3000
    function = 4

    def places(self) -> npt.NDArray[np.float64]:
        return on_a_grid(36, columns=6)

    def registers(self, device: Device, values: Sequence[int]) -> Mapping[int, int]:
        return {7 + number: value for number, value in enumerate(values)}
