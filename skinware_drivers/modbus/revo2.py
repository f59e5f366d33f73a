"""BrainCo's Revo2 hands with touch, in all four editions, over Modbus RTU. The driver asks the hand for its edition.

Sources:

* The maker's program bc_stark_sdk 2.0.8 (PyPI, MIT): its tables ``RegAddrRevo2`` and ``TouchVendor``, and its questions
  to a server whose registers hold their own numbers, on 2026-11-23.
* BrainCoTech/stark-serialport-example, commit b27b922 of 2026-04-16: status of a finger
  (``python/revo2/revo2_touch.py``), 0.01 N a count (``python/gui/realtime_monitor_panel.py``), mN of the Pressure
  edition (``c/demo/hand_monitor.cpp``) and its three kinds of values (``c/platform/linux/revo2_ec/ec_types.h``).

A proximity has 32 bits, the high word first, as bc_stark_sdk 2.0.8 reads it. One user's report has the low word first
(BrainCoTech/unitree-g1-brainco-hand, pull request 1, firmware 1.0.14.U); ``word_order=little`` of the bus reads that.
"""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from typing import Annotated, Literal, NamedTuple

import numpy as np
import numpy.typing as npt
from msgspec import Meta

from skinware.errors import BusError
from skinware.geometry import Geometry
from skinware.nominal_hand import FINGERS
from skinware.sensor_types import FORCE, FORCE_Z, PRESSURE, PROXIMITY, SensorType
from skinware.status import Status
from skinware_drivers.description import Module, Patch, Sensor, taxels
from skinware_drivers.fields import AnyFlag, Flag, Sentinel
from skinware_drivers.hand import Grid, Hand
from skinware_drivers.layout import Values
from skinware_drivers.link import Link
from skinware_drivers.modbus.adapter import ExplainingWatch, ModbusAdapter
from skinware_drivers.modbus.registers import Registers
from skinware_drivers.modbus.wire import READ_INPUT
from skinware_drivers.operations import operation
from skinware_drivers.options import Options
from skinware_drivers.polling import Notice

_Side = Literal["right", "left"]
_UNITS: dict[_Side, int] = {"right": 127, "left": 126}
_LEFT_SKUS = (2, 4)
_SWITCHING_S, _CALIBRATING_S = 0.3, 0.5
_LOOK_S, _LONGEST_S = 1.0, 60.0

EditionName = Literal["touch", "pressure", "force3d", "array_pressure"]
_SIDE_AT, _EDITION_AT, _KIND_AT, _FIRMWARE_AT, _SERIAL_AT = 901, 970, 6000, 3000, 3010
_FORCES_AT = 4200
_NO_FORCE = 0xFFFF
_NO_PROXIMITY = 0xFFFF_FFFF

_VENDOR = 0x7E07F << 12
_TANGENTIAL = SensorType("tangential_force", _VENDOR | 1, "N", scale=1e-2, minimum=0)
_DIRECTION = SensorType("force_direction", _VENDOR | 2, "counts", minimum=0)
_SUMS = tuple(SensorType(f"total_force_{axis}", _VENDOR | 3 + n, "counts") for n, axis in enumerate("xyz"))
_SUM = SensorType("total_force_z", _VENDOR | 5, "N", scale=1e-3, minimum=0)
_MOMENTS = tuple(SensorType(f"moment_{axis}", _VENDOR | 6 + n, "counts", minimum=0) for n, axis in enumerate("xy"))
_POINTS_OF_PRESSURE = (
    PRESSURE.measured(unit="counts", minimum=0),
    PRESSURE.measured(scale=1000, minimum=0),
    FORCE_Z.measured(scale=1e-3, minimum=0),
)


class _Edition(NamedTuple):
    """The command registers of an edition: the first, and how many; None: it has no such registers."""

    switches: tuple[int, int]
    calibration: tuple[int, int]
    reset: tuple[int, int] | None = None


_EDITIONS: dict[EditionName, _Edition] = {
    "touch": _Edition((4000, 5), (4010, 5), (4005, 5)),
    "pressure": _Edition((6200, 6), (6310, 6)),
    "array_pressure": _Edition((8000, 1), (8010, 1)),
    "force3d": _Edition((7001, 4), (7006, 4)),
}
"""In the order of their numbers in register 970, from 1 on."""


_Content = tuple[Sequence[SensorType], Sequence[Module], Sequence[Registers]]
"""Sensor types, modules, and the registers of each module."""


