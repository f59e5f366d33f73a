"""BrainCo's Revo3 hand: eleven pads of taxels on palm and fingers, over Modbus RTU.

The driver asks the hand what it sends: which pads with how many taxels, whether single taxels or sums of zones, and
whether counts or forces. See :mod:`skinware_drivers.modbus.revo3_mappings` for the registers and their sources.
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

from skinware.errors import BusError, ConfigurationError, HandshakeTimeout
from skinware.geometry import Geometry
from skinware.sensor_types import SensorType
from skinware.status import Status
from skinware_drivers.bus import Bus
from skinware_drivers.description import Module, Patch, SkinTables, taxels
from skinware_drivers.hand import FINGERS, Grid, Hand
from skinware_drivers.layout import Sentinel, Values
from skinware_drivers.link import Link
from skinware_drivers.modbus import revo3_mappings as map_of
from skinware_drivers.modbus.adapter import ModbusAdapter, ModbusException
from skinware_drivers.modbus.registers import Registers
from skinware_drivers.modbus.revo3_mappings import MAPPINGS, PADS, Mapping
from skinware_drivers.modbus.wire import READ_HOLDING, READ_INPUT
from skinware_drivers.operations import operation
from skinware_drivers.options import check_options
from skinware_drivers.polling import Notice, Watch, ZeroWatch

log: logging.Logger = logging.getLogger("skinware.driver")

_UNITS = (1, 126, 127)
_LOOK_S, _AGAIN_S = 1.0, 0.05
_ADC = 0
_Name = Literal["pressure", "matrix", "packed"]
_Side = Literal["right", "left"]


class Revo3Options(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Options of the driver.

    Raises:
        ConfigurationError: an option is out of its limits, or ``points`` are not eleven numbers.
    """

    side: Annotated[_Side | None, Meta(description="which hand it is; default: the hand is asked")] = None
    unit: Annotated[
        Annotated[int, Meta(ge=1, le=254)] | None, Meta(description="its number; default: 1, 126 or 127 that answers")
    ] = None
    mapping: Annotated[_Name | None, Meta(description="which registers the hand has; default: the hand is asked")] = (
        None
    )
    points: Annotated[
        tuple[Annotated[int, Meta(ge=1, le=200)], ...],
        Meta(description="taxels of the palm, then of tip and pad of each finger from the thumb on; default: asked"),
    ] = ()
    period_ms: Annotated[
        Annotated[float, Meta(ge=1, le=10_000)] | None,
        Meta(description="time between two readings; default: 20, or what line and hand need"),
    ] = None

    def __post_init__(self) -> None:
        check_options(self)
        if len(self.points) not in (0, len(PADS)):
            raise ConfigurationError(f"option points: give {len(PADS)} numbers")


class _Said(NamedTuple):
    """What the hand says of its data.

    Attributes:
        name: of its mapping.
        function: with which its data are read.
        has_sums: it sends sums of zones, not single taxels.
        counts: taxels or zones of each pad.
        modes: of each pad: 0 counts of the converter, others as the mapping says.
    """

    name: str
    function: int
    has_sums: bool
    counts: tuple[int, ...]
    modes: tuple[int, ...]

    @property
    def mapping(self) -> Mapping:
        return MAPPINGS[self.name]

    def type_of(self, pad: int) -> SensorType:
        return map_of.SUM if self.has_sums else self.mapping.types[self.modes[pad]]

    @property
    def text(self) -> str:
        kinds = {f"{self.type_of(pad).name} in {self.type_of(pad).unit}": None for pad in range(len(PADS))}
        what = "sums of zones" if self.has_sums else "taxels"
        return f"mapping {self.name}, {sum(self.counts)} {what}, {' and '.join(kinds)}"


