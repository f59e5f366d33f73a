"""An emulated Revo3 hand of BrainCo: its registers, in one of its two mappings.

Source: BrainCoTech/brainco-revo3-sdk; the vectors in tests/modbus/test_revo3.py.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Literal

import numpy as np
import numpy.typing as npt
from msgspec import Meta

from skinware_drivers.virtual.emulator import Device, on_a_grid
from skinware_drivers.virtual.modbus_device import ModbusEmulator
from skinware_drivers.virtual.serial_device import SerialEmulatorOptions

_SHAPES = {4200: 36, 4250: 31, 4290: 57, 4350: 21, 4400: 52, 4460: 21, 4500: 52, 4560: 21, 4600: 52, 4660: 21, 4700: 52}
"""First register and number of taxels of each pad."""


class EmulatedRevo3Options(SerialEmulatorOptions, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What the hand is."""

    unit: Annotated[int, Meta(ge=1, le=254, description="its number")] = 127
    mapping: Annotated[Literal["pressure", "matrix"], Meta(description="which registers it has")] = "pressure"
    enabled: Annotated[bool, Meta(description="its pads are on as soon as it has power; else they tell 0")] = True


class EmulatedRevo3(ModbusEmulator[EmulatedRevo3Options]):
    """One hand. Values: those of the pads, one pad after the other."""

    full_scale = 0xFFFF
    rest = 40
    swing = 3000
    speed_mbit_s = 5

    def __init__(self, options: EmulatedRevo3Options, **more: object) -> None:
        self.numbers = (options.unit,)
        self.function = 4 if options.mapping == "pressure" else 3
        super().__init__(options, **more)

    def places(self) -> npt.NDArray[np.float64]:
        """All taxels."""
        return on_a_grid(416, 16)

    def registers(self, device: Device, values: Sequence[int]) -> Mapping[int, int]:
        """What is in no pad is 0."""
        is_matrix = self.options.mapping == "matrix"
        found = dict.fromkeys(range(5240, 5900) if is_matrix else range(4200, 4752), 0)
        if not device.memory.get("on", self.options.enabled):
            return found
        at = 0
        for number, (first, n) in enumerate(_SHAPES.items()):
            first = 5240 + 60 * number if is_matrix else first
            found.update(enumerate(values[at : at + n], first))
            at += n
        return found

    def written(self, device: Device, address: int, value: int) -> bool:
        """Switches of the pads, and what sets them to zero, which changes nothing here."""
        is_matrix = self.options.mapping == "matrix"
        if address in (range(5900, 5911) if is_matrix else range(4000, 4011)):
            device.memory["on"] = bool(value)
            return True
        return address == (5214 if is_matrix else 4011)


__all__ = ["EmulatedRevo3", "EmulatedRevo3Options"]