def _touch(unit: int, with_status: bool) -> _Content:
    force = FORCE_Z.measured(scale=1e-2, minimum=0)
    types = (force, _TANGENTIAL, _DIRECTION, PROXIMITY.measured(unit="counts", minimum=0))
    modules, registers = list[Module](), list[Registers]()
    for finger, name in enumerate(FINGERS):
        channels = [Sensor(kind.name, finger) for kind in types[:3]]
        modules.append(Module(channels, finger, "1x1", f"{name} tip"))
        registers.append(_of_touch(unit, finger, finger, 3 * finger, ">u2", 3, _NO_FORCE, with_status))
    for finger, name in enumerate(FINGERS):
        modules.append(Module([Sensor(PROXIMITY.name, finger)], 5 + finger, "1x1", f"{name} proximity"))
        place = 15 + 2 * finger
        registers.append(_of_touch(unit, 5 + finger, finger, place, ">u4", 1, _NO_PROXIMITY, with_status))
    return types, modules, registers


def _of_touch(
    unit: int, module: int, finger: int, place: int, dtype: str, count: int, none: int, with_status: bool
) -> Registers:
    """Read all thirty registers for some values and a finger's status: 0 normal, 1 abnormal, 2 no sensor."""
    flags: list[AnyFlag] = [Sentinel(Status.NOT_CONNECTED, none)]
    if not with_status:
        words = count * (2 if dtype == ">u4" else 1)
        return Registers(_FORCES_AT + place, words, unit, READ_INPUT, dtype[1:], patch=0, module=module, flags=flags)
    said = 2 * (25 + finger)
    flags += [Flag(Status.NOT_CONNECTED, said, ">u2", mask=2), Flag(Status.SUSPECT, said, ">u2", mask=0xFFFD)]
    values = [Values(2 * place, dtype, count)]
    return Registers(_FORCES_AT, 30, unit, READ_INPUT, patch=0, module=module, flags=flags, values=values)


def _pressure(unit: int, kind: int) -> _Content:
    """Nine points on each finger and 46 on the palm: raw (kind 0), kPa (1) or mN (2); and the sum of each of them."""
    point = _POINTS_OF_PRESSURE[kind]
    parts = [*((f"{finger} tip", 9) for finger in FINGERS), ("palm", 46)]
    modules, registers, first = list[Module](), list[Registers](), 6010
    for key, (name, count) in enumerate(parts):
        modules.append(Module(taxels(count, point.name, first_uid=key << 8), key, f"{count} points", name))
        registers.append(Registers(first, count, unit, READ_INPUT, patch=0, module=key))
        first += count
    sums = taxels(len(parts), _SUM.name)
    modules.append(Module(sums, len(parts), "sums", "sums"))
    registers.append(Registers(6001, len(parts), unit, READ_INPUT, patch=0, module=len(parts)))
    return (point, _SUM), modules, registers


def _force3d(unit: int) -> _Content:
    """Three forces at 31 points of four fingers, and their sums: x and y in the bytes of a register, z in the next."""
    axes = tuple(axis.measured(unit="counts") for axis in FORCE)
    modules, registers = list[Module](), list[Registers]()
    for finger, name in enumerate(FINGERS[1:]):
        channels = taxels(31, *(axis.name for axis in axes), first_uid=finger << 8)
        modules.append(Module(channels, finger, "31 points", f"{name} tip"))
        registers.append(_of_forces(unit, finger, 7200 + 100 * finger, 31))
    modules.append(Module(taxels(4, *(axis.name for axis in _SUMS)), 4, "sums", "sums"))
    registers.append(_of_forces(unit, 4, 7100, 4))
    return (*axes, *_SUMS), modules, registers


def _of_forces(unit: int, module: int, address: int, points: int) -> Registers:
    values = []
    for point in range(points):
        values += [
            Values(4 * point, "i1", 2, to=[3 * point, 3 * point + 1]),
            Values(4 * point + 2, ">u2", 1, to=[3 * point + 2]),
        ]
    return Registers(address, 2 * points, unit, READ_INPUT, patch=0, module=module, values=values)


