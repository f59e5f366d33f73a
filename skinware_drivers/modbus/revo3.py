"""BrainCo's Revo3 hand: eleven pads of taxels on palm and fingers, over Modbus RTU, in one of its two mappings.

Source: the maker's tables (BrainCoTech/brainco-revo3-sdk). *Pressure* mapping: input registers from 4200 on, one array
after the other; holding registers 4000 to 4010 switch the pads on, 4011 sets all to zero. *Matrix* mapping: holding
registers from 5240 on, 60 for each pad; 5900 to 5910 switch them on, 5214 tares.

Not published: units, where the taxels of a pad are, the number of the hand and the baud rate of its line; and, of the
matrix mapping, how many taxels are used: taken to be as many as in the other (option ``points``).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Literal, NamedTuple

import msgspec
import numpy as np
import numpy.typing as npt
from msgspec import Meta

from skinware.errors import ConfigurationError
from skinware.geometry import Geometry
from skinware.sensor_types import PRESSURE, SensorType
from skinware_drivers.description import Module, Patch, SkinTables, taxels
from skinware_drivers.hand import FINGERS, Grid, Hand
from skinware_drivers.link import Link
from skinware_drivers.modbus.adapter import ModbusAdapter
from skinware_drivers.modbus.registers import Registers
from skinware_drivers.modbus.wire import READ_HOLDING, READ_INPUT
from skinware_drivers.operations import operation
from skinware_drivers.options import check_options
from skinware_drivers.watch import Watch
from skinware_drivers.zero_watch import ZeroWatch

_PADS = ("palm", *(f"{finger} {part}" for finger in FINGERS for part in ("tip", "pad")))
_POINTS = (36, 31, 57, 21, 52, 21, 52, 21, 52, 21, 52)
_MOST_POINTS = 60


class _Mapping(NamedTuple):
    """Where things are: the beginning of each pad's registers, the switches of the pads, and what sets all to zero."""

    function: int
    pads: Sequence[int]
    switches: int
    zero: int


_MAPPINGS = {
    "pressure": _Mapping(
        READ_INPUT, (4200, 4250, 4290, 4350, 4400, 4460, 4500, 4560, 4600, 4660, 4700), switches=4000, zero=4011
    ),
    "matrix": _Mapping(READ_HOLDING, range(5240, 5900, _MOST_POINTS), switches=5900, zero=5214),
}
_UNITS = {"left": 126, "right": 127}


class Revo3Options(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Options of the driver.

    Raises:
        ConfigurationError: an option is out of its limits, or ``points`` are not eleven numbers that the mapping has.
    """

    side: Annotated[Literal["right", "left"], Meta(description="which hand it is")] = "right"
    unit: Annotated[
        Annotated[int, Meta(ge=1, le=254)] | None, Meta(description="its number; default: 127, of a left hand 126")
    ] = None
    mapping: Annotated[Literal["pressure", "matrix"], Meta(description="which registers the hand has")] = "pressure"
    points: Annotated[
        tuple[int, ...], Meta(description="taxels of the palm, then of tip and pad of each finger from the thumb on")
    ] = _POINTS
    period_ms: Annotated[
        Annotated[float, Meta(ge=1, le=10_000)] | None,
        Meta(description="time between two readings; default: 20, or what line and hand need"),
    ] = None

    def __post_init__(self) -> None:
        check_options(self)
        if len(self.points) != len(_PADS) or not all(1 <= n <= _MOST_POINTS for n in self.points):
            raise ConfigurationError(f"option points: give {len(_PADS)} numbers from 1 to {_MOST_POINTS}")
        if self.mapping == "pressure" and self.points != _POINTS:
            raise ConfigurationError("option points: in the mapping `pressure` they are published; leave it out")


class Revo3Driver(ModbusAdapter[Revo3Options]):
    """One hand."""

    types: Sequence[SensorType] = (PRESSURE.measured(unit="counts", minimum=0),)
    dtype: npt.DTypeLike = np.uint16
    baudrate = 460_800
    largest_gap = 40
    most_registers = 120

    def __init__(self, options: Revo3Options) -> None:
        self.follows_line = options.period_ms is None
        self._unit = _UNITS[options.side] if options.unit is None else options.unit
        self._mapping = _MAPPINGS[options.mapping]
        pads = list(zip(_PADS, self._mapping.pads, options.points, strict=True))
        self.registers = [
            Registers(address, n, self._unit, self._mapping.function, patch=0, module=number)
            for number, (_, address, n) in enumerate(pads)
        ]
        firsts = [_MOST_POINTS * number for number in range(len(pads))]
        modules = [
            Module(taxels(n, first_uid=first), number, f"{n} points", name)
            for number, (first, (name, _, n)) in enumerate(zip(firsts, pads, strict=True))
        ]
        self.patches = [Patch(f"{options.side} hand", modules)]
        self.geometry = _places(Hand(options.side), modules)
        super().__init__(options)

    async def describe(self, link: Link) -> Sequence[Patch]:
        """The hand; how long it takes for all its registers is learnt first."""
        await self.learn_period(link)
        return self.patches

    @classmethod
    def watch(cls, tables: SkinTables) -> Watch:
        """Pads that tell nothing but 0."""
        return ZeroWatch(tables)

    @operation(sets_up=True)
    async def enable(self, link: Link, patches: Sequence[Patch]) -> None:  # noqa: ARG002
        """Switch all pads on: writes 1 into their eleven switches."""
        await self.write(link, self._mapping.switches, [1] * len(_PADS), unit=self._unit)

    @operation(sets_up=True)
    async def zero(self, link: Link, patches: Sequence[Patch]) -> None:  # noqa: ARG002
        """Take the present values of all pads as zero: nothing may touch the hand."""
        await self.write(link, self._mapping.zero, [1], unit=self._unit)


def _places(hand: Hand, modules: Sequence[Module]) -> Geometry:
    """Nominal ones: the maker does not say where the taxels of a pad are; drawn as a block, in their order."""
    found = []
    for part in ("palm", *FINGERS):
        pads = [module for module in modules if module.name.startswith(part)]
        grids = [_block(len(pad.channels)) for pad in pads]
        for pad, grid, centre in zip(pads, grids, hand.down(part, grids), strict=True):
            found.append(grid.at(centre, ["pressure"], [sensor.uid for sensor in pad.channels if sensor is not None]))
    return Geometry.joined(found)


def _block(n: int) -> Grid:
    columns = int(np.ceil(np.sqrt(n)))
    return Grid(-(-n // columns), columns)


__all__ = ["Revo3Driver", "Revo3Options"]
