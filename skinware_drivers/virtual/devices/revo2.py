"""An emulated Revo2 Touch hand of BrainCo: its registers.

Source: BrainCoTech/unitree-g1-brainco-hand, pull request 1; the vectors in tests/modbus/test_revo2.py.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated

import numpy as np
import numpy.typing as npt
from msgspec import Meta

from skinware_drivers.virtual.emulator import Device, on_a_grid
from skinware_drivers.virtual.modbus_device import ModbusEmulator
from skinware_drivers.virtual.serial_device import SerialEmulatorOptions


class EmulatedRevo2Options(SerialEmulatorOptions, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What the hand is."""

    unit: Annotated[int, Meta(ge=1, le=254, description="its number")] = 127
    enabled: Annotated[bool, Meta(description="touch is on as soon as the hand has power")] = True
    touch: Annotated[bool, Meta(description="it is a hand with touch; others take commands and have no data")] = True


class EmulatedRevo2(ModbusEmulator[EmulatedRevo2Options]):
    """One hand. Values: force, tangential force and direction of each finger from the thumb on; then proximities."""

    full_scale: int | Sequence[int] = [0xFFFE] * 15 + [0xFFFF_FFFE] * 5
    rest: int | Sequence[int] = [30, 5, 90] * 5 + [70_000] * 5
    swing: int | Sequence[int] = [2500, 300, 0] * 5 + [90_000] * 5
    function = 4

    def __init__(self, options: EmulatedRevo2Options, **more: object) -> None:
        self.numbers = (options.unit,)
        super().__init__(options, **more)

    def places(self) -> npt.NDArray[np.float64]:
        """Five fingers beside each other."""
        return np.concatenate([on_a_grid(5, 5, each=3), on_a_grid(5, 5)])

    def registers(self, device: Device, values: Sequence[int]) -> Mapping[int, int]:
        """30 input registers from 4200 on; the last five count."""
        if not (self.options.touch and device.memory.get("on", self.options.enabled)):
            return dict.fromkeys(range(4200, 4230), 0xFFFF)
        words = list(values[:15])
        for proximity in values[15:]:
            words += [proximity & 0xFFFF, proximity >> 16]
        return dict(enumerate([*words, device.cycle & 0xFFFF, 0, 0, 0, 0], 4200))

    def written(self, device: Device, address: int, value: int) -> bool:
        """Switches of touch, and of the calibration, which changes nothing here."""
        if 4000 <= address <= 4004:
            device.memory["on"] = bool(value)
        return 4000 <= address <= 4004 or 4010 <= address <= 4014


__all__ = ["EmulatedRevo2", "EmulatedRevo2Options"]