def _array_pressure(unit: int) -> _Content:
    """Three forces and two moments of five fingers; suspect until the sensors are warm (8021)."""
    types = (*(axis.measured(unit="counts", minimum=0) for axis in FORCE), *_MOMENTS)
    cold = Flag(Status.SUSPECT, 2, ">u2", mask=0xFFFF, normal=1)
    modules, registers = list[Module](), list[Registers]()
    for finger, name in enumerate(FINGERS):
        modules.append(Module([Sensor(kind.name, finger) for kind in types], finger, "force", f"{name} tip"))
        values = [Values(2 * (80 + 5 * finger), ">u2", 5)]
        registers.append(Registers(8020, 105, unit, READ_INPUT, patch=0, module=finger, flags=[cold], values=values))
    return types, modules, registers


class Revo2Options(Options, frozen=True):
    side: Annotated[_Side | None, Meta(description="which hand it is; default: the hand is asked")] = None
    unit: Annotated[
        Annotated[int, Meta(ge=1, le=254)] | None,
        Meta(description="its number; default: 127 of a right hand or 126 of a left one, as one answers"),
    ] = None
    edition: Annotated[
        EditionName | None, Meta(description="which sensors the hand has; default: the hand is asked")
    ] = None
    status: Annotated[
        bool, Meta(description="touch: read along the status of each finger's sensor; no: the values alone")
    ] = True
    period_ms: Annotated[float, Meta(ge=1, le=10_000, description="time between two readings")] = 20
    enable: Annotated[
        bool, Meta(description="switch touch on, at the beginning and when the hand has restarted: writes registers")
    ] = False


_NO_DATA = (
    "fingers have no data: touch is not switched on (--enable, or the operation enable), or the hand says that there is"
    " no sensor (4225 to 4229)"
)


class Revo2Watch(ExplainingWatch):
    meanings = ((Status.NOT_CONNECTED, _NO_DATA),)


class _SaidEdition(NamedTuple):
    """The edition that the hand reports, and the kind of values of the Pressure edition."""

    edition: EditionName
    kind: int = 0