class Revo3Driver(ModbusAdapter[Revo3Options]):
    """One hand; the uid of taxel (or zone) n of pad k is k << 8 | n."""

    dtype: npt.DTypeLike = np.uint16
    baudrate = 5_000_000
    timeout_s = 0.05
    largest_gap = 40
    most_registers = 120

    def __init__(self, options: Revo3Options) -> None:
        self.follows_line = options.period_ms is None
        self._unit = options.unit or _UNITS[0]
        self._said: _Said | None = None
        self._declare(_unasked(options.mapping), options.side or "right", options.points)
        super().__init__(options)

    def fit(self, bus: Bus) -> None:
        """Ask for no registers before the hand has said which it has."""
        super().fit(bus)
        if not bus.listen_only:
            self.use_registers(())

    async def describe(self, link: Link) -> Sequence[Patch]:
        """Ask the hand which pads it has and what it sends of them; how long it takes for all is learnt then.

        Raises:
            BusError: it does not answer, sends what this driver does not read, or must not be asked.
        """
        options, side = self.options, self.options.side
        if link.listen_only:
            if options.mapping is None:
                raise BusError("what a hand sends it tells only when asked, listening is not enough: say mapping")
            said = _unasked(options.mapping)
        else:
            self._unit = await self._find_unit(link)
            side = side or await self._ask_side(link)
            self._said = said = await self._look(link)
        for pad, count in enumerate(options.points or said.counts):
            if not said.has_sums and not said.mapping.count_fits(pad, count):
                raise BusError(f"{link.bus_name}: {count} taxels in the {PADS[pad]} do not fit mapping {said.name}")
        log.info("%s: unit %d, %s hand, %s", link.bus_name, self._unit, side or "right", said.text)
        self._declare(said, side or "right", options.points)
        self.use_registers(self.registers)
        await self.learn_period(link)
        return self.patches

    async def attend(self, link: Link) -> None:
        """Notice that the hand sends something else: after a restart, or because another program has set it so."""
        pause_s = _LOOK_S
        while not link.listen_only:
            await asyncio.sleep(pause_s)
            pause_s = _LOOK_S
            try:
                said = await self._look(link)
            except HandshakeTimeout:
                pause_s = _AGAIN_S  # once it answers again, it may have restarted: that is asked first
                continue
            if self._said is not None and said != self._said:
                log.warning("%s: the hand sends something else now: %s", link.bus_name, said.text)
                self.tell(self.patches[0], Notice.CHANGED)

    @classmethod
    def watch(cls, tables: SkinTables) -> Watch:
        """Pads that send nothing but 0."""
        return ZeroWatch(tables)

    @operation(sets_up=True)
    async def enable(self, link: Link, patches: Sequence[Patch]) -> None:  # noqa: ARG002
        """Switch all pads on: writes 1 into their eleven switches."""
        await self.write(link, self._mapping.switches, [1] * len(PADS), unit=self._unit)

    @operation(sets_up=True)
    async def zero(self, link: Link, patches: Sequence[Patch]) -> None:  # noqa: ARG002
        """Take the present values of all pads as zero: nothing may touch the hand."""
        await self.write(link, self._mapping.zero, [1], unit=self._unit)

    @property
    def _mapping(self) -> Mapping:
        return (self._said or _unasked(self.options.mapping)).mapping

    async def _find_unit(self, link: Link) -> int:
        units = _UNITS if self.options.unit is None else (self.options.unit,)
        for unit in units[:-1]:
            try:
                await self.read(link, map_of.FAMILY_AT, unit=unit)
            except ModbusException:
                return unit
            except HandshakeTimeout:
                continue
            return unit
        return units[-1]

    async def _ask_side(self, link: Link) -> _Side:
        side = await self._read_or_none(link, map_of.SIDE_AT)
        return "right" if side is None or side[0] == map_of.RIGHT else "left"

    async def _look(self, link: Link) -> _Said:
        name: str | None = self.options.mapping
        if name is None:
            family = await self._read_or_none(link, map_of.FAMILY_AT)
            if family is None or family[0] not in (map_of.PRESSURE_FAMILY, map_of.MATRIX_FAMILY):
                raise BusError(
                    f"{link.bus_name}: register {map_of.FAMILY_AT} of the hand says {family and family[0]}, neither 1"
                    " (pressure) nor 2 (matrix): say mapping, if you know it"
                )
            name = "pressure" if family[0] == map_of.PRESSURE_FAMILY else None
        return await (self._look_at_pressure(link) if name == "pressure" else self._look_at_matrix(link, name))

    async def _look_at_pressure(self, link: Link) -> _Said:
        kind, mode = await self.read(link, map_of.KIND_AT, 2, unit=self._unit)
        if kind not in (0, 1) or mode not in (0, 1, 2):
            raise BusError(f"{link.bus_name}: registers 4023 and 4024 say {kind} and {mode}, which means nothing known")
        counts = map_of.COUNTS_OF_SUMS
        if not kind:
            said = await self._read_or_none(link, map_of.PRESSURE_COUNTS_AT, len(PADS))
            counts = said if said is not None and all(said) else tuple(MAPPINGS["pressure"].counts)
        return _Said("pressure", READ_INPUT, bool(kind), counts, (int(mode),) * len(PADS))

    async def _look_at_matrix(self, link: Link, name: str | None) -> _Said:
        """Counts and modes; and by which of two forms the data are, if no option says it."""
        function, counts = READ_HOLDING, tuple[int, ...]()
        for function in (READ_INPUT, READ_HOLDING) if name != "matrix" else (READ_HOLDING,):
            counts = await self._read_or_none(link, map_of.MATRIX_COUNTS_AT, len(PADS), function) or ()
            if counts and all(counts):
                break
        if not (counts and all(counts)):
            counts = tuple(MAPPINGS["matrix"].counts)
        of_all, *of_each = await self._read_or_none(link, map_of.MODE_AT, 1 + len(PADS)) or (_ADC,) * (1 + len(PADS))
        modes = tuple(mode if mode in (0, 1) else int(of_all == 1) for mode in of_each)
        if name is None:
            name = await self._form(link, function, counts)
        return _Said(name, function, False, counts, modes)

    async def _form(self, link: Link, function: int, counts: Sequence[int]) -> str:
        """``matrix`` or ``packed``, by what is in registers that only one of them has; else as it was, or packed."""
        known = "packed" if self._said is None else self._said.name
        palm, thumb_pad = MAPPINGS["packed"].pads[0], MAPPINGS["packed"].pads[2]
        middle, end = palm + -(-counts[0] // 2), palm + counts[0]
        if any(await self._read_or_none(link, middle, end - middle, function) or ()):
            return "matrix"
        begin, end = max(thumb_pad, MAPPINGS["matrix"].pads[2] + counts[2]), thumb_pad + -(-counts[2] // 2)
        if begin < end and any(await self._read_or_none(link, begin, end - begin, function) or ()):
            return "packed"
        return known

    async def _read_or_none(
        self, link: Link, address: int, count: int = 1, function: int = READ_HOLDING
    ) -> tuple[int, ...] | None:
        """Registers, or None where the hand says that it has none."""
        if count < 1:
            return None
        try:
            return tuple((await self.read(link, address, count, unit=self._unit, function=function)).tolist())
        except ModbusException:
            return None

    def _declare(self, said: _Said, side: _Side, points: Sequence[int]) -> None:
        counts = said.counts if said.has_sums else points or said.counts
        types = [said.type_of(pad) for pad in range(len(PADS))]
        self.types: Sequence[SensorType] = tuple({kind.id: kind for kind in types}.values())
        first = map_of.SUMS_AT
        registers, modules = list[Registers](), list[Module]()
        for pad, (name, count, kind) in enumerate(zip(PADS, counts, types, strict=True)):
            packed = not said.has_sums and said.mapping.in_register == 2
            registers.append(
                Registers(
                    first if said.has_sums else said.mapping.pads[pad],
                    -(-count // 2) if packed else count,
                    self._unit,
                    said.function,
                    patch=0,
                    module=pad,
                    flags=[Sentinel(Status.OUT_OF_RANGE, 0xFF if packed else 0xFFFF)],
                    values=[Values(0, "u1" if packed else ">u2", count)],
                )
            )
            what = "zones" if said.has_sums else "points"
            modules.append(Module(taxels(count, kind.name, first_uid=pad << 8), pad, f"{count} {what}", name))
            first += count
        self.registers: Sequence[Registers] = registers
        self.patches: Sequence[Patch] = [Patch(f"{side} hand", modules)]
        self.geometry: Geometry | None = _geometry(said, side, modules)


def _unasked(mapping: _Name | None) -> _Said:
    name = mapping or "pressure"
    function = READ_INPUT if name == "pressure" else READ_HOLDING
    return _Said(name, function, False, tuple(MAPPINGS[name].counts), (_ADC,) * len(PADS))


def _geometry(said: _Said, side: _Side, modules: Sequence[Module]) -> Geometry:
    """Rows and columns as the maker's program draws them; lengths, and how pads lie to each other, are nominal."""
    hand, found = Hand(side), []
    for part in ("palm", *FINGERS):
        pads = [pad for pad, name in enumerate(PADS) if name.startswith(part)]
        drawn = []
        for pad in pads:
            count = len(modules[pad].channels)
            drawn.append(
                (Grid(1, count), range(count)) if said.has_sums else map_of.places(said.name, side, pad, count)
            )
        for pad, (grid, cells), centre in zip(pads, drawn, hand.down(part, [grid for grid, _ in drawn]), strict=True):
            uids = [pad << 8 | n for n in range(len(modules[pad].channels))]
            found.append(grid.at(centre, [said.type_of(pad).name], uids, cells=cells))
    return Geometry.joined(found)
