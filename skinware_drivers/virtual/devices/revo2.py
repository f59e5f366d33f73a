"""An emulated Revo2 hand of BrainCo with touch, in one of its four editions.

Source: the registers that the maker's program bc_stark_sdk 2.0.8 reads and writes; the vectors in
tests/modbus/test_revo2.py.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta

from skinware_drivers.virtual import Device, ModbusEmulator, Places, SerialEmulatorOptions, on_a_grid, on_pads
from skinware_drivers.virtual.serial_device import text_registers

_EDITIONS = {"touch": 1, "pressure": 2, "array_pressure": 3, "force3d": 4}
_SWITCHES = {
    "touch": range(4000, 4005),
    "pressure": range(6200, 6206),
    "array_pressure": range(8000, 8001),
    "force3d": range(7001, 7005),
}
_OTHER_COMMANDS = {
    "touch": range(4005, 4015),
    "pressure": range(6310, 6316),
    "array_pressure": range(8010, 8017),
    "force3d": range(7006, 7010),
}
_N_VALUES = {"touch": 20, "pressure": 97, "array_pressure": 25, "force3d": 4 * 93 + 12}


class EmulatedRevo2Options(SerialEmulatorOptions, frozen=True, forbid_unknown_fields=True, kw_only=True):
    unit: Annotated[int, Meta(ge=1, le=254, description="number of the hand")] = 127
    side: Annotated[Literal["right", "left"], Meta(description="side that the hand reports")] = "right"
    edition: Annotated[
        Literal["touch", "pressure", "force3d", "array_pressure"], Meta(description="which sensors it has")
    ] = "touch"
    says_edition: Annotated[bool, Meta(description="it reports its edition, in register 970")] = True
    kind: Annotated[Literal[0, 1, 2], Meta(description="values of the pressure edition: raw, calibrated, force")] = 0
    enabled: Annotated[bool, Meta(description="touch is on as soon as the hand has power")] = True
    touch: Annotated[bool, Meta(description="it has touch; hands without take commands and have no data")] = True
    abnormal: Annotated[tuple[int, ...], Meta(description="fingers (0 to 4) whose status is 1, abnormal")] = ()
    missing: Annotated[tuple[int, ...], Meta(description="fingers (0 to 4) whose status is 2, no sensor")] = ()
    cold: Annotated[bool, Meta(description="array_pressure: its sensors never become warm")] = False


class EmulatedRevo2(ModbusEmulator[EmulatedRevo2Options]):
    """One hand. Values of the edition touch: force, tangential force and direction of each finger; then proximities.

    Values of the other editions: their registers in order; force3d has x, y and z of each point.
    """

    full_scale: int | Sequence[int] = [0xFFFE] * 15 + [0xFFFF_FFFE] * 5
    rest: int | Sequence[int] = [30, 5, 90] * 5 + [70_000] * 5
    swing: int | Sequence[int] = [2500, 300, 0] * 5 + [90_000] * 5
    function = 4
    numbered_by = "unit"

    def __init__(self, options: EmulatedRevo2Options, **more: object) -> None:
        if options.edition != "touch":
            self.full_scale, self.rest, self.swing = (127, 3, 90) if options.edition == "force3d" else (0xFFFF, 30, 900)
        super().__init__(options, **more)

    def places(self) -> Places:
        if self.options.edition == "touch":
            return np.concatenate([on_pads(*[(1, 1)] * 5, each=3), on_pads(*[(1, 1)] * 5)])
        return on_a_grid(_N_VALUES[self.options.edition], 12)

    def registers(self, device: Device, values: Sequence[int]) -> Mapping[int, int]:
        options = self.options
        on = options.touch and device.memory.get("on", options.enabled)
        if options.edition == "touch":
            words = list(values[:15])
            for proximity in values[15:]:
                words += [proximity >> 16, proximity & 0xFFFF]
            states = [1 if finger in options.abnormal else 2 if finger in options.missing else 0 for finger in range(5)]
            return dict(enumerate([*words, *states] if on else [0xFFFF] * 30, 4200))
        felt = values if on else [0] * len(values)
        if options.edition == "pressure":
            return (
                dict.fromkeys(range(6001, 6101), 0)
                | dict(enumerate(felt[:91], 6010))
                | dict(enumerate(felt[91:], 6001))
            )
        if options.edition == "array_pressure":
            status = {8020: 0, 8021: int(not options.cold)}
            return dict.fromkeys(range(8020, 8125), 0) | status | dict(enumerate(felt, 8100))
        found = dict.fromkeys(range(7100, 7562), 0)
        for first, address in zip(range(0, 5 * 93, 93), (7200, 7300, 7400, 7500, 7100), strict=True):
            x, y, z = felt[first : first + 93 : 3], felt[first + 1 : first + 93 : 3], felt[first + 2 : first + 93 : 3]
            for point, (along, across, normal) in enumerate(zip(x, y, z, strict=True)):
                found[address + 2 * point] = (along & 0xFF) << 8 | across & 0xFF
                found[address + 2 * point + 1] = normal
        return found

    def beside(self, device: Device) -> Mapping[int, int]:  # noqa: ARG002
        prefix = "BCXTL" if self.options.side == "left" else "BCXTR"
        return text_registers(3000, "1.0.14.U") | text_registers(3010, f"{prefix}0000000001")

    def of_other_function(self, device: Device) -> Mapping[int, int]:
        options = self.options
        on = int(options.touch and device.memory.get("on", options.enabled))
        found = {901: 2 if options.side == "left" else 1, **dict.fromkeys(_SWITCHES[options.edition], on)}
        if options.says_edition:
            found[970] = _EDITIONS[options.edition] if options.touch else 0
        if options.edition == "pressure":
            found[6000] = device.memory.get("kind", options.kind)
        return found

    def written(self, device: Device, address: int, value: int) -> bool:
        """Switch touch; accept calibrations, which change nothing here."""
        if address in _SWITCHES[self.options.edition]:
            device.memory["on"] = bool(value)
            return True
        if address == 6000 and self.options.edition == "pressure":
            device.memory["kind"] = value
            return True
        return address in _OTHER_COMMANDS[self.options.edition]
