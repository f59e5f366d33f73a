"""BrainCo's Revo2 hands with touch, in all four editions, over Modbus RTU. The driver asks the hand which one it is.

See :mod:`skinware_drivers.modbus.revo2_editions` for the registers and their sources. Proximities have 32 bits, the
high word first, as the maker's program reads them (bc_stark_sdk 2.0.8). One user's report has the low word first
(BrainCoTech/unitree-g1-brainco-hand, pull request 1, firmware 1.0.14.U); ``word_order=little`` of the bus reads that.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Sequence
from typing import Annotated, Literal, NamedTuple

import msgspec
import numpy as np
import numpy.typing as npt
from msgspec import Meta

from skinware.errors import BusError, HandshakeTimeout
from skinware.geometry import Geometry
from skinware.sensor_types import SensorType
from skinware.status import Status
from skinware_drivers.bus import Bus
from skinware_drivers.decoding.skin_state import Updates
from skinware_drivers.description import Module, Patch, SkinTables
from skinware_drivers.hand import Grid, Hand
from skinware_drivers.link import Link
from skinware_drivers.modbus import revo2_editions as of_hand
from skinware_drivers.modbus.adapter import ModbusAdapter, ModbusException
from skinware_drivers.modbus.registers import Registers
from skinware_drivers.modbus.revo2_editions import EDITIONS, EditionName, content
from skinware_drivers.modbus.wire import READ_HOLDING, READ_INPUT
from skinware_drivers.operations import operation
from skinware_drivers.options import check_options
from skinware_drivers.polling import Notice, Watch, ZeroWatch

log: logging.Logger = logging.getLogger("skinware.driver")

_Side = Literal["right", "left"]
_UNITS: dict[_Side, int] = {"right": 127, "left": 126}
_LEFT_SKUS = (2, 4)
_SWITCHING_S, _CALIBRATING_S = 0.3, 0.5
_LOOK_S, _LONGEST_S = 1.0, 60.0


class Revo2Options(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Options of the driver.

    Raises:
        ConfigurationError: an option is out of its limits.
    """

    side: Annotated[_Side | None, Meta(description="which hand it is; default: the hand is asked")] = None
    unit: Annotated[
        Annotated[int, Meta(ge=1, le=254)] | None,
        Meta(description="its number; default: 127 of a right hand, 126 of a left one, whichever answers"),
    ] = None
    edition: Annotated[
        EditionName | None, Meta(description="which sensors the hand has; default: the hand is asked")
    ] = None
    status: Annotated[
        bool, Meta(description="touch: read along what each finger says of its sensor; no: the values alone")
    ] = True
    period_ms: Annotated[float, Meta(ge=1, le=10_000, description="time between two readings")] = 20
    enable: Annotated[
        bool, Meta(description="switch touch on, at the beginning and when the hand has restarted: writes registers")
    ] = False

    def __post_init__(self) -> None:
        check_options(self)


class Revo2Watch(ZeroWatch):
    """Also says in the log what it means that there are no data."""

    _has_told = False

    def look(self, updates: Updates) -> None:
        super().look(updates)
        if not self._has_told and (updates.status & Status.NOT_CONNECTED).any():
            self._has_told = True
            log.warning(
                "fingers have no data: touch is not switched on (--enable, or the operation enable), or the hand says"
                " that there is no sensor (4225 to 4229)"
            )


class _Said(NamedTuple):
    """What the hand says of its data: its edition, and the kind of values of the Pressure edition."""

    edition: EditionName
    kind: int = 0


