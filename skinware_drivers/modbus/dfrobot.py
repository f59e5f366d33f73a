"""DFRobot's tactile arrays SEN0704 and SEN0705 (6 x 6, 4 x 8, piezoresistive), over Modbus RTU. It writes nothing.

Source: the maker's libraries for Arduino and Python (DFRobot/DFRobot_TactileSensor, 2025), and a program that reads
several arrays on one line with them. Input registers: 0001 the maker, 3343 (hexadecimal); 0006 the state, 1 = ready;
from 0007 on the cells, 12 bits, row by row from the lowest row up; 002B the model, 0 = 4 x 8, 1 = 6 x 6.

It is inferred, not documented, that state and cells can be read with one question; ``--no-state`` reads the cells
alone. The maker's programs write registers with the low byte first, and read them with the high byte first; the bus'
option ``byte_order`` is for arrays that differ.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Annotated, Literal

import numpy as np
import numpy.typing as npt
from msgspec import Meta

from skinware.errors import BusError, ConfigurationError
from skinware.geometry import Geometry
from skinware.sensor_types import PRESSURE, SensorType
from skinware.status import Status
from skinware_drivers.decoding.decoder import Updates
from skinware_drivers.description import Module, Patch, Sensor, SkinTables
from skinware_drivers.fields import Above, AnyFlag, Flag, Sentinel
from skinware_drivers.hand import Grid, Place
from skinware_drivers.link import Link
from skinware_drivers.modbus.adapter import ExplainingWatch, ModbusAdapter, above_text
from skinware_drivers.modbus.registers import Registers
from skinware_drivers.modbus.wire import READ_INPUT
from skinware_drivers.options import Options

log: logging.Logger = logging.getLogger("skinware.driver")

Shape = Literal["4x8", "6x6"]
"""Rows and columns."""

_MAKER_AT, _STATE_AT, _CELLS_AT, _MODEL_AT = 0x0001, 0x0006, 0x0007, 0x002B
_MAKER, _READY = 0x3343, 1
_FULL_SCALE = 4095
_GRIDS: Mapping[Shape, Grid] = {"4x8": Grid(4, 8), "6x6": Grid(6, 6)}
_MODELS: Mapping[int, Shape] = {0: "4x8", 1: "6x6"}


class DfrobotOptions(Options, frozen=True):
    units: Annotated[
        tuple[Annotated[int, Meta(ge=1, le=31)], ...], Meta(min_length=1, description="numbers of the arrays")
    ] = (1,)
    shapes: Annotated[
        tuple[Shape, ...],
        Meta(description="rows and columns of each array, or of all; default: ask each"),
    ] = ()
    state: Annotated[bool, Meta(description="read along whether an array is ready; no: the cells alone")] = True
    period_ms: Annotated[
        Annotated[float, Meta(ge=1, le=10_000)] | None,
        Meta(description="time between two readings of all arrays; default: 20, or as long as the line needs"),
    ] = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(set(self.units)) < len(self.units):
            raise ConfigurationError("option units: name each array once")
        if len(self.shapes) not in (0, 1, len(self.units)):
            raise ConfigurationError(f"option shapes: give one, or {len(self.units)}, one for each of the units")


class DfrobotWatch(ExplainingWatch):
    """Also log which arrays are not ready."""

    meanings = ((Status.SUSPECT, above_text(_FULL_SCALE)),)

    def __init__(self, tables: SkinTables) -> None:
        super().__init__(tables)
        self._is_logged: npt.NDArray[np.bool_] = np.zeros(tables.structure.n_modules, bool)

    def look(self, updates: Updates) -> None:
        super().look(updates)
        unready = np.unique(updates.module[(updates.status & Status.NOT_CONNECTED).any(axis=1)])
        for module in unready[~self._is_logged[unready]].tolist():
            log.warning("%s is not ready (register 0006 is not 1)", self.tables.structure.module_names[module])
        self._is_logged[unready] = True

    def forget(self, patch: int) -> None:
        """Log again of an array that was set up again."""
        super().forget(patch)
        self._is_logged[self.tables.structure.module_patch == patch] = False


class DfrobotDriver(ModbusAdapter[DfrobotOptions]):
    types: Sequence[SensorType] = (PRESSURE.measured(unit="counts", minimum=0, maximum=_FULL_SCALE),)
    dtype: npt.DTypeLike = np.uint16
    flags: Sequence[AnyFlag] = (Sentinel(Status.OUT_OF_RANGE, _FULL_SCALE), Above(Status.SUSPECT, _FULL_SCALE))
    timeout_s = 0.05
    watch = DfrobotWatch

    def __init__(self, options: DfrobotOptions) -> None:
        self.follows_line = options.period_ms is None
        super().__init__(options)

    async def describe(self, link: Link) -> Sequence[Patch]:
        """Ask each array for its shape, unless the options give it."""
        units, shapes = self.options.units, list(self.options.shapes)
        if not shapes:
            if link.listen_only:
                raise BusError("arrays must be asked for their shape, listening is not enough: say option shapes")
            shapes = [await self._ask_shape(link, unit) for unit in units]
        has_state = self.options.state and not link.listen_only  # another master may not read it
        unready = Flag(Status.NOT_CONNECTED, 0, ">u2", mask=0xFFFF, normal=_READY)
        registers, patches, places = list[Registers](), list[Patch](), list[Geometry]()
        for unit, shape in zip(units, shapes * len(units) if len(shapes) == 1 else shapes, strict=True):
            grid = _GRIDS[shape]
            # of each register the cell, row by row from the top, and of each cell the register: it is its own inverse
            cells = np.arange(grid.rows * grid.columns).reshape(grid.rows, -1)[::-1].ravel().tolist()
            if has_state:
                block = Registers(_STATE_AT, 1 + len(cells), unit, READ_INPUT, to=[None, *cells], flags=[unready])
            else:
                block = Registers(_CELLS_AT, len(cells), unit, READ_INPUT, to=cells)
            registers.append(replace(block, patch=unit))
            uids = [unit << 8 | cell for cell in cells]
            patches.append(Patch(f"unit {unit}", [Module([Sensor("pressure", uid) for uid in uids], kind=shape)], unit))
            # no pitch is published, and how two arrays lie to each other is not known
            places.append(grid.at(Place(f"unit_{unit}_nominal"), ["pressure"], uids))
        self.use_registers(registers)
        self.patches, self.geometry = patches, Geometry.joined(places)
        return patches

    @classmethod
    async def identify(cls, link: Link, *, idle: bool) -> str | None:  # noqa: ARG003
        """Ask unit 1, the number with which arrays are sold, whether it is one."""
        adapter = cls(DfrobotOptions())
        [unit] = adapter.options.units
        [maker] = await adapter.read(link, _MAKER_AT, unit=unit, function=READ_INPUT)
        if maker != _MAKER:
            return None
        return f"DFRobot tactile array, unit {unit}, {await adapter._ask_shape(link, unit)}"

    async def _ask_shape(self, link: Link, unit: int) -> Shape:
        [model] = await self.read(link, _MODEL_AT, unit=unit, function=READ_INPUT)
        if model not in _MODELS:
            raise BusError(
                f"{link.bus_name}, unit {unit}: model {model} is neither 0 (4x8) nor 1 (6x6): say option shapes"
                + (", and byte_order=little as option of the bus" if model == 0x0100 else "")
            )
        return _MODELS[int(model)]
