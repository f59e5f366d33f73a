"""BrainCo's Revo3 hand: eleven pads of taxels on palm and fingers, over Modbus RTU, with registers in three mappings.

The driver asks the hand for its mapping, for the number of taxels in each pad, whether it sends single taxels or sums
of zones, and whether counts or forces. Sources:

* BrainCoTech/brainco-revo3-sdk, commit 7ba96eb of 2026-08-03: ``docs/device/REVO3_TOUCH_API.md`` (registers of the
  mappings Pressure and Matrix) and ``python/gui/touch_panel_revo3.py`` (counts, units, rows and columns of the pads).
* The maker's programs bc-revo3-sdk 1.5.1, 1.6.3 and 2.3.2 (PyPI) as clients of a server whose registers hold their own
  numbers, on 2026-11-23: meaning of 101 and 135, the counts in 4037 to 4047, and the mapping ``packed``, which 1.6.3
  and 2.3.2 read where 1.5.1 reads ``matrix``.
"""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple

import numpy as np
import numpy.typing as npt
from msgspec import Meta

from skinware.errors import BusError, ConfigurationError, HandshakeTimeout
from skinware.geometry import Geometry
from skinware.nominal_hand import FINGERS
from skinware.sensor_types import FORCE_Z, PRESSURE, SensorType
from skinware.status import Status
from skinware_drivers.description import Module, Patch, taxels
from skinware_drivers.fields import Sentinel
from skinware_drivers.hand import Grid, Hand
from skinware_drivers.layout import Values
from skinware_drivers.link import Link
from skinware_drivers.modbus.adapter import ModbusAdapter
from skinware_drivers.modbus.registers import Registers
from skinware_drivers.modbus.wire import READ_HOLDING, READ_INPUT
from skinware_drivers.operations import operation
from skinware_drivers.options import Options
from skinware_drivers.polling import Notice, ZeroWatch

_UNITS = (1, 126, 127)
_LOOK_S, _AGAIN_S = 1.0, 0.05
_ADC = 0
_Name = Literal["pressure", "matrix", "packed"]
_Side = Literal["right", "left"]
_PADS = ("palm", *(f"{finger} {part}" for finger in FINGERS for part in ("tip", "pad")))
_SIDE_AT, _RIGHT = 101, 1
_FAMILY_AT, _PRESSURE_FAMILY, _MATRIX_FAMILY = 135, 1, 2
_KIND_AT, _PRESSURE_COUNTS_AT, _SUMS_AT = 4023, 4037, 4100
_MATRIX_COUNTS_AT, _MODE_AT = 5191, 5202
_COUNTS_OF_SUMS: tuple[int, ...] = (1, 3, 6, *(3, 5) * 4)
"""Zones of each pad whose sums a hand of the mapping Pressure can send."""

_COUNTS = PRESSURE.measured(unit="counts", minimum=0)
_BYTES = PRESSURE.measured(unit="counts", minimum=0, maximum=0xFF)
_FORCE_COUNTS = FORCE_Z.measured(unit="counts", minimum=0)


@dataclass(frozen=True)
class Mapping:
    """The registers of one mapping.

    Attributes:
        pads: first register of each pad, and the one after the last pad.
        counts: taxels of each pad, for hands that do not report them.
        switches: first of the eleven registers that switch pads on.
        zero: the register that takes the present values as zero.
        in_register: values in a register, the first in its high byte if there are two.
        types: of the values, by the mode that the hand reports: 0, 1 ...
    """

    pads: Sequence[int]
    counts: Sequence[int]
    switches: int
    zero: int
    in_register: int
    types: Sequence[SensorType]


