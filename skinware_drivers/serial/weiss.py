"""Weiss Robotics' WTS tactile sensors and DSACON32m, the controller of the six tactile matrices of Schunk's hand SDH.

Wire format of the WTS: the programs wts_driver (github.com/ksatyaki/wts_driver) and wts-ft
(github.com/CNCR-NTU/wts-ft); where they contradict each other (byte order of the cells), the former. Frames: ``AA AA AA
| command | length u16 LE | payload | CRC u16 LE``, with a CRC over everything before it that is in no catalogue. A
response has the number of its command and begins with a status, u16 LE. Data come as command 0 without a status: time
in ms u32 LE, flags u8, cells u16 LE.

Not known: the payload of tare, which is sent empty unless the option ``tare_payload`` gives one; ksatyaki/wts_driver
82c46ac (2016-09-01) declares tare and untare as one command with a truth value, and implements neither. Run-length
coded data, which are documented for another device only, are not requested.

Wire format of the DSACON32m: the makers' SDHLibrary (dsa.h and dsa.cpp, Schunk 2008 to 2010, as in
github.com/skyellen/robwork-mirror; 0.0.2.10 of 2015 as in ipab-slmc/SDHLibrary-CPP, 0217d4e). 115200 baud. Frames: ``AA
AA AA | command | length u16 LE | payload | CRC u16 LE`` over command, length and payload, with the CRC of the WTS; a
frame without payload has none. An answer begins with an error u16 LE.

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
from abc import abstractmethod
from collections.abc import Iterable, Sequence
from typing import Annotated, Any, ClassVar, Literal, NamedTuple

import numpy as np
from msgspec import Meta

from skinware.errors import BusError, ConfigurationError
from skinware.geometry import Geometry
from skinware.nominal_hand import FINGERS
from skinware.sensor_types import PRESSURE, SensorType
from skinware.status import Status
from skinware_drivers import Link, Match, Module, Notice, Options, Patch, Sensor, operation, taxels
from skinware_drivers.fields import Above, AnyFlag, Byte, DeviceTime, Identifier, Sentinel
from skinware_drivers.hand import PITCH_M, Grid, Hand
from skinware_drivers.layout import Frame, Layout, Values
from skinware_drivers.options import OptionsT
from skinware_drivers.polling import ZeroWatch
from skinware_drivers.serial import CRC16_WEISS, Answers, Field, Length, Packet, Refused, SerialAdapter, Split

_AROUND = 8
"""Bytes of a frame beside its payload."""


def weiss_packet(most_payload: int, **more: Any) -> Packet:
    """Return the framing of a device whose longest payload has so many bytes; ``more``: as of :class:`Packet`."""
    return Packet(
        sync=(0xAA, 0xAA, 0xAA),
        length=Length(Field(4, 2), more=_AROUND),
        maximum=_AROUND + most_payload,
        checksum=CRC16_WEISS,
        identifier=Field(3),
        **more,
    )


class WeissAdapter(SerialAdapter[OptionsT]):
    """One device, which reports its cells; :meth:`describe` keeps the report in ``_cells``."""

    packet: ClassVar[Packet]
    answers: ClassVar[Answers]
    timeout_s: ClassVar[float]
    tries: ClassVar[int]

    def __init__(self, options: OptionsT) -> None:
        super().__init__(options)
        self._cells: Any = ()

    @property
    def payload_size(self) -> int:
        """Bytes of the most cells; their number is known only after the device was asked."""
        return -(-self.packet.maximum_body // 8) * 8

    async def probe(self, link: Link, patch: Patch) -> bool:
        """Return whether the same device answers: then it was reset, and no longer sends by itself."""
        if await self._ask_cells(link, tries=1) == self._cells:
            return True
        self.tell(patch, Notice.CHANGED)
        return False

    @classmethod
    @abstractmethod
    async def _ask_cells(cls, link: Link, *, tries: int | None = None) -> Any:
        """Ask for its cells."""

    @classmethod
    async def _ask(
        cls, link: Link, command: int, arguments: bytes = b"", *, size: int = 0, tries: int | None = None
    ) -> bytes:
        """Send a command and return the answer behind its status."""
        reply = await link.request(
            command, arguments, Match(command), timeout_s=cls.timeout_s, tries=cls.tries if tries is None else tries
        )
        return cls.answers.result(command, reply.payload, size)


_DATA, _START, _STOP, _TARE, _WTS_MATRIX, _TEMPERATURE = 0x00, 0x21, 0x22, 0x23, 0x30, 0x46
_HEADER = 5
_WTS_CELLS = 1024
_RLE = 1
_REASONS = {
    7: "a timeout",
    11: "the command's checksum was wrong on its side",
    14: "it does not know this command",
    16: "access is denied",
    27: "overrun: its line is too slow for its data",
}


class WeissWtsOptions(Options, frozen=True):
    period_ms: Annotated[int, Meta(ge=1, le=0xFFFF, description="time between two frames, ms")] = 10
    tare_payload: Annotated[str, Meta(description="payload of the command tare, in hexadecimal")] = ""

    def __post_init__(self) -> None:
        super().__post_init__()
        try:
            bytes.fromhex(self.tare_payload)
        except ValueError:
            raise ConfigurationError(f"option tare_payload: {self.tare_payload!r} is not hexadecimal") from None


class WeissWtsDriver(WeissAdapter[WeissWtsOptions]):
    packet = weiss_packet(_HEADER + 2 * _WTS_CELLS)
    answers = Answers("sensor", _REASONS, dtype="<u2")
    timeout_s, tries = 0.5, 3
    framing = packet
    dtype = np.uint16

    async def describe(self, link: Link) -> Sequence[Patch]:
        """Ask the sensor for its matrix; it may still be sending for an earlier program."""
        if link.listen_only:
            raise BusError("a sensor reports its number of cells only on request: listening is not enough")
        await self.stop(link)
        matrix = await self._ask_cells(link)
        columns, rows, width, height, full_scale = matrix
        count = columns * rows
        if not 1 <= count <= _WTS_CELLS or not full_scale:
            raise BusError(f"the sensor says it has {columns} x {rows} cells up to {full_scale}: that cannot be")
        link.log.info("%d x %d cells of %g x %g mm", columns, rows, width / 100, height / 100)
        self.types = [SensorType("pressure", 1, "raw", minimum=0, maximum=full_scale)]
        cells, time = Values(_HEADER, "<u2", count), DeviceTime(0, "<u4", 1e-3)
        plain = Frame("frame", [Identifier(_DATA), Byte(4, 0, _RLE)], [cells.end], cells, time=time)
        self.layout, self._cells = Layout([plain]), matrix
        return [Patch("WTS", [Module([Sensor("pressure", cell) for cell in range(count)], kind=f"{rows}x{columns}")])]

    @classmethod
    async def identify(cls, link: Link, *, idle: bool) -> str:  # noqa: ARG003
        columns, rows, *_ = await cls._ask_cells(link)
        return f"WTS with {columns} x {rows} cells"

    async def start(self, link: Link) -> None:
        await self._ask(link, _START, struct.pack("<BH", 0, self.options.period_ms))

    async def stop(self, link: Link) -> None:
        """Stop the data; a sensor that is silent already may refuse."""
        try:
            await self._ask(link, _STOP)
        except Refused as error:
            link.log.debug("%s", error)

    @operation(sets_up=True)
    async def tare(self, link: Link, patches: Sequence[Patch]) -> None:  # noqa: ARG002
        """Take the present values as zero."""
        await self._ask(link, _TARE, bytes.fromhex(self.options.tare_payload))

    @operation(looks=True)
    async def temperature(self, link: Link, patches: Sequence[Patch]) -> float:  # noqa: ARG002
        """Return the temperature of the sensor, degrees Celsius."""
        answer = await self._ask(link, _TEMPERATURE, size=2)
        return int.from_bytes(answer[:2], "little", signed=True) / 10

    @classmethod
    async def _ask_cells(cls, link: Link, *, tries: int | None = None) -> tuple[int, ...]:
        """Ask for columns, rows, width and height of a cell in 1/100 mm, and the greatest value."""
        return struct.unpack_from("<5H", await cls._ask(link, _WTS_MATRIX, size=10, tries=tries))


_CONTROLLER, _SENSOR, _ACQUIRE, _DSA_MATRIX = 0x01, 0x02, 0x03, 0x0B
_ON = 0x80
_PART, _TORN = 0x100, 0x200  # identifiers of the frame of a matrix, plus its number, and of data that fit none
_TIME = 4
_MOST_MATRICES, _DSA_CELLS = 16, 4096
_FULL = 0xFFF
_FLAGS: Sequence[AnyFlag] = (Sentinel(Status.OUT_OF_RANGE, _FULL), Above(Status.SUSPECT, _FULL))
_PARTS = ("proximal", "distal")
_WHOLE = weiss_packet(_HEADER + 2 * _DSA_CELLS, covers=(3, -2), bare_when_empty=True)


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
            answer = await cls._ask(link, _DSA_MATRIX, bytes([number]), size=12, tries=tries)
            width, height, columns, rows = struct.unpack_from("<ffHH", answer)
            found.append(_Matrix(columns, rows, width, height))
        if not all(found_one.cells for found_one in found) or sum(one.cells for one in found) > _DSA_CELLS:
            raise BusError(f"the controller says it has matrices of {found}: that cannot be")
        return tuple(found)


def _expanded(coded: bytes) -> bytes:
    """Expand run lengths: the count in the upper four bits of each u16, the value in the lower twelve."""
    units = np.frombuffer(coded[: len(coded) // 2 * 2], "<u2")
    return np.repeat(units & _FULL, units >> 12).astype("<u2").tobytes()
