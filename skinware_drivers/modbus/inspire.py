"""Inspire Robots' RH56DFTP hand: 17 matrices with 1062 taxels, over Modbus TCP or RTU. The driver writes nothing.

Source: the maker's manual PRJ-02-TS-U-010 V1.0.0, an older one (R1), and the bridge that Unitree publishes.

Taxels are in the holding registers from 3000 on, one after the other. *Addresses count bytes*: the register after 3000
is 3002. Fingers are row-major; the palm is column-major, each column from the last row up. Two rules are inferred, not
documented: addresses count bytes in all reads, and a read may cross the border of two matrices. The option
``by_matrix`` needs neither.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Literal, NamedTuple

import numpy as np
import numpy.typing as npt
from msgspec import Meta

from skinware.geometry import Geometry
from skinware.sensor_types import PRESSURE, SensorType
from skinware.status import Status
from skinware_drivers.description import Module, Patch, Sensor
from skinware_drivers.fields import Above, AnyFlag, Sentinel
from skinware_drivers.hand import Grid, Hand
from skinware_drivers.link import Link
from skinware_drivers.modbus.adapter import ExplainingWatch, ModbusAdapter, above_text
from skinware_drivers.modbus.registers import Registers
from skinware_drivers.options import Options

_FIRST, _BYTES = 3000, 2
_FULL_SCALE = 4096


class _PadMatrix(NamedTuple):
    part: str
    name: str
    address: int
    rows: int
    columns: int


_MATRICES = (
    _PadMatrix("little", "tip", 3000, 3, 3),
    _PadMatrix("little", "top", 3018, 12, 8),
    _PadMatrix("little", "pad", 3210, 10, 8),
    _PadMatrix("ring", "tip", 3370, 3, 3),
    _PadMatrix("ring", "top", 3388, 12, 8),
    _PadMatrix("ring", "pad", 3580, 10, 8),
    _PadMatrix("middle", "tip", 3740, 3, 3),
    _PadMatrix("middle", "top", 3758, 12, 8),
    _PadMatrix("middle", "pad", 3950, 10, 8),
    _PadMatrix("index", "tip", 4110, 3, 3),
    _PadMatrix("index", "top", 4128, 12, 8),
    _PadMatrix("index", "pad", 4320, 10, 8),
    _PadMatrix("thumb", "tip", 4480, 3, 3),
    _PadMatrix("thumb", "top", 4498, 12, 8),
    _PadMatrix("thumb", "middle", 4690, 3, 3),
    _PadMatrix("thumb", "pad", 4708, 12, 8),
    _PadMatrix("palm", "", 4900, 8, 14),
)


class InspireOptions(Options, frozen=True):
    side: Annotated[Literal["right", "left"], Meta(description="which hand it is")] = "right"
    unit: Annotated[int, Meta(ge=0, le=255, description="number of the hand; the manual has 255 over TCP")] = 1
    period_ms: Annotated[
        Annotated[float, Meta(ge=1, le=10_000)] | None,
        Meta(description="time between two readings of the whole hand; default: 20, or as long as the line needs"),
    ] = None
    by_matrix: Annotated[
        bool, Meta(description="read each matrix by itself: 17 questions instead of 9, and no rule about addresses")
    ] = False


class InspireWatch(ExplainingWatch):
    meanings = ((Status.SUSPECT, above_text(_FULL_SCALE)),)


class InspireDriver(ModbusAdapter[InspireOptions]):
    types: Sequence[SensorType] = (PRESSURE.measured(unit="counts", minimum=0, maximum=_FULL_SCALE),)
    dtype: npt.DTypeLike = np.uint16
    flags: Sequence[AnyFlag] = (Sentinel(Status.OUT_OF_RANGE, _FULL_SCALE), Above(Status.SUSPECT, _FULL_SCALE))
    address_step = _BYTES
    watch = InspireWatch

    def __init__(self, options: InspireOptions) -> None:
        self.follows_line = options.period_ms is None
        if options.by_matrix:  # no address is computed, and no two matrices are read together
            self.address_step, self.largest_gap = 1, 0
        registers, modules = list[Registers](), list[Module]()
        for number, each in enumerate(_MATRICES):
            count, name = each.rows * each.columns, f"{each.part} {each.name}".rstrip()
            registers.append(Registers(each.address, count, options.unit, to=_channels(each), patch=0, module=number))
            sensors = [Sensor("pressure", uid) for uid in _uids(each)]
            modules.append(Module(sensors, number, f"{each.rows}x{each.columns}", name))
        self.registers, self.patches = registers, [Patch(f"{options.side} hand", modules)]
        hand, places = Hand(options.side), []  # the manual gives no lengths
        for part in dict.fromkeys(matrix.part for matrix in _MATRICES):
            matrices = [matrix for matrix in _MATRICES if matrix.part == part]
            grids = [Grid(matrix.rows, matrix.columns) for matrix in matrices]
            for matrix, grid, centre in zip(matrices, grids, hand.down(part, grids), strict=True):
                places.append(grid.at(centre, ["pressure"], _uids(matrix)))
        self.geometry = Geometry.joined(places)
        super().__init__(options)

    async def describe(self, link: Link) -> Sequence[Patch]:
        """Measure how long the hand takes for all its registers, then return it."""
        await self.learn_period(link)
        return self.patches


def _channels(matrix: _PadMatrix) -> list[int]:
    grid = np.arange(matrix.rows * matrix.columns).reshape(matrix.rows, matrix.columns)
    order = grid[::-1].T if matrix.part == "palm" else grid
    return [int(place) for place in order.ravel()]


def _uids(matrix: _PadMatrix) -> list[int]:
    """Return the number of each taxel's register, from 3000 on, row by row."""
    first = (matrix.address - _FIRST) // _BYTES
    return [first + int(place) for place in np.argsort(_channels(matrix))]