_MATRIX_COUNTS = (53, 56, 22, *(22, 27) * 4)
_MAPPINGS = {
    "pressure": Mapping(
        (4200, 4250, 4290, 4350, 4400, 4460, 4500, 4560, 4600, 4660, 4700, 4752),
        (36, 31, 57, *(21, 52) * 4),
        switches=4000,
        zero=4011,
        in_register=1,
        types=(_COUNTS, _COUNTS, _FORCE_COUNTS),
    ),
    "matrix": Mapping(
        range(5240, 5901, 60),
        _MATRIX_COUNTS,
        switches=5900,
        zero=5214,
        in_register=1,
        types=(_COUNTS, FORCE_Z.measured(scale=1e-4, minimum=0)),
    ),
    "packed": Mapping(
        (5240, *(first + more for first in range(5340, 5841, 100) for more in (0, 40)))[:12],
        _MATRIX_COUNTS,
        switches=5900,
        zero=5214,
        in_register=2,
        types=(_BYTES, FORCE_Z.measured(scale=1e-2, minimum=0, maximum=2.55)),
    ),
}
_SUM = FORCE_Z.measured(scale=1e-3, minimum=0)

_TIP = "123 123 1234 1234 1234 5 5 5"
_PAD = "15 1234 1234 01234" + 5 * " 12345" + 4 * " 567"
_COLUMNS = {
    "right palm": "12345 012345 012345 0345 0345 0345 035 045 5",
    "left palm": "01234 012345 012345 0125 0125 0125 025 015 0",
    "thumb tip": "0134 01345 012345 012345 012345 6 6 6 6",
    "thumb pad": 8 * "01234 " + "123 12" + 4 * " 567",
}
"""Columns with taxels in each row of a pad of the mapping Pressure, in the order of the taxels."""
_MATRIX_COLUMNS = 6


