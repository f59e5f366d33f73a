"""Weiss Robotics' WTS tactile sensors, which report how many cells they have.

Wire format: the programs wts_driver (github.com/ksatyaki/wts_driver) and wts_ft; where they contradict each other (byte
order of the cells), the former. Frames: see :mod:`.weiss`; the CRC is over everything before it. Data come as command 0
without a status: time in ms u32 LE, flags u8, cells u16 LE.

Not known: the payload of tare, which is sent empty unless the option ``tare_payload`` gives one; ksatyaki/wts_driver
82c46ac (2016-09-01) declares tare and untare as one command with a truth value, and implements neither. The meaning of
system information: the operation ``system`` returns its bytes. Run-length coded data are documented for another device
only, by two programs that disagree on where they begin.
"""

from __future__ import annotations

import logging
import struct
from collections.abc import Sequence
from typing import Annotated, Literal

import numpy as np
import numpy.typing as npt
from msgspec import Meta

from skinware.errors import BusError, ConfigurationError
from skinware.sensor_types import SensorType
from skinware_drivers import Link, Module, Options, Patch, Sensor, operation
from skinware_drivers.fields import Byte, DeviceTime, Identifier
from skinware_drivers.layout import Expand, Frame, Layout, Values
from skinware_drivers.serial import Answers, Refused
from skinware_drivers.serial.weiss import WeissAdapter, weiss_packet

log: logging.Logger = logging.getLogger("skinware.driver")

_DATA, _START, _STOP, _TARE, _MATRIX, _TEMPERATURE, _SYSTEM = 0x00, 0x21, 0x22, 0x23, 0x30, 0x46, 0x50
_HEADER = 5
_MOST_CELLS = 1024
_RLE = 1
_REASONS = {
    7: "a timeout",
    11: "the command's checksum was wrong on its side",
    14: "it does not know this command",
    16: "access is denied",
    27: "overrun: its line is too slow for its data",
}


class WeissWtsOptions(Options, frozen=True):
    """Options of the driver.

    Raises:
        ConfigurationError: an option is out of its limits, or ``rle`` is set without ``rle_offset``.
    """

    period_ms: Annotated[int, Meta(ge=1, le=0xFFFF, description="time between two frames, ms")] = 10
    rle: Annotated[bool, Meta(description="request run-length coded data; needs rle_offset")] = False
    rle_offset: Annotated[
        Literal[5, 11] | None, Meta(description="byte of the payload at which run-length coded data begin: not known")
    ] = None
    tare_payload: Annotated[str, Meta(description="payload of the command tare, in hexadecimal")] = ""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.rle and self.rle_offset is None:
            raise ConfigurationError(
                "option rle: the two public programs that decode run lengths disagree on where they begin (byte 5 in"
                " SDHLibrary, byte 11 in RobWork), for another device: find out, and say rle_offset"
            )
        try:
            bytes.fromhex(self.tare_payload)
        except ValueError:
            raise ConfigurationError(f"option tare_payload: {self.tare_payload!r} is not hexadecimal") from None


