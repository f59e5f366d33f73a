"""An emulated Revo3 hand of BrainCo, with registers in the three mappings that its maker's programs read.

Source: BrainCoTech/brainco-revo3-sdk 7ba96eb (2026-08-03), and the questions of bc-revo3-sdk 1.5.1 and 2.3.2; the
vectors in tests/modbus/test_revo3.py.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta

from skinware_drivers.virtual import Device, ModbusEmulator, Places, SerialEmulatorOptions, on_a_grid, on_pads
from skinware_drivers.virtual.serial_device import text_registers

_PRESSURE = {
    4200: 36,
    4250: 31,
    4290: 57,
    4350: 21,
    4400: 52,
    4460: 21,
    4500: 52,
    4560: 21,
    4600: 52,
    4660: 21,
    4700: 52,
}
"""First register and number of taxels of each pad."""
_ROWS = {
    36: "12345 012345 012345 0345 0345 0345 035 045 5",
    31: "0134 01345 012345 012345 012345 6 6 6 6",
    57: 8 * "01234 " + "123 12" + 4 * " 567",
    21: "123 123 1234 1234 1234 5 5 5",
    52: "15 1234 1234 01234" + 5 * " 12345" + 4 * " 567",
}
"""Columns with taxels in each row of a pad of so many, by the maker's program."""
_MATRIX = (53, 56, 22, 22, 27, 22, 27, 22, 27, 22, 27)
_PACKED_AT = (5240, 5340, 5380, 5440, 5480, 5540, 5580, 5640, 5680, 5740, 5780)
_VALUES = {"adc": 0, "raw": 1, "force": 2}
_SERIAL_NUMBER = "BCUTR40000000001"
_KIND = "4023"  # in the memory of a device: content of that register


class EmulatedRevo3Options(SerialEmulatorOptions, frozen=True, forbid_unknown_fields=True, kw_only=True):
    unit: Annotated[int, Meta(ge=1, le=254, description="number of the hand")] = 1
    side: Annotated[Literal["right", "left"], Meta(description="side that the hand reports")] = "right"
    mapping: Annotated[Literal["pressure", "matrix", "packed"], Meta(description="which registers it has")] = "pressure"
    says_mapping: Annotated[bool, Meta(description="it reports its mapping, in register 135")] = True
    points: Annotated[tuple[int, ...], Meta(description="taxels of its pads, if not the usual ones")] = ()
    sums: Annotated[bool, Meta(description="mapping pressure: it sends sums of zones")] = False
    values: Annotated[Literal["adc", "raw", "force"], Meta(description="kind of its values")] = "adc"
    adc_pads: Annotated[tuple[int, ...], Meta(description="matrix, packed: pads of values=force that send adc")] = ()
    enabled: Annotated[bool, Meta(description="its pads are on as soon as it has power; else they send 0")] = True


class EmulatedRevo3(ModbusEmulator[EmulatedRevo3Options]):
    """One hand. Values: those of the pads, one pad after the other; or those of the 42 zones."""

    full_scale = 0xFFFF
    rest = 40
    swing = 3000
    speed_mbit_s = 5
    numbered_by = "unit"

    def __init__(self, options: EmulatedRevo3Options, **more: object) -> None:
        self.function = 4 if options.mapping == "pressure" else 3
        if options.mapping == "packed":
            self.full_scale, self.swing = 0xFF, 150
        self._points = options.points or (tuple(_PRESSURE.values()) if options.mapping == "pressure" else _MATRIX)
        super().__init__(options, **more)

    def places(self) -> Places:
        if self.options.sums:
            return on_a_grid(42, 16)
        if self.options.mapping != "pressure" or not set(self._points) <= set(_ROWS):
            return on_pads(*[(points, 6) for points in self._points])
        rows = [(pad, *row) for pad, n in enumerate(self._points) for row in enumerate(_ROWS[n].split())]
        return np.array([(int(column) / 16, row / 16, pad) for pad, row, columns in rows for column in columns])

    def registers(self, device: Device, values: Sequence[int]) -> Mapping[int, int]:
        """Return the registers of the data; those of no pad are 0."""
        options = self.options
        if options.mapping != "pressure":
            found = dict.fromkeys(range(5240, 5900), 0)
        elif self._sends_sums(device):
            found = dict.fromkeys(range(4100, 4142), 0)
        else:
            found = dict.fromkeys(range(4200, 4752), 0)
        if not device.memory.get("on", options.enabled):
            return found
        if min(found) == 4100:
            return dict(enumerate((*values, *[0] * 42)[:42], 4100))
        at = 0
        for number, n in enumerate(self._points):
            of_pad = values[at : at + n]
            if options.mapping == "packed":
                pairs = [*of_pad, 0][: n + n % 2]
                words = [first << 8 | second for first, second in zip(pairs[::2], pairs[1::2], strict=True)]
                found.update(enumerate(words, _PACKED_AT[number]))
            else:
                first = 5240 + 60 * number if options.mapping == "matrix" else [*_PRESSURE][number]
                found.update(enumerate(of_pad, first))
            at += n
        return found

    def beside(self, device: Device) -> Mapping[int, int]:
        """Return the settings of a matrix hand, or the names and the unused part of a pressure hand."""
        if self.options.mapping != "pressure":
            return self._settings(device)
        not_filled = range(4200, 4752) if self._sends_sums(device) else range(4100, 4142)
        return dict.fromkeys(not_filled, 0) | _TEXTS

    def of_other_function(self, device: Device) -> Mapping[int, int]:
        """Return the settings of a pressure hand, or the names of a matrix hand."""
        return self._settings(device) if self.options.mapping == "pressure" else _TEXTS

    def written(self, device: Device, address: int, value: int) -> bool:
        """Write the switches and modes of the pads; accept the zero command, which changes nothing here."""
        is_matrix = self.options.mapping != "pressure"
        if address in (range(5900, 5911) if is_matrix else range(4000, 4011)):
            device.memory["on"] = bool(value)
            return True
        if address in (range(5202, 5214) if is_matrix else (4023, 4024)):
            device.memory[str(address)] = value
            device.memory.pop("sample", None)
            return True
        return address == (5214 if is_matrix else 4011)

    def _sends_sums(self, device: Device) -> bool:
        return bool(device.memory.get(_KIND, self.options.sums))

    def _settings(self, device: Device) -> dict[int, int]:
        options = self.options
        is_matrix, on = options.mapping != "pressure", int(device.memory.get("on", options.enabled))
        # the maker's program asks for the limits of joints
        said = dict.fromkeys([*range(240, 261), *range(270, 291)], 0)
        said |= {101: 1 if options.side == "right" else 2, 108: options.unit}
        if options.says_mapping:
            said[135] = 2 if is_matrix else 1
        said.update(dict.fromkeys(range(5900, 5911) if is_matrix else range(4000, 4011), on))
        said.update(enumerate(self._points, 5191 if is_matrix else 4037))
        if is_matrix:
            modes = [int(options.values == "force" and pad not in options.adc_pads) for pad in range(11)]
            said.update(enumerate([int(options.values == "force"), *modes], 5202))
            said[5226] = 0
        else:
            said.update({4023: int(self._sends_sums(device)), 4024: _VALUES[options.values]})
        return {address: device.memory.get(str(address), value) for address, value in said.items()}


_TEXTS = text_registers(3030, "1.0.0") | text_registers(3040, "1.0") | text_registers(3050, _SERIAL_NUMBER)
"""Firmware, hardware and serial number, read with function 4."""