def places(mapping: str, side: str, pad: int, count: int) -> tuple[Grid, Sequence[int]]:
    """Return the grid of a pad and the cells of its taxels; without a table of the maker, they fill it in order."""
    name = _PADS[pad]
    rows = _COLUMNS.get(f"{side} {name}", _COLUMNS.get(name, _TIP if name.endswith("tip") else _PAD)).split()
    if mapping != "pressure" or sum(map(len, rows)) != count:
        return Grid(-(-count // _MATRIX_COLUMNS), _MATRIX_COLUMNS), range(count)
    columns = 1 + max(int(column) for row in rows for column in row)
    return Grid(len(rows), columns), [columns * number + int(one) for number, row in enumerate(rows) for one in row]


class Revo3Options(Options, frozen=True):
    side: Annotated[_Side | None, Meta(description="which hand it is; default: ask the hand")] = None
    unit: Annotated[
        Annotated[int, Meta(ge=1, le=254)] | None,
        Meta(description="its number; default: 1, 126 or 127, as one answers"),
    ] = None
    mapping: Annotated[_Name | None, Meta(description="which registers the hand has; default: ask the hand")] = None
    points: Annotated[
        tuple[Annotated[int, Meta(ge=1, le=200)], ...],
        Meta(description="taxels of the palm, then of tip and pad of each finger from the thumb on; default: ask"),
    ] = ()
    period_ms: Annotated[
        Annotated[float, Meta(ge=1, le=10_000)] | None,
        Meta(description="time between two readings; default: 20, or what line and hand need"),
    ] = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self.points) not in (0, len(_PADS)):
            raise ConfigurationError(f"option points: give {len(_PADS)} numbers")


class _Said(NamedTuple):
    """The form of the data, as the hand reports it.

    Attributes:
        function: that reads its data.
        has_sums: it sends sums of zones, not single taxels.
        counts: taxels or zones of each pad.
        modes: of each pad: 0 counts of the converter; the mapping has the others.
    """

    name: str
    function: int
    has_sums: bool
    counts: tuple[int, ...]
    modes: tuple[int, ...]

    @property
    def mapping(self) -> Mapping:
        return _MAPPINGS[self.name]

    def type_of(self, pad: int) -> SensorType:
        return _SUM if self.has_sums else self.mapping.types[self.modes[pad]]

    @property
    def text(self) -> str:
        kinds = {f"{self.type_of(pad).name} in {self.type_of(pad).unit}": None for pad in range(len(_PADS))}
        what = "sums of zones" if self.has_sums else "taxels"
        return f"mapping {self.name}, {sum(self.counts)} {what}, {' and '.join(kinds)}"


class Revo3Driver(ModbusAdapter[Revo3Options]):
    """One hand; the uid of taxel (or zone) n of pad k is k << 8 | n."""

    dtype: npt.DTypeLike = np.uint16
    baudrate = 5_000_000
    timeout_s = 0.05
    largest_gap = 40
    most_registers = 120
    asks_first = True
    watch = ZeroWatch

    def __init__(self, options: Revo3Options) -> None:
        self.follows_line = options.period_ms is None
        self._unit = options.unit or _UNITS[0]
        self._said: _Said | None = None
        self._declare(_unasked(options.mapping), options.side or "right", options.points)
        super().__init__(options)

    async def describe(self, link: Link) -> Sequence[Patch]:
        """Ask the hand for the form of its data, then measure how long it needs for all of them."""
        options, side = self.options, self.options.side
        if link.listen_only:
            if options.mapping is None:
                raise BusError("a hand must be asked for its mapping, listening is not enough: say mapping")
            said = _unasked(options.mapping)
        else:
            if self.options.unit is None:
                self._unit = await self.find_unit(link, _UNITS, _FAMILY_AT)
            side = side or await self._ask_side(link)
            self._said = said = await self._look(link)
        pads, in_register = said.mapping.pads, said.mapping.in_register
        for pad, count in enumerate(options.points or said.counts):
            if not said.has_sums and not 1 <= count <= in_register * (pads[pad + 1] - pads[pad]):
                raise BusError(f"{link.bus_name}: {count} taxels in the {_PADS[pad]} do not fit mapping {said.name}")
        link.log.info("unit %d, %s hand, %s", self._unit, side or "right", said.text)
        self._declare(said, side or "right", options.points)
        self.use_registers(self.registers)
        await self.learn_period(link)
        return self.patches

    async def attend(self, link: Link) -> None:
        """Notice when the hand sends another form, after a restart or because another program has changed it."""
        pause_s = _LOOK_S
        while not link.listen_only:
            await asyncio.sleep(pause_s)
            pause_s = _LOOK_S
            try:
                said = await self._look(link)
            except HandshakeTimeout:
                pause_s = _AGAIN_S  # it may have restarted: ask that first, once it answers again
                continue
            if self._said is not None and said != self._said:
                link.log.warning("the hand sends something else now: %s", said.text)
                self.tell(self.patches[0], Notice.CHANGED)

    @operation(sets_up=True)
    async def enable(self, link: Link, patches: Sequence[Patch]) -> None:  # noqa: ARG002
        """Switch all pads on: write 1 to their eleven switches."""
        await self.write(link, self._mapping.switches, [1] * len(_PADS), unit=self._unit)

    @operation(sets_up=True)
    async def zero(self, link: Link, patches: Sequence[Patch]) -> None:  # noqa: ARG002
        """Take the present values of all pads as zero: nothing may touch the hand."""
        await self.write(link, self._mapping.zero, [1], unit=self._unit)

    @property
    def _mapping(self) -> Mapping:
        return (self._said or _unasked(self.options.mapping)).mapping

    async def _ask_side(self, link: Link) -> _Side:
        side = await self.read_or_none(link, _SIDE_AT, unit=self._unit)
        return "right" if side is None or side[0] == _RIGHT else "left"

    async def _look(self, link: Link) -> _Said:
        name: str | None = self.options.mapping
        if name is None:
            family = await self.read_or_none(link, _FAMILY_AT, unit=self._unit)
            if family is None or family[0] not in (_PRESSURE_FAMILY, _MATRIX_FAMILY):
                raise BusError(
                    f"{link.bus_name}: register {_FAMILY_AT} of the hand says {family and family[0]}, neither 1"
                    " (pressure) nor 2 (matrix): give the option mapping, if you know it"
                )
            name = "pressure" if family[0] == _PRESSURE_FAMILY else None
        return await (self._look_at_pressure(link) if name == "pressure" else self._look_at_matrix(link, name))

    async def _look_at_pressure(self, link: Link) -> _Said:
        kind, mode = await self.read(link, _KIND_AT, 2, unit=self._unit)
        if kind not in (0, 1) or mode not in (0, 1, 2):
            raise BusError(f"{link.bus_name}: registers 4023 and 4024 say {kind} and {mode}, whose meaning is unknown")
        counts = _COUNTS_OF_SUMS
        if not kind:
            said = await self.read_or_none(link, _PRESSURE_COUNTS_AT, len(_PADS), unit=self._unit)
            counts = said if said is not None and all(said) else tuple(_MAPPINGS["pressure"].counts)
        return _Said("pressure", READ_INPUT, bool(kind), counts, (int(mode),) * len(_PADS))

    async def _look_at_matrix(self, link: Link, name: str | None) -> _Said:
        """Ask for counts and modes, and find out which of the two mappings it is unless an option says so."""
        function, counts = READ_HOLDING, tuple[int, ...]()
        for function in (READ_INPUT, READ_HOLDING) if name != "matrix" else (READ_HOLDING,):
            said = await self.read_or_none(link, _MATRIX_COUNTS_AT, len(_PADS), unit=self._unit, function=function)
            counts = said or ()
            if counts and all(counts):
                break
        if not (counts and all(counts)):
            counts = tuple(_MAPPINGS["matrix"].counts)
        n_modes = 1 + len(_PADS)
        of_all, *of_each = await self.read_or_none(link, _MODE_AT, n_modes, unit=self._unit) or (_ADC,) * n_modes
        modes = tuple(mode if mode in (0, 1) else int(of_all == 1) for mode in of_each)
        if name is None:
            name = await self._form(link, function, counts)
        return _Said(name, function, False, counts, modes)

    async def _form(self, link: Link, function: int, counts: Sequence[int]) -> str:
        """Return ``matrix`` or ``packed``, by the registers that only one of them uses; else as before, or packed."""
        known = "packed" if self._said is None else self._said.name
        palm, thumb_pad = _MAPPINGS["packed"].pads[0], _MAPPINGS["packed"].pads[2]
        middle, end = palm + -(-counts[0] // 2), palm + counts[0]
        if await self._any_set(link, middle, end, function):
            return "matrix"
        begin, end = max(thumb_pad, _MAPPINGS["matrix"].pads[2] + counts[2]), thumb_pad + -(-counts[2] // 2)
        return "packed" if await self._any_set(link, begin, end, function) else known

    async def _any_set(self, link: Link, begin: int, end: int, function: int) -> bool:
        if begin >= end:
            return False
        return any(await self.read_or_none(link, begin, end - begin, unit=self._unit, function=function) or ())

    def _declare(self, said: _Said, side: _Side, points: Sequence[int]) -> None:
        counts = said.counts if said.has_sums else points or said.counts
        types = [said.type_of(pad) for pad in range(len(_PADS))]
        self.types: Sequence[SensorType] = tuple({kind.id: kind for kind in types}.values())
        first = _SUMS_AT
        registers, modules = list[Registers](), list[Module]()
        for pad, (name, count, kind) in enumerate(zip(_PADS, counts, types, strict=True)):
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
    return _Said(name, function, False, tuple(_MAPPINGS[name].counts), (_ADC,) * len(_PADS))


def _geometry(said: _Said, side: _Side, modules: Sequence[Module]) -> Geometry:
    """Return rows and columns as the maker's program draws them; lengths and distances of pads are nominal."""
    hand, found = Hand(side), []
    for part in ("palm", *FINGERS):
        pads = [pad for pad, name in enumerate(_PADS) if name.startswith(part)]
        drawn = []
        for pad in pads:
            count = len(modules[pad].channels)
            drawn.append((Grid(1, count), range(count)) if said.has_sums else places(said.name, side, pad, count))
        for pad, (grid, cells), centre in zip(pads, drawn, hand.down(part, [grid for grid, _ in drawn]), strict=True):
            uids = [pad << 8 | n for n in range(len(modules[pad].channels))]
            found.append(grid.at(centre, [said.type_of(pad).name], uids, cells=cells))
    return Geometry.joined(found)