class WeissWtsDriver(WeissAdapter[WeissWtsOptions]):
    packet = weiss_packet(_HEADER + 2 * _MOST_CELLS)
    answers = Answers("sensor", _REASONS, dtype="<u2")
    timeout_s, tries = 0.5, 3
    framing = packet
    dtype = np.uint16

    async def describe(self, link: Link) -> Sequence[Patch]:
        """Ask the sensor for its matrix; it may still be sending for an earlier program.

        Raises:
            BusError: it does not answer, its answer is impossible, or it must not be asked.
        """
        if link.listen_only:
            raise BusError("a sensor reports its number of cells only on request: listening is not enough")
        await self.stop(link)
        matrix = await self._ask_cells(link)
        columns, rows, width, height, full_scale = matrix
        count = columns * rows
        if not 1 <= count <= _MOST_CELLS or not full_scale:
            raise BusError(f"the sensor says it has {columns} x {rows} cells up to {full_scale}: that cannot be")
        log.info("%s: %d x %d cells of %g x %g mm", link.bus_name, columns, rows, width / 100, height / 100)
        self.types = [SensorType("pressure", 1, "raw", minimum=0, maximum=full_scale)]
        self.layout, self._cells = self._layout(count), matrix
        return [Patch("WTS", [Module([Sensor("pressure", cell) for cell in range(count)], kind=f"{rows}x{columns}")])]

    @classmethod
    async def identify(cls, link: Link, *, idle: bool) -> str:  # noqa: ARG003
        columns, rows, *_ = await cls._ask_cells(link)
        return f"WTS with {columns} x {rows} cells"

    async def start(self, link: Link) -> None:
        await self._ask(link, _START, struct.pack("<BH", _RLE if self.options.rle else 0, self.options.period_ms))

    async def stop(self, link: Link) -> None:
        """Stop the data; a sensor that is silent already may refuse."""
        try:
            await self._ask(link, _STOP)
        except Refused as error:
            log.debug("%s: %s", link.bus_name, error)

    @operation(sets_up=True)
    async def tare(self, link: Link, patches: Sequence[Patch]) -> None:  # noqa: ARG002
        """Take the present values as zero."""
        await self._ask(link, _TARE, bytes.fromhex(self.options.tare_payload))

    @operation(looks=True)
    async def temperature(self, link: Link, patches: Sequence[Patch]) -> float:  # noqa: ARG002
        """Return the temperature of the sensor, degrees Celsius."""
        answer = await self._ask(link, _TEMPERATURE, size=2)
        return int.from_bytes(answer[:2], "little", signed=True) / 10

    @operation(looks=True)
    async def system(self, link: Link, patches: Sequence[Patch]) -> str:  # noqa: ARG002
        """Return the system information of the sensor: bytes in hexadecimal, whose meaning is not public."""
        return (await self._ask(link, _SYSTEM)).hex(" ")

    def _layout(self, count: int) -> Layout:
        time = DeviceTime(0, "<u4", 1e-3)
        size = _HEADER + 2 * count
        plain = Frame("frame", [Identifier(_DATA), Byte(4, 0, _RLE)], [size], Values(_HEADER, "<u2", count), time=time)
        offset = self.options.rle_offset
        if not self.options.rle or offset is None:
            return Layout([plain])
        lengths = range(offset + 2, offset + 2 * count + 1, 2)
        runs = Expand(lambda payload, length: _runs(payload, length, offset, count))
        return Layout([plain, Frame("runs", [Identifier(_DATA), Byte(4, _RLE, _RLE)], lengths, runs, time=time)])

    @classmethod
    async def _ask_cells(cls, link: Link, *, tries: int | None = None) -> tuple[int, ...]:
        """Ask for columns, rows, width and height of a cell in 1/100 mm, and the greatest value."""
        return struct.unpack_from("<5H", await cls._ask(link, _MATRIX, size=10, tries=tries))


Numbers = npt.NDArray[np.int64]


def _runs(
    payload: npt.NDArray[np.uint8], length: npt.NDArray[np.uint8], offset: int, count: int
) -> tuple[Numbers, Numbers, npt.NDArray[np.uint16]]:
    """Expand units of 16 bits: the count in the upper four, the value in the lower twelve."""
    n_units = (payload.shape[1] - offset) // 2
    units = np.ascontiguousarray(payload[:, offset : offset + 2 * n_units]).view("<u2").astype(np.int64)
    times = np.where(np.arange(n_units) < ((length.astype(np.int64) - offset) // 2)[:, None], units >> 12, 0)
    whole = np.flatnonzero(times.sum(axis=1) == count)
    row = np.repeat(whole, count)
    value = np.repeat((units[whole] & 0xFFF).ravel(), times[whole].ravel())
    return row, np.tile(np.arange(count), len(whole)), value.astype(np.uint16)
