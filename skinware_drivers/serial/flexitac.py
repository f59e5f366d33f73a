"""FlexiTac and 3D-ViTac: a matrix of resistive cells, read by an Arduino that sends by itself.

Wire format, 2,000,000 baud: the makers' firmware, ``32_16_fast.ino`` of FlexiTac/FlexiTac_Hardware_Repo and
``template.ino`` of WT-MM/PyFlexiTac: ``AA 55`` and a byte for each cell, row by row, without a pause between frames.
A frame has no checksum, counter or size, and AA 55 also occurs among the cells: a frame counts only if the next one
begins right behind it, and of places at which AA 55 recurs, one is chosen (``framing.c``). The board takes no command.
The older firmware (``MatrixArray.ino`` of binghao-huang/3D-ViTac_Tactile_Hardware) sends text: a line for each row,
``12 0 255`` and a space, and an empty line behind each matrix; lines end with 0D 0A.

The distance from one marker to the next gives the number of cells, and the published sizes give rows and columns.
Cells of a sound pad rest at 10 to 40 counts (PyFlexiTac), and cells with broken wires read 0 (an issue of the maker's):
0 is marked as doubtful, unless an option says otherwise.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Iterable, Sequence
from typing import Annotated, Literal, NamedTuple

import numpy as np
from msgspec import Meta

from skinware.errors import BusError, ConfigurationError, HandshakeTimeout
from skinware.sensor_types import PRESSURE
from skinware.status import Status
from skinware_drivers import Link, Match, Module, Notice, Options, Patch, taxels
from skinware_drivers.fields import Byte, Identifier, Sentinel
from skinware_drivers.hand import Grid, Place
from skinware_drivers.layout import Frame, Layout, Values
from skinware_drivers.serial import Packet, Recurring, SerialAdapter, TextMatrix
from skinware_drivers.serial.framing import Framing

_MARKER = b"\xaa\x55"
_SIZES = {256: (16, 16), 384: (12, 32), 512: (16, 32), 1024: (32, 32)}
"""Rows and columns of the boards that are published, by their number of cells."""
_MOST_LINES, _FEWEST_CELLS, _MOST_CELLS = 64, 16, max(_SIZES)
_LISTEN_S = 3.0
"""An Arduino that was reset because its port was opened is silent for two seconds."""
_PERIOD_MS = {"binary": 10, "text": 31}  # as reported for 16 x 32 cells, and for 16 x 16 in text
_FRAME = "pad_nominal"


class FlexiTacOptions(Options, frozen=True):
    size: Annotated[
        str, Meta(pattern=r"^(\d{1,2}x\d{1,2})?$", description="ROWSxCOLUMNS, as 12x32; default: by listening")
    ] = ""
    firmware: Annotated[Literal["binary", "text"], Meta(description="text: of the older 3D-ViTac boards")] = "binary"
    zero: Annotated[Literal["suspect", "good"], Meta(description="status of a cell that reads 0")] = "suspect"
    period_ms: Annotated[
        int, Meta(ge=0, description="nominal time between two frames, ms; 0: 10, or 31 for text firmware")
    ] = 0
    pitch_mm: Annotated[float, Meta(gt=0, description="distance of neighbouring cells, for views")] = 2.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.shape and not all(0 < n <= _MOST_LINES for n in self.shape):
            raise ConfigurationError(f"option size={self.size}: 1 to {_MOST_LINES} rows and columns")

    @property
    def shape(self) -> tuple[int, ...]:
        """Rows and columns; empty: by listening."""
        return tuple(int(n) for n in self.size.split("x")) if self.size else ()


class HeardSize(NamedTuple):
    """The size of a matrix: its number of cells, and its rows and columns if they are known."""

    cells: int
    shape: tuple[int, int] | None


class FlexiTacDriver(SerialAdapter[FlexiTacOptions]):
    """One board on a serial line: one matrix, in the order of the wire. uid = row * columns + column."""

    framing: Framing = Recurring(_MARKER, _MOST_CELLS, _FEWEST_CELLS)
    baudrate = 2_000_000
    types = (PRESSURE.measured(unit="counts", minimum=0, maximum=255),)
    dtype = np.uint8

    def __init__(self, options: FlexiTacOptions) -> None:
        super().__init__(options)
        self.period_s = (options.period_ms or _PERIOD_MS[options.firmware]) / 1e3
        self._heard: HeardSize | None = None
        count = math.prod(options.shape) if options.shape else _MOST_CELLS
        self._hearing: Framing = Recurring(_MARKER, max(count, _MOST_CELLS), min(count, _FEWEST_CELLS))
        if options.firmware == "text":
            self._hearing = TextMatrix(_MOST_LINES, _MOST_LINES, identifier=1)
        self.framing = self._hearing

    @property
    def payload_size(self) -> int:
        """Bytes of the largest matrix; the size is known only after listening."""
        return -(-self._hearing.maximum_body // 8) * 8

    async def describe(self, link: Link) -> Sequence[Patch]:
        self._heard = None
        self._heard = heard = await self.hear_size(link)
        rows, columns = self._agreed(link, heard)
        link.log.info("a matrix of %d x %d cells", rows, columns)
        of_size = [Byte(0, rows), Byte(1, columns)] if self.options.firmware == "text" else []
        cells = Values(len(of_size), "u1", rows * columns)
        flags = [Sentinel(Status.OUT_OF_RANGE, 255)]
        if self.options.zero == "suspect":
            flags.append(Sentinel(Status.SUSPECT, 0))
        self.layout = Layout([Frame("matrix", [Identifier(0), *of_size], [cells.end], cells, flags=flags)])
        self._read_on()
        pitch_m, uid = self.options.pitch_mm / 1e3, range(rows * columns)
        self.geometry = Grid(rows, columns, pitch_m).at(Place(_FRAME), ["pressure"], uid)
        return (Patch("pad", (Module(taxels(len(uid)), kind=f"{rows}x{columns}", name="matrix"),)),)

    @classmethod
    async def identify(cls, link: Link, *, idle: bool) -> str | None:  # noqa: ARG003
        heard = await cls(FlexiTacOptions()).hear_size(link)
        return None if heard.shape is None else f"FlexiTac with {_in_words([heard.shape])} cells"

    async def probe(self, link: Link, patch: Patch) -> bool:
        """Check whether another board was plugged in; boards take no command, so none can be set up again."""
        if await self.hear_size(link) != self._heard:
            self.tell(patch, Notice.CHANGED)
        return False

    async def hear_size(self, link: Link) -> HeardSize:
        self.change_framing(self._hearing)
        try:
            with link.follow(Match(0, 0)) as heard:
                async with asyncio.timeout(_LISTEN_S):
                    body = (await heard.get()).payload
        except TimeoutError:
            raise HandshakeTimeout(
                f"{link.bus_name}: no matrix was heard within {_LISTEN_S:g} s; if something else comes (skin-info shows"
                " skipped bytes): is the firmware the older one (option firmware=text), the size none of"
                f" {_in_words(_SIZES.values())} (option size), or the baud rate another?"
            ) from None
        finally:
            self._read_on()
        if self.options.firmware == "text":
            return HeardSize(len(body) - 2, (body[0], body[1]))
        return HeardSize(len(body), _SIZES.get(len(body)))

    def _agreed(self, link: Link, heard: HeardSize) -> tuple[int, int]:
        wanted, known = self.options.shape, heard.shape
        is_exact = self.options.firmware == "text"
        if wanted and (wanted == known if is_exact else math.prod(wanted) == heard.cells):
            return wanted[0], wanted[1]
        words = f"{link.bus_name}: matrices of {heard.cells} cells are heard"
        if known is not None:
            words += f", which is {_in_words([known])}"
        if wanted:
            suggested = _in_words([known]) if known else "ROWSxCOLUMNS of as many"
            raise BusError(f"{words}; option size={self.options.size} has not: say size={suggested}")
        if known is None:
            raise BusError(f"{words}, which is no published board: say size=ROWSxCOLUMNS")
        return known

    def _read_on(self) -> None:
        """Change to the framing of the size that was heard; C finds the binary frames."""
        if self._heard is None:
            return
        if self.options.firmware == "text":
            self.change_framing(TextMatrix(_MOST_LINES, _MOST_LINES))
        else:
            self.change_framing(Packet(sync=_MARKER, length=len(_MARKER) + self._heard.cells, confirmed="each"))


def _in_words(shapes: Iterable[tuple[int, int]]) -> str:
    return ", ".join(f"{rows}x{columns}" for rows, columns in shapes)