class Revo2Driver(ModbusAdapter[Revo2Options]):
    """One hand."""

    dtype: npt.DTypeLike = np.float32
    baudrate = 460_800
    timeout_s = 0.03
    largest_gap = 80

    def __init__(self, options: Revo2Options) -> None:
        self._unit = options.unit or _UNITS[options.side or "right"]
        self._said = _Said(options.edition or "touch")
        self._is_asked = False
        self._declare(self._said, options.side or "right", with_status=options.status)
        super().__init__(options)

    def fit(self, bus: Bus) -> None:
        """Ask for no registers before the hand has said which it has."""
        super().fit(bus)
        if not bus.listen_only:
            self.use_registers(())

    async def describe(self, link: Link) -> Sequence[Patch]:
        """Ask the hand which side and edition it is; where it must not be asked, the options say it.

        Raises:
            BusError: it does not answer, or says that it has no sensors that this driver reads.
        """
        options, side = self.options, self.options.side
        if not link.listen_only:
            self._unit = await self._find_unit(link)
            side = side or await self._ask_side(link)
            self._said, self._is_asked = await self._look(link), True
            names = await self._ask_names(link)
            log.info("%s: unit %d, %s hand, edition %s, %s", link.bus_name, self._unit, side, self._said.edition, names)
        self._declare(self._said, side or "right", with_status=options.status and not link.listen_only)
        self.use_registers(self.registers)
        return self.patches

    @classmethod
    def watch(cls, tables: SkinTables) -> Watch:
        """Fingers that send nothing but 0, and hands without data."""
        return Revo2Watch(tables)

    async def configure(self, link: Link) -> None:
        if self.options.enable:
            await self._set(link, EDITIONS[self._said.edition].switches, _SWITCHING_S)

    async def attend(self, link: Link) -> None:
        """See whether the hand still sends the same; and whether touch is on, if this driver is to switch it on."""
        pause_s = _LOOK_S
        while not link.listen_only:
            await asyncio.sleep(pause_s)
            is_off = False
            if self._is_asked and (said := await self._look(link)) != self._said:
                log.warning("%s: the hand sends something else now: %s", link.bus_name, said)
                self.tell(self.patches[0], Notice.CHANGED)
            elif self.options.enable and (is_off := await self._is_off(link)):
                self.tell(self.patches[0], Notice.RESTARTED)
            pause_s = min(2 * pause_s, _LONGEST_S) if is_off else _LOOK_S

    @operation(sets_up=True)
    async def enable(self, link: Link, patches: Sequence[Patch]) -> None:  # noqa: ARG002
        """Switch touch on: writes 1 into the switches of the edition (4000 to 4004 of touch)."""
        await self._set(link, EDITIONS[self._said.edition].switches, _SWITCHING_S)

    @operation(sets_up=True)
    async def calibrate(self, link: Link, patches: Sequence[Patch]) -> None:  # noqa: ARG002
        """Take the present values as untouched: nothing may touch the hand; values of the next 10 s are no measure."""
        await self._set(link, EDITIONS[self._said.edition].calibration, _CALIBRATING_S)

    @operation(sets_up=True)
    async def reset(self, link: Link, patches: Sequence[Patch]) -> None:  # noqa: ARG002
        """Set the channels of the sensors up anew (4005 to 4009, edition touch): nothing may touch the hand."""
        registers = EDITIONS[self._said.edition].reset
        if registers is None:
            raise BusError(f"hands of the edition {self._said.edition} have no such registers")
        await self._set(link, registers, _CALIBRATING_S)

    @operation()
    async def names(self, link: Link, patches: Sequence[Patch]) -> str:  # noqa: ARG002
        """Serial number and firmware, as the hand says them."""
        return await self._ask_names(link)

    async def _set(self, link: Link, registers: tuple[int, int], takes_s: float) -> None:
        address, count = registers
        await self.write(link, address, [1] * count, unit=self._unit)
        await asyncio.sleep(takes_s)

    async def _find_unit(self, link: Link) -> int:
        if self.options.unit is not None or self.options.side is not None:
            return self._unit
        try:
            await self.read(link, of_hand.EDITION_AT, unit=_UNITS["right"])
        except ModbusException:
            pass
        except HandshakeTimeout:
            return _UNITS["left"]
        return _UNITS["right"]

    async def _ask_side(self, link: Link) -> _Side:
        said = await self._read_or_none(link, of_hand.SIDE_AT)
        if said is None:
            return "left" if self._unit == _UNITS["left"] else "right"
        return "left" if said[0] in _LEFT_SKUS else "right"

    async def _look(self, link: Link) -> _Said:
        edition = self.options.edition
        if edition is None:
            said = await self._read_or_none(link, of_hand.EDITION_AT)
            number = said[0] if said else 0
            if number > len(EDITIONS):
                raise BusError(f"{link.bus_name}: register 970 says {number}: no edition that this driver reads")
            edition = list(EDITIONS)[number - 1] if number else "touch"  # 0: firmware that does not say it
        if edition != "pressure":
            return _Said(edition)
        kind = await self._read_or_none(link, of_hand.KIND_AT)
        if kind and kind[0] > 2:
            raise BusError(f"{link.bus_name}: register 6000 says {kind[0]}: neither raw, calibrated nor force")
        return _Said(edition, kind[0] if kind else 0)

    async def _is_off(self, link: Link) -> bool:
        if self._said.edition == "touch":
            forces = await self.read(link, of_hand.FORCES_AT, 15, unit=self._unit, function=READ_INPUT)
            return bool((forces == of_hand.NO_FORCE).all())
        address, count = EDITIONS[self._said.edition].switches
        return not (await self.read(link, address, count, unit=self._unit)).any()

    async def _ask_names(self, link: Link) -> str:
        found = []
        for what, address in (("serial number", of_hand.SERIAL_AT), ("firmware", of_hand.FIRMWARE_AT)):
            said = await self._read_or_none(link, address, 10, READ_INPUT) or ()
            text = b"".join(register.to_bytes(2, "big") for register in said).decode("ascii", "replace")
            found.append(f"{what} {''.join(one for one in text if one.isprintable()) or 'not said'}")
        return ", ".join(found)

    async def _read_or_none(
        self, link: Link, address: int, count: int = 1, function: int = READ_HOLDING
    ) -> tuple[int, ...] | None:
        """Registers, or None where the hand says that it has none."""
        try:
            return tuple((await self.read(link, address, count, unit=self._unit, function=function)).tolist())
        except ModbusException:
            return None

    def _declare(self, said: _Said, side: _Side, *, with_status: bool) -> None:
        what = content(said.edition, self._unit, kind=said.kind, with_status=with_status)
        self.types: Sequence[SensorType] = what.types
        self.registers: Sequence[Registers] = what.registers
        self.patches: Sequence[Patch] = [Patch(f"{side} hand", what.modules)]
        self.geometry: Geometry | None = _places(Hand(side), what.modules)


def _places(hand: Hand, modules: Sequence[Module]) -> Geometry:
    """Nominal ones: points of a fingertip or a palm in rows of three or six, others one at each fingertip."""
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
