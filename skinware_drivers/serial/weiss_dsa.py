"""Weiss Robotics' DSACON32m, the controller of the tactile matrices of Schunk's hand SDH (six DSA matrices).

Wire format: the makers' SDHLibrary (dsa.h and dsa.cpp, Schunk 2008 to 2010, as in github.com/skyellen/robwork-mirror;
0.0.2.10 of 2015 as in ipab-slmc/SDHLibrary-CPP, 0217d4e).
115200 baud. Frames: ``AA AA AA | command | length u16 LE | payload | CRC u16 LE`` over command, length and payload,
with the CRC of the WTS; a frame without payload has none. An answer begins with an error u16 LE.

* ``02`` -> error, matrices u16, 8 more bytes. ``0B | matrix`` -> 52 bytes: error, width and height of a cell (mm,
  float32), columns u16, rows u16, ...
* ``03 | flags | frames per second u16`` -> error. Flags: 80 acquire, 01 run lengths. Any rate above 0 is the highest;
  0 with 80 is a single frame, but starts firmware up to 288 except 269 (cDSA::ReadFrame).
* Data: command 0, time in ms u32, flags, cells u16 of 12 bits: matrix by matrix, row by row.

Not known: two programs disagree on where run-length coded data begin, so the driver requests them only if
``rle_offset`` gives the byte. Counts are raw: the library's factor to N/mm2 is that of one measurement.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable, Sequence
from typing import Annotated, Literal, NamedTuple

import numpy as np
from msgspec import Meta

from skinware.errors import BusError
from skinware.geometry import Geometry
from skinware.nominal_hand import FINGERS
from skinware.sensor_types import PRESSURE
from skinware.status import Status
from skinware_drivers import Link, Module, Options, Patch, operation, taxels
from skinware_drivers.fields import Above, AnyFlag, DeviceTime, Identifier, Sentinel
from skinware_drivers.hand import PITCH_M, Grid, Hand
from skinware_drivers.layout import Frame, Layout, Values
from skinware_drivers.polling import ZeroWatch
from skinware_drivers.serial import Answers, Refused, Split
from skinware_drivers.serial.weiss_wts import WeissAdapter, weiss_packet

_DATA, _CONTROLLER, _SENSOR, _ACQUIRE, _MATRIX = 0x00, 0x01, 0x02, 0x03, 0x0B
_ON, _RLE = 0x80, 0x01
_PART, _TORN = 0x100, 0x200  # identifiers of the frame of a matrix, plus its number, and of data that fit none
_HEADER, _TIME = 5, 4
_MOST_MATRICES, _MOST_CELLS = 16, 4096
_FULL = 0xFFF
_FLAGS: Sequence[AnyFlag] = (Sentinel(Status.OUT_OF_RANGE, _FULL), Above(Status.SUSPECT, _FULL))
_PARTS = ("proximal", "distal")
_WHOLE = weiss_packet(_HEADER + 2 * _MOST_CELLS, covers=(3, -2), bare_when_empty=True)


class WeissDsaOptions(Options, frozen=True):
    rle_offset: Annotated[
        Literal[5, 11] | None,
        Meta(description="request run-length coded data, which begin at this byte of the payload: not certain"),
    ] = None
    period_ms: Annotated[int, Meta(ge=10, le=1000, description="expected time between two frames, ms")] = 100


class _Matrix(NamedTuple):
    columns: int
    rows: int
    width_mm: float
    height_mm: float

    @property
    def cells(self) -> int:
        return self.columns * self.rows

    @property
    def grid(self) -> Grid:
        """Its cells, with the pitch that it reports, if that is plausible."""
        pitch_m = math.sqrt(self.width_mm * self.height_mm) / 1e3 if self.width_mm * self.height_mm > 0 else 0.0
        return Grid(self.rows, self.columns, pitch_m if 0.0005 <= pitch_m <= 0.05 else PITCH_M)


class WeissDsaDriver(WeissAdapter[WeissDsaOptions]):
    """One controller; uid = matrix << 12 | cell, row by row."""

    packet = _WHOLE
    answers = Answers("controller", {}, dtype="<u2")
    timeout_s, tries = 1.0, 4  # it is silent for some 8 s after power-up
    framing = _WHOLE
    commands = _WHOLE
    types = (PRESSURE.measured(unit="counts", minimum=0, maximum=_FULL),)
    dtype = np.uint16
    watch = ZeroWatch

    def __init__(self, options: WeissDsaOptions) -> None:
        super().__init__(options)
        self.period_s = options.period_ms / 1e3
        self.geometry = None
        self._cells: tuple[_Matrix, ...] = ()

    async def describe(self, link: Link) -> Sequence[Patch]:
        """Ask the controller for its matrices; it may still be sending for an earlier program."""
        if link.listen_only:
            raise BusError("a DSA controller reports its matrices only on request: listening is not enough")
        self.change_framing(_WHOLE)
        await self.stop(link)
        matrices = await self._ask_cells(link)
        link.log.info("matrices of %s cells", ", ".join(f"{m.rows}x{m.columns}" for m in matrices))
        time, frames, modules, places = DeviceTime(0, "<u4", 1e-3), [], [], []
        for number, matrix in enumerate(matrices):
            name, first = f"finger {number // 2 + 1} {_PARTS[number % 2]}", number << 12
            modules.append(
                Module(taxels(matrix.cells, first_uid=first), number, f"{matrix.rows}x{matrix.columns}", name)
            )
            cells = Values(_TIME, "<u2", matrix.cells)
            when = [Identifier(_PART | number)]
            frames.append(Frame(name, when, [cells.end], cells, module=number, time=time, flags=_FLAGS))
        for finger in range(min(len(FINGERS), -(-len(matrices) // 2))):
            of_finger = list(enumerate(matrices))[2 * finger : 2 * finger + 2][::-1]  # the distal one is above
            centres = Hand().down(FINGERS[finger], [matrix.grid for _, matrix in of_finger])
            for (number, matrix), centre in zip(of_finger, centres, strict=True):
                uids = range(number << 12, (number << 12) + matrix.cells)
                places.append(matrix.grid.at(centre, ["pressure"], uids))
        self.layout, self.geometry, self._cells = Layout(frames), Geometry.joined(places), matrices
        self.change_framing(self.split())
        return [Patch("DSA", modules)]

    @classmethod
    async def identify(cls, link: Link, *, idle: bool) -> str:  # noqa: ARG003
        """Ask for its number of matrices; no question stops a controller that sends."""
        matrices = await cls._ask_cells(link, tries=1)
        return f"Weiss DSA controller with {len(matrices)} matrices"

    async def start(self, link: Link) -> None:
        flags = _ON | (0 if self.options.rle_offset is None else _RLE)
        await self._ask(link, _ACQUIRE, struct.pack("<BH", flags, 30))

    async def stop(self, link: Link) -> None:
        try:
            await self._ask(link, _ACQUIRE, struct.pack("<BH", _RLE, 0))  # as the makers' library
        except Refused as error:
            link.log.debug("%s", error)

    @operation(looks=True)
    async def controller(self, link: Link, patches: Sequence[Patch]) -> dict[str, int]:  # noqa: ARG002
        """Return serial number, hardware and software version of the controller."""
        answer = await self._ask(link, _CONTROLLER, size=7)
        serial_number, hardware, software = struct.unpack_from("<IBH", answer)
        return {"serial_number": serial_number, "hardware": hardware, "software": software}

    def split(self) -> Split:
        """Return the framing of this controller: a frame for each matrix."""
        return Split(_WHOLE, self._split)

    def _split(self, identifier: int, body: bytes) -> Iterable[tuple[int, bytes]]:
        if identifier != _DATA or len(body) < _HEADER:
            return [(identifier, body)]
        cells = body[_HEADER:]
        if body[_TIME] & _RLE:
            cells = _expanded(body[self.options.rle_offset or _HEADER :])
        ends = np.cumsum([2 * matrix.cells for matrix in self._cells]).tolist()
        if len(cells) != ends[-1]:
            return [(_TORN, body)]
        starts = [0, *ends[:-1]]
        return [
            (_PART | number, body[:_TIME] + cells[start:end])
            for number, (start, end) in enumerate(zip(starts, ends, strict=True))
        ]

    @classmethod
    async def _ask_cells(cls, link: Link, *, tries: int | None = None) -> tuple[_Matrix, ...]:
        [count] = struct.unpack_from("<H", await cls._ask(link, _SENSOR, size=2, tries=tries))
        if not 1 <= count <= _MOST_MATRICES:
            raise BusError(f"the controller says it has {count} matrices: that cannot be")
        found = []
        for number in range(count):
            answer = await cls._ask(link, _MATRIX, bytes([number]), size=12, tries=tries)
            width, height, columns, rows = struct.unpack_from("<ffHH", answer)
            found.append(_Matrix(columns, rows, width, height))
        if not all(found_one.cells for found_one in found) or sum(one.cells for one in found) > _MOST_CELLS:
            raise BusError(f"the controller says it has matrices of {found}: that cannot be")
        return tuple(found)


def _expanded(coded: bytes) -> bytes:
    """Expand run lengths: the count in the upper four bits of each u16, the value in the lower twelve."""
    units = np.frombuffer(coded[: len(coded) // 2 * 2], "<u2")
    return np.repeat(units & _FULL, units >> 12).astype("<u2").tobytes()
