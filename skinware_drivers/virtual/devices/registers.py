"""Emulated Modbus devices: Inspire's hand RH56DFTP, DFRobot's tactile arrays, and BrainCo's hands Revo2 and Revo3.

Sources, with the vectors in tests/modbus:

* RH56DFTP, whose addresses count bytes: the maker's manual PRJ-02-TS-U-010 V1.0.0. Untouched, a good matrix of an
  owner's hand is not all 0 (AlexArutiunian/tactile-rh56dftp 8eb83a3, 2026-05-15); how far from it is not published.
* SEN0704 and SEN0705: DFRobot/DFRobot_TactileSensor.
* Revo2 in one of its four editions: the registers that the maker's program bc_stark_sdk 2.0.8 reads and writes.
* Revo3, with registers in the three mappings that its maker's programs read: BrainCoTech/brainco-revo3-sdk 7ba96eb
  (2026-08-03), and the questions of bc-revo3-sdk 1.5.1 and 2.3.2.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta

from skinware.errors import ConfigurationError
from skinware_drivers.virtual import Device, ModbusEmulator, Places, SerialEmulatorOptions, on_a_grid, on_pads


def _sent(registers: Mapping[int, int], swapped: bool) -> Mapping[int, int]:
    """Return registers as they are sent: possibly with the low byte first."""
    if not swapped:
        return registers
    return {address: value >> 8 | (value & 0xFF) << 8 for address, value in registers.items()}


_FINGER = ((3, 3), (12, 8), (10, 8))
_THUMB = ((3, 3), (12, 8), (3, 3), (12, 8))
_PALM = (8, 14)
_SHAPES = (*_FINGER * 4, *_THUMB, _PALM)
"""Rows and columns, in the order of the registers: little, ring, middle, index finger, thumb, palm."""
_AT_REST = tuple(4 * (not place) for rows, columns in _SHAPES for place in range(rows * columns))
"""One taxel of each matrix is not at 0."""


class EmulatedInspireOptions(SerialEmulatorOptions, frozen=True):
    unit: Annotated[int, Meta(ge=0, le=255, description="number of the hand")] = 1
    zero: Annotated[tuple[int, ...], Meta(description="matrices that send only 0: 1 to 17, the last is the palm")] = ()
    swapped: Annotated[bool, Meta(description="send the low byte of a register first")] = False


class EmulatedInspire(ModbusEmulator[EmulatedInspireOptions]):
    """One hand. Values: those of the taxels, matrix by matrix, each row by row."""

    full_scale = 4096
    rest = _AT_REST
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
        return _sent({3000 + 2 * number: value for number, value in enumerate(sent)}, self.options.swapped)


class EmulatedDfrobotOptions(SerialEmulatorOptions, frozen=True):
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
        said = {0: 0x0343, 1: 0x3343, 5: 0x1000, 6: int(is_ready), 43: int(self._is_square[device.number])}
        return _sent(said, self.options.swapped)

    def registers(self, device: Device, values: Sequence[int]) -> Mapping[int, int]:
        is_square = self._is_square[device.number]
        columns = 6 if is_square else 8
        cells = values[:36] if is_square else values[-32:]
        if device.number in self.options.unready:
            cells = [0] * len(cells)
        rows = [cells[first : first + columns] for first in range(0, len(cells), columns)]
        return _sent(dict(enumerate((cell for row in reversed(rows) for cell in row), 7)), self.options.swapped)


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


class EmulatedRevo2Options(SerialEmulatorOptions, frozen=True):
    unit: Annotated[int, Meta(ge=1, le=254, description="number of the hand")] = 127
    side: Annotated[Literal["right", "left"], Meta(description="side that the hand reports")] = "right"
    edition: Annotated[
        Literal["touch", "pressure", "force3d", "array_pressure"], Meta(description="which sensors it has")
    ] = "touch"
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
        return _text(3000, "1.0.14.U") | _text(3010, f"{prefix}0000000001")

    def of_other_function(self, device: Device) -> Mapping[int, int]:
        options = self.options
        on = int(options.touch and device.memory.get("on", options.enabled))
        found = {901: 2 if options.side == "left" else 1, **dict.fromkeys(_SWITCHES[options.edition], on)}
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


class EmulatedRevo3Options(SerialEmulatorOptions, frozen=True):
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


def _text(address: int, text: str) -> dict[int, int]:
    """Return ten registers with a text: address -> two letters, the first in the high byte."""
    data = text.encode().ljust(20, b"\0")
    return {address + place: int.from_bytes(data[2 * place : 2 * place + 2], "big") for place in range(10)}


_TEXTS = _text(3030, "1.0.0") | _text(3040, "1.0") | _text(3050, _SERIAL_NUMBER)
"""Firmware, hardware and serial number, read with function 4."""
