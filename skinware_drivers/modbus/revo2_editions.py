"""The registers of the touch editions of BrainCo's Revo2 hand, and what their values are.

Sources:

* The maker's program bc_stark_sdk 2.0.8 (PyPI, MIT): its tables ``RegAddrRevo2`` and ``TouchVendor``, and what it reads
  and writes as a client of a server whose registers hold their own numbers, on 2026-11-23.
* BrainCoTech/stark-serialport-example, commit b27b922 of 2026-04-16: status of a finger
  (``python/revo2/revo2_touch.py``), 0.01 N a count (``python/gui/realtime_monitor_panel.py``), mN of the Pressure
  edition (``c/demo/hand_monitor.cpp``) and its three kinds of values (``c/platform/linux/revo2_ec/ec_types.h``).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple

from skinware.sensor_types import FORCE, FORCE_Z, PRESSURE, PROXIMITY, SensorType
from skinware.status import Status
from skinware_drivers.description import Module, Sensor, taxels
from skinware_drivers.hand import FINGERS
from skinware_drivers.layout import AnyFlag, Flag, Sentinel, Values
from skinware_drivers.modbus.registers import Registers
from skinware_drivers.modbus.wire import READ_INPUT

EditionName = Literal["touch", "pressure", "force3d", "array_pressure"]
SIDE_AT, EDITION_AT, KIND_AT, FIRMWARE_AT, SERIAL_AT = 901, 970, 6000, 3000, 3010
FORCES_AT = 4200
NO_FORCE = 0xFFFF
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


class Edition(NamedTuple):
    """One edition.

    Attributes:
        switches: first of the registers that switch its sensors on, and how many there are.
        calibration: first of those that take the present values as untouched, and how many.
        reset: likewise, of those that set the sensors' channels up anew; None: it has none.
    """

    switches: tuple[int, int]
    calibration: tuple[int, int]
    reset: tuple[int, int] | None = None


EDITIONS: dict[EditionName, Edition] = {
    "touch": Edition((4000, 5), (4010, 5), (4005, 5)),
    "pressure": Edition((6200, 6), (6310, 6)),
    "array_pressure": Edition((8000, 1), (8010, 1)),
    "force3d": Edition((7001, 4), (7006, 4)),
}
"""In the order of their numbers in the register 970, from 1 on."""


class Content(NamedTuple):
    """What a hand sends: types, modules, and the registers of each module."""

    types: Sequence[SensorType]
    modules: Sequence[Module]
    registers: Sequence[Registers]


def content(edition: EditionName, unit: int, *, kind: int = 0, with_status: bool = True) -> Content:
    """What a hand of an edition sends.

    Args:
        edition: of the hand.
        unit: its number on the line.
        kind: of the values of the Pressure edition: 0 raw, 1 pressure (kPa), 2 force (mN).
        with_status: read along what fingers say of themselves.
    """
    make = {"touch": _touch, "pressure": _pressure, "force3d": _force3d, "array_pressure": _array_pressure}[edition]
    return make(unit, kind, with_status)


def _touch(unit: int, _kind: int, with_status: bool) -> Content:
    force = FORCE_Z.measured(scale=1e-2, minimum=0)
    types = (force, _TANGENTIAL, _DIRECTION, PROXIMITY.measured(unit="counts", minimum=0))
    modules, registers = list[Module](), list[Registers]()
    for finger, name in enumerate(FINGERS):
        channels = [Sensor(kind.name, finger) for kind in types[:3]]
        modules.append(Module(channels, finger, "1x1", f"{name} tip"))
        registers.append(_of_touch(unit, finger, finger, 3 * finger, ">u2", 3, NO_FORCE, with_status))
    for finger, name in enumerate(FINGERS):
        modules.append(Module([Sensor(PROXIMITY.name, finger)], 5 + finger, "1x1", f"{name} proximity"))
        place = 15 + 2 * finger
        registers.append(_of_touch(unit, 5 + finger, finger, place, ">u4", 1, _NO_PROXIMITY, with_status))
    return Content(types, modules, registers)


def _of_touch(
    unit: int, module: int, finger: int, place: int, dtype: str, count: int, none: int, with_status: bool
) -> Registers:
    """All thirty registers, of which a module has some values and a status: 0 normal, 1 abnormal, 2 no sensor there."""
    flags: list[AnyFlag] = [Sentinel(Status.NOT_CONNECTED, none)]
    if not with_status:
        words = count * (2 if dtype == ">u4" else 1)
        return Registers(FORCES_AT + place, words, unit, READ_INPUT, dtype[1:], patch=0, module=module, flags=flags)
    said = 2 * (25 + finger)
    flags += [Flag(Status.NOT_CONNECTED, said, ">u2", mask=2), Flag(Status.SUSPECT, said, ">u2", mask=0xFFFD)]
    values = [Values(2 * place, dtype, count)]
    return Registers(FORCES_AT, 30, unit, READ_INPUT, patch=0, module=module, flags=flags, values=values)


def _pressure(unit: int, kind: int, _with_status: bool) -> Content:
    """Nine points on each finger and 46 on the palm, and the sum of each of them."""
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
    return Content((point, _SUM), modules, registers)


def _force3d(unit: int, _kind: int, _with_status: bool) -> Content:
    """Three forces at 31 points of four fingers, and their sums: x and y in the bytes of a register, z in the next."""
    axes = tuple(axis.measured(unit="counts") for axis in FORCE)
    modules, registers = list[Module](), list[Registers]()
    for finger, name in enumerate(FINGERS[1:]):
        channels = taxels(31, *(axis.name for axis in axes), first_uid=finger << 8)
        modules.append(Module(channels, finger, "31 points", f"{name} tip"))
        registers.append(_of_forces(unit, finger, 7200 + 100 * finger, 31))
    modules.append(Module(taxels(4, *(axis.name for axis in _SUMS)), 4, "sums", "sums"))
    registers.append(_of_forces(unit, 4, 7100, 4))
    return Content((*axes, *_SUMS), modules, registers)


def _of_forces(unit: int, module: int, address: int, points: int) -> Registers:
    values = []
    for point in range(points):
        values += [
            Values(4 * point, "i1", 2, to=[3 * point, 3 * point + 1]),
            Values(4 * point + 2, ">u2", 1, to=[3 * point + 2]),
        ]
    return Registers(address, 2 * points, unit, READ_INPUT, patch=0, module=module, values=values)


def _array_pressure(unit: int, _kind: int, _with_status: bool) -> Content:
    """Three forces and two moments of five fingers; suspect until the sensors are warm (8021)."""
    types = (*(axis.measured(unit="counts", minimum=0) for axis in FORCE), *_MOMENTS)
    cold = Flag(Status.SUSPECT, 2, ">u2", mask=0xFFFF, normal=1)
    modules, registers = list[Module](), list[Registers]()
    for finger, name in enumerate(FINGERS):
        modules.append(Module([Sensor(kind.name, finger) for kind in types], finger, "force", f"{name} tip"))
        values = [Values(2 * (80 + 5 * finger), ">u2", 5)]
        registers.append(Registers(8020, 105, unit, READ_INPUT, patch=0, module=finger, flags=[cold], values=values))
    return Content(types, modules, registers)