class Revo2Driver(ModbusAdapter[Revo2Options]):
    dtype: npt.DTypeLike = np.float32
    baudrate = 460_800
    timeout_s = 0.03
    largest_gap = 80
    asks_first = True
    watch = Revo2Watch

    def __init__(self, options: Revo2Options) -> None:
        self._unit = options.unit or _UNITS[options.side or "right"]
        self._said = _SaidEdition(options.edition or "touch")
        self._is_asked = False
        self._declare(self._said, options.side or "right", with_status=options.status)
        super().__init__(options)

    async def describe(self, link: Link) -> Sequence[Patch]:
        """Ask the hand for its side and edition; while only listening, use the options."""
        options, side = self.options, self.options.side
        if not link.listen_only:
            if self.options.unit is None and self.options.side is None:
                self._unit = await self.find_unit(link, tuple(_UNITS.values()), _EDITION_AT)
            side = side or await self._ask_side(link)
            self._said, self._is_asked = await self._look(link), True
            names = await self._ask_names(link)
            link.log.info("unit %d, %s hand, edition %s, %s", self._unit, side, self._said.edition, names)
        self._declare(self._said, side or "right", with_status=options.status and not link.listen_only)
        self.use_registers(self.registers)
        return self.patches

    async def configure(self, link: Link) -> None:
        if self.options.enable:
            await self._set(link, _EDITIONS[self._said.edition].switches, _SWITCHING_S)

    async def attend(self, link: Link) -> None:
        """Notice when the hand sends another edition, or when touch is off that this driver has to switch on."""
        pause_s = _LOOK_S
        while not link.listen_only:
            await asyncio.sleep(pause_s)
            is_off = False
            if self._is_asked and (said := await self._look(link)) != self._said:
                link.log.warning("the hand sends something else now: %s", said)
                self.tell(self.patches[0], Notice.CHANGED)
            elif self.options.enable and (is_off := await self._is_off(link)):
                self.tell(self.patches[0], Notice.RESTARTED)
            pause_s = min(2 * pause_s, _LONGEST_S) if is_off else _LOOK_S

    @operation(sets_up=True)
    async def enable(self, link: Link, patches: Sequence[Patch]) -> None:  # noqa: ARG002
        """Switch touch on: write 1 to the switches of the edition (4000 to 4004 of touch)."""
        await self._set(link, _EDITIONS[self._said.edition].switches, _SWITCHING_S)

    @operation(sets_up=True)
    async def calibrate(self, link: Link, patches: Sequence[Patch]) -> None:  # noqa: ARG002
        """Take the present values as untouched: nothing may touch the hand. Ignore the values of the next 10 s."""
        await self._set(link, _EDITIONS[self._said.edition].calibration, _CALIBRATING_S)

    @operation(sets_up=True)
    async def reset(self, link: Link, patches: Sequence[Patch]) -> None:  # noqa: ARG002
        """Set the sensors' channels up again (4005 to 4009, edition touch): nothing may touch the hand."""
        registers = _EDITIONS[self._said.edition].reset
        if registers is None:
            raise BusError(f"hands of the edition {self._said.edition} have no such registers")
        await self._set(link, registers, _CALIBRATING_S)

    @operation(looks=True)
    async def names(self, link: Link, patches: Sequence[Patch]) -> str:  # noqa: ARG002
        """Return serial number and firmware as the hand reports them."""
        return await self._ask_names(link)

    async def _set(self, link: Link, registers: tuple[int, int], takes_s: float) -> None:
        address, count = registers
        await self.write(link, address, [1] * count, unit=self._unit)
        await asyncio.sleep(takes_s)

    async def _ask_side(self, link: Link) -> _Side:
        said = await self.read_or_none(link, _SIDE_AT, unit=self._unit)
        if said is None:
            return "left" if self._unit == _UNITS["left"] else "right"
        return "left" if said[0] in _LEFT_SKUS else "right"

    async def _look(self, link: Link) -> _SaidEdition:
        edition = self.options.edition
        if edition is None:
            said = await self.read_or_none(link, _EDITION_AT, unit=self._unit)
            number = said[0] if said else 0
            if number > len(_EDITIONS):
                raise BusError(f"{link.bus_name}: register 970 says {number}: no edition that this driver reads")
            edition = list(_EDITIONS)[number - 1] if number else "touch"  # 0: old firmware
        if edition != "pressure":
            return _SaidEdition(edition)
        kind = await self.read_or_none(link, _KIND_AT, unit=self._unit)
        if kind and kind[0] > 2:
            raise BusError(f"{link.bus_name}: register 6000 says {kind[0]}: neither raw, calibrated nor force")
        return _SaidEdition(edition, kind[0] if kind else 0)

    async def _is_off(self, link: Link) -> bool:
        if self._said.edition == "touch":
            forces = await self.read(link, _FORCES_AT, 15, unit=self._unit, function=READ_INPUT)
            return bool((forces == _NO_FORCE).all())
        address, count = _EDITIONS[self._said.edition].switches
        return not (await self.read(link, address, count, unit=self._unit)).any()

    async def _ask_names(self, link: Link) -> str:
        found = []
        for what, address in (("serial number", _SERIAL_AT), ("firmware", _FIRMWARE_AT)):
            said = await self.read_or_none(link, address, 10, unit=self._unit, function=READ_INPUT) or ()
            text = b"".join(register.to_bytes(2, "big") for register in said).decode("ascii", "replace")
            found.append(f"{what} {''.join(one for one in text if one.isprintable()) or 'not said'}")
        return ", ".join(found)

    def _declare(self, said: _SaidEdition, side: _Side, *, with_status: bool) -> None:
        if said.edition == "touch":
            content = _touch(self._unit, with_status)
        elif said.edition == "pressure":
            content = _pressure(self._unit, said.kind)
        else:
            content = (_force3d if said.edition == "force3d" else _array_pressure)(self._unit)
        types, modules, registers = content
        self.types: Sequence[SensorType] = types
        self.registers: Sequence[Registers] = registers
        self.patches: Sequence[Patch] = [Patch(f"{side} hand", modules)]
        self.geometry: Geometry | None = _places(Hand(side), modules)


def _places(hand: Hand, modules: Sequence[Module]) -> Geometry:
    """Return nominal places: points of a fingertip in rows of three, of a palm in rows of six."""
    found = []
    for module in modules:
        if module.name == "sums":
            continue
        sensors = [sensor for sensor in module.channels if sensor is not None]
        uids = list(dict.fromkeys(sensor.uid for sensor in sensors))
        columns = 6 if module.name == "palm" else min(3, len(uids))
        grid = Grid(-(-len(uids) // columns), columns)
        [centre] = hand.down(module.name.split()[0], [grid])
        found.append(grid.at(centre, list(dict.fromkeys(sensor.type_name for sensor in sensors)), uids))
    return Geometry.joined(found)
