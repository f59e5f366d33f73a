"""XELA uSkin on CAN: three-axis taxels, one frame for each.

Wire format: ur-o2as ``o2as_xela_sensor.py`` (a 4x4 sensor; github.com/o2ac/ur-o2as) and uskin_can_drivers
``src/can_communication.cpp`` (a 4x6 sensor; github.com/ARQ-CRISP/uskin_can_drivers). 1 Mbit/s. Start: identifier
``0x200 | board``, ``07 00``; stop: ``07 01``. Data: eight bytes, byte 0 unused, then X, Y and Z as big-endian uint16,
byte 7 unused.

The identifiers of the taxels depend on the model. Both published schemes are implemented:

* consecutive (4x4 model): ``first_id + taxel``, first 0x710;
* row_column (4x6 model): ``first_id | row << 4 | column``, first 0x100; taxel = column * rows + row.

A message is not always a new sample: in a recording of 506 messages a second, taxels keep their values over many
messages, and the wire does not show which. It carries no checksum and no sequence number, and no command is answered.
"""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from msgspec import Meta

from skinware.errors import ConfigurationError
from skinware.geometry import Geometry
from skinware.sensor_types import PRESSURE, SHEAR_X, SHEAR_Y
from skinware_drivers import Bits, Frame, Identifier, Layout, Link, Module, Options, Patch, Values, taxels
from skinware_drivers.can import CanAdapter
from skinware_drivers.hand import Grid, Place

_PITCH_M = 0.0047
_AXES = ("shear_x", "shear_y", "pressure")


class XelaOptions(Options, frozen=True):
    boards: Annotated[tuple[int, ...], Meta(description="numbers of the boards, 1-15")] = (1,)
    ids: Annotated[
        Literal["consecutive", "row_column"],
        Meta(description="how identifiers name taxels: first + taxel, or first | row << 4 | column"),
    ] = "consecutive"
    first_id: Annotated[tuple[int, ...], Meta(description="identifier of the first taxel of each board, as 0x710")] = (
        0x710,
    )
    rows: Annotated[int, Meta(description="rows of taxels", ge=1, le=16)] = 4
    columns: Annotated[int, Meta(description="columns of taxels", ge=1, le=16)] = 4
    period_ms: Annotated[int, Meta(description="nominal time between two messages of a taxel, ms", ge=1)] = 10

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.boards or len(set(self.boards)) < len(self.boards) or not set(self.boards) <= set(range(1, 16)):
            raise ConfigurationError(f"boards {self.boards}: give different numbers of 1 to 15")
        if len(self.first_id) != len(self.boards):
            raise ConfigurationError(f"{len(self.boards)} boards, but first_id has {len(self.first_id)}: give one each")
        known: set[int] = set()
        for board, first in zip(self.boards, self.first_id, strict=True):
            block = Identifier.covering(self.identifiers(first))
            taken = {i for i in range(0x800) if i & block.mask == block.value}
            if max(self.identifiers(first)) > 0x7FF:
                raise ConfigurationError(f"board {board}: identifiers from {first:#x} on go beyond 0x7FF")
            if taken & known:
                raise ConfigurationError(f"board {board}: its identifiers from {first:#x} on mix with another board's")
            known |= taken

    def identifiers(self, first: int) -> list[int]:
        if self.ids == "consecutive":
            return [first + taxel for taxel in range(self.rows * self.columns)]
        return [first | row << 4 | column for column in range(self.columns) for row in range(self.rows)]

    def geometry(self) -> Geometry:
        """Return nominal places: a grid for each board, at the pitch of the models whose pitch is published."""
        grid, numbers = Grid(self.rows, self.columns, _PITCH_M), np.arange(self.rows * self.columns)
        cells = numbers if self.ids == "consecutive" else numbers % self.rows * self.columns + numbers // self.rows
        return Geometry.joined(
            [
                grid.at(Place(f"board_{b}_nominal"), _AXES, (b << 16 | numbers).tolist(), cells.tolist())
                for b in self.boards
            ]
        )


class XelaDriver(CanAdapter[XelaOptions]):
    """uSkin boards, a patch each. Each taxel is a module of three sensors with one uid = board << 16 | taxel.

    Values are raw (idle about 32 to 37 thousand); only the maker's closed server computes forces.
    """

    types = tuple(t.measured(unit="counts", minimum=0, maximum=0xFFFF) for t in (SHEAR_X, SHEAR_Y, PRESSURE))
    dtype = np.uint16

    def __init__(self, options: XelaOptions) -> None:
        super().__init__(options)
        ids = {b: options.identifiers(first) for b, first in zip(options.boards, options.first_id, strict=True)}
        axes = Values(offset=1, dtype=">u2", count=3)
        self.geometry = options.geometry()
        patches, frames = [], []
        for board, own in ids.items():
            first_uid = board << 16
            modules = [
                Module(taxels(1, *_AXES, first_uid=first_uid | taxel), identifier, "taxel")
                for taxel, identifier in enumerate(own)
            ]
            patches.append(Patch(f"board {board}", modules, key=board))
            when = (Identifier.covering(own),)
            frames.append(Frame(f"board {board}", when, (8,), axes, patch=board, module=Bits(0, 11)))
        self.patches = patches
        self.layout = Layout(frames)

    async def start(self, link: Link) -> None:
        for board in self.options.boards:
            await link.send(0x200 | board, b"\x07\x00")

    async def stop(self, link: Link) -> None:
        for board in self.options.boards:
            await link.send(0x200 | board, b"\x07\x01")

    async def probe(self, link: Link, patch: Patch) -> bool:
        """Send the start command to a silent board, which may have lost its power: it answers no question."""
        await link.send(0x200 | patch.key, b"\x07\x00")
        return False
