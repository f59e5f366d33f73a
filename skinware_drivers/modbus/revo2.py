"""BrainCo's Revo2 Touch hand (capacitive): force and proximity of five fingertips, over Modbus RTU.

Source: what a user has read on a hand with firmware 1.0.14.U (BrainCoTech/unitree-g1-brainco-hand, pull request 1). No
manual of the registers is public. Input registers from 4200 on, for each finger from the thumb to the little one:
normal force, tangential force, its direction; then for each finger the proximity, 32 bits, low word first. FFFF: none.

Touch has to be switched on: 1 into the holding registers 4000 to 4004. As no document of the maker tells so, the driver
does that only if the option ``enable`` or the operation of that name wants it. 1 into 4010 to 4014 calibrates.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Sequence
from typing import Annotated, Literal

import msgspec
import numpy as np
import numpy.typing as npt
from msgspec import Meta

from skinware.geometry import Geometry
from skinware.sensor_types import PRESSURE, PROXIMITY, SensorType
from skinware.status import Status
from skinware_drivers.decoding.skin_state import Updates
from skinware_drivers.description import Module, Patch, Sensor, SkinTables
from skinware_drivers.hand import FINGERS, Grid, Hand
from skinware_drivers.layout import Sentinel
from skinware_drivers.link import Link
from skinware_drivers.modbus.adapter import ModbusAdapter
from skinware_drivers.modbus.registers import Order, Registers
from skinware_drivers.modbus.wire import READ_INPUT
from skinware_drivers.notice import Notice
from skinware_drivers.operations import operation
from skinware_drivers.options import check_options
from skinware_drivers.watch import Watch
from skinware_drivers.zero_watch import ZeroWatch

log: logging.Logger = logging.getLogger("skinware.driver")

_VENDOR = 0x7E07F << 12
TANGENTIAL = SensorType("tangential_force", _VENDOR | 1, "counts", minimum=0)
DIRECTION = SensorType("force_direction", _VENDOR | 2, "counts", minimum=0)
"""Of the tangential force. In which unit and from where on it counts is not known, nor the end of any range: a firm
press has a force of about 2500, and is to be seen."""
_FORCES = ("pressure", TANGENTIAL.name, DIRECTION.name)

_UNITS = {"left": 126, "right": 127}
_SWITCHES, _CALIBRATION, _FORCES_AT, _PROXIMITIES_AT = 4000, 4010, 4200, 4215
_NO_FORCE, _NO_PROXIMITY = 0xFFFF, 0xFFFF_FFFF
_SWITCHING_S, _CALIBRATING_S = 0.3, 0.5
_LOOK_S, _LONGEST_S = 1.0, 60.0


class Revo2Options(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Options of the driver.

    Raises:
        ConfigurationError: an option is out of its limits.
    """

    side: Annotated[Literal["right", "left"], Meta(description="which hand it is")] = "right"
    unit: Annotated[
        Annotated[int, Meta(ge=1, le=254)] | None, Meta(description="its number; default: 127, of a left hand 126")
    ] = None
    period_ms: Annotated[float, Meta(ge=1, le=10_000, description="time between two readings")] = 20
    enable: Annotated[
        bool, Meta(description="switch touch on, at the beginning and when the hand has restarted: writes registers")
    ] = False

    def __post_init__(self) -> None:
        check_options(self)


class Revo2Watch(ZeroWatch):
    """Also tells what it means that there are no data."""

    _has_told = False

    def look(self, updates: Updates) -> None:
        """See whether there are data."""
        super().look(updates)
        if not self._has_told and (updates.status & Status.NOT_CONNECTED).any():
            self._has_told = True
            log.warning("the hand has no data (FFFF): touch is not switched on (--enable, or the operation enable)")


class Revo2Driver(ModbusAdapter[Revo2Options]):
    """One hand."""

    types: Sequence[SensorType] = (
        PRESSURE.measured(unit="counts", minimum=0),
        TANGENTIAL,
        DIRECTION,
        PROXIMITY.measured(unit="counts", minimum=0),
    )
    dtype: npt.DTypeLike = np.float32
    baudrate = 460_800
    timeout_s = 0.03
    word_order: Order = "little"

    def __init__(self, options: Revo2Options) -> None:
        self._unit = _UNITS[options.side] if options.unit is None else options.unit
        self.patches = [Patch(f"{options.side} hand", [*map(_tip, range(5)), *map(_proximity, range(5))])]
        self.registers = [*map(self._forces, range(5)), *map(self._proximities, range(5))]
        self.geometry = _places(Hand(options.side))
        super().__init__(options)

    @classmethod
    def watch(cls, tables: SkinTables) -> Watch:
        """Fingers that tell nothing but 0, and hands without data."""
        return Revo2Watch(tables)

    async def configure(self, link: Link) -> None:
        """Switch touch on, if the options want that."""
        if self.options.enable:
            await self._set(link, _SWITCHES, _SWITCHING_S)

    async def attend(self, link: Link) -> None:
        """See whether touch is still on, if it is this driver's to switch it on; a hand without touch is left alone."""
        pause_s = _LOOK_S
        while self.options.enable and not link.listen_only:
            await asyncio.sleep(pause_s)
            forces = await self.read(link, _FORCES_AT, 15, unit=self._unit, function=READ_INPUT)
            is_off = bool((forces == _NO_FORCE).all())
            if is_off:
                self.tell(self.patches[0], Notice.RESTARTED)
            pause_s = min(2 * pause_s, _LONGEST_S) if is_off else _LOOK_S

    @operation(sets_up=True)
    async def enable(self, link: Link, patches: Sequence[Patch]) -> None:  # noqa: ARG002
        """Switch touch on: writes 1 into the registers 4000 to 4004."""
        await self._set(link, _SWITCHES, _SWITCHING_S)

    @operation(sets_up=True)
    async def calibrate(self, link: Link, patches: Sequence[Patch]) -> None:  # noqa: ARG002
        """Take the present values as untouched: writes 1 into the registers 4010 to 4014."""
        await self._set(link, _CALIBRATION, _CALIBRATING_S)

    async def _set(self, link: Link, address: int, takes_s: float) -> None:
        await self.write(link, address, [1] * 5, unit=self._unit)
        await asyncio.sleep(takes_s)

    def _forces(self, finger: int) -> Registers:
        none = Sentinel(Status.NOT_CONNECTED, _NO_FORCE)
        return Registers(_FORCES_AT + 3 * finger, 3, self._unit, READ_INPUT, patch=0, module=finger, flags=[none])

    def _proximities(self, finger: int) -> Registers:
        none = Sentinel(Status.NOT_CONNECTED, _NO_PROXIMITY)
        address = _PROXIMITIES_AT + 2 * finger
        return Registers(address, 2, self._unit, READ_INPUT, "u4", patch=0, module=5 + finger, flags=[none])


def _tip(finger: int) -> Module:
    channels = [Sensor(name, finger) for name in _FORCES]
    return Module(channels, finger, "1x1", f"{FINGERS[finger]} tip")


def _proximity(finger: int) -> Module:
    return Module([Sensor(PROXIMITY.name, finger)], 5 + finger, "1x1", f"{FINGERS[finger]} proximity")


def _places(hand: Hand) -> Geometry:
    """Nominal ones: one at each fingertip."""
    tip = Grid(1, 1)
    names = [*_FORCES, PROXIMITY.name]
    return Geometry.joined([tip.at(hand.down(name, [tip])[0], names, [finger]) for finger, name in enumerate(FINGERS)])


__all__ = ["Revo2Driver", "Revo2Options"]
