"""Skin patches that are read with skintalk (Octocan): 24-bit cells, a record for each.

Wire format: ``skintalk.c`` and ``serialcfg.sh`` of skinvis (github.com/t173/skinvis). 2,000,000 baud. The byte '1'
starts all patches, '0' stops them; neither is answered. The firmware of OctoCan3 (``main.c`` of t173/octocan3, 38ef1cd
of 2024-01-26; one patch of 16 cells, 16 bits) has 115200 baud, starts with 'X', stops with 'S', finds an offset of its
converter for each cell with 'C', and answers each with a line of text.

A record has five bytes: 55, patch << 4 | cell, and the value as a big-endian signed number of 24 bits. Patches are
numbered from 1, cells from 0. skintalk.c shows one more for negative values (convert_24to32); this driver does not.

A record has no checksum and no counter. As in skintalk, it counts only if the next one's 55 comes right behind it, so
the last record before a pause waits for the next one. Only two bytes can be checked: noise can look like a record.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta

from skinware.errors import ConfigurationError
from skinware.sensor_types import PRESSURE
from skinware_drivers import Bits, Frame, Layout, Link, Module, Options, Packed, Patch, Values, operation, taxels
from skinware_drivers.serial import Field, Packet, SerialAdapter, Unframed

_COMMANDS = {"octocan": (b"1", b"0", 2_000_000), "octocan3": (b"X", b"S", 115_200)}
"""Start, stop and baud rate, by firmware."""
_CALIBRATE = b"C"


class SkintalkOptions(Options, frozen=True):
    patches: Annotated[tuple[int, ...], Meta(description="numbers of the patches, 0-15")] = tuple(range(1, 9))
    cells: Annotated[int, Meta(description="cells of each patch", ge=1, le=16)] = 16
    firmware: Annotated[Literal["octocan", "octocan3"], Meta(description="its commands and baud rate")] = "octocan"
    period_ms: Annotated[int, Meta(description="nominal time between two records of a cell, ms", ge=1)] = 20

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.patches or len(set(self.patches)) < len(self.patches) or not set(self.patches) <= set(range(16)):
            raise ConfigurationError(f"patches {self.patches}: give different numbers of 0 to 15")


class SkintalkDriver(SerialAdapter[SkintalkOptions]):
    """All patches of a serial line; uid = patch << 4 | cell.

    Each cell has records of its own, so it is a module and becomes stale alone. Records of patches or cells that the
    options do not name are counted as unknown.
    """

    types = (PRESSURE.measured(unit="counts", minimum=-(1 << 23), maximum=(1 << 23) - 1),)
    dtype = np.int32
    framing = Packet(sync=b"\x55", length=5, identifier=Field(1), confirmed="each")
    commands = Unframed()

    def __init__(self, options: SkintalkOptions) -> None:
        super().__init__(options)
        self._start, self._stop, self.baudrate = _COMMANDS[options.firmware]
        values = Values(0, Packed(24, signed=True), 1)
        self.layout = Layout((Frame("record", (), (3,), values, patch=Bits(4, 4), module=Bits(0, 4)),))
        self.patches = tuple(
            Patch(
                f"patch {number}",
                [Module(taxels(1, first_uid=number << 4 | i), key=i, kind="cell") for i in range(options.cells)],
                key=number,
            )
            for number in options.patches
        )

    async def start(self, link: Link) -> None:
        await link.send(0, self._start)

    async def stop(self, link: Link) -> None:
        await link.send(0, self._stop)

    @operation()
    async def calibrate(self, link: Link, patches: Sequence[Patch]) -> None:  # noqa: ARG002
        """Have OctoCan3 find the offset of each cell, which it forgets without power; nothing may touch the skin."""
        if self.options.firmware != "octocan3":
            raise ValueError("only OctoCan3 has this command (option firmware)")
        await link.send(0, _CALIBRATE)
