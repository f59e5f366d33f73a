"""Weiss Robotics' WTS tactile sensors, which report how many cells they have, and the protocol of that maker.

Wire format: the programs wts_driver (github.com/ksatyaki/wts_driver) and wts-ft (github.com/CNCR-NTU/wts-ft); where
they contradict each other (byte order of the cells), the former. Frames: ``AA AA AA | command | length u16 LE | payload
| CRC u16 LE``, with a CRC over everything before it that is in no catalogue. A response has the number of its command
and begins with a status, u16 LE.
Data come as command 0 without a status: time in ms u32 LE, flags u8, cells u16 LE.

Not known: the payload of tare, which is sent empty unless the option ``tare_payload`` gives one; ksatyaki/wts_driver
82c46ac (2016-09-01) declares tare and untare as one command with a truth value, and implements neither. Run-length
coded data, which are documented for another device only, are not requested.
"""

from __future__ import annotations

import struct
from abc import abstractmethod
from collections.abc import Sequence
from typing import Annotated, Any, ClassVar

import numpy as np
from msgspec import Meta

from skinware.errors import BusError, ConfigurationError
from skinware.sensor_types import SensorType
from skinware_drivers import Link, Match, Module, Notice, Options, Patch, Sensor, operation
from skinware_drivers.fields import Byte, DeviceTime, Identifier
from skinware_drivers.layout import Frame, Layout, Values
from skinware_drivers.options import OptionsT
from skinware_drivers.serial import CRC16_WEISS, Answers, Field, Length, Packet, Refused, SerialAdapter

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


_DATA, _START, _STOP, _TARE, _MATRIX, _TEMPERATURE = 0x00, 0x21, 0x22, 0x23, 0x30, 0x46
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
    period_ms: Annotated[int, Meta(ge=1, le=0xFFFF, description="time between two frames, ms")] = 10
    tare_payload: Annotated[str, Meta(description="payload of the command tare, in hexadecimal")] = ""

    def __post_init__(self) -> None:
        super().__post_init__()
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
        """Ask the sensor for its matrix; it may still be sending for an earlier program."""
        if link.listen_only:
            raise BusError("a sensor reports its number of cells only on request: listening is not enough")
        await self.stop(link)
        matrix = await self._ask_cells(link)
        columns, rows, width, height, full_scale = matrix
        count = columns * rows
        if not 1 <= count <= _MOST_CELLS or not full_scale:
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
        return struct.unpack_from("<5H", await cls._ask(link, _MATRIX, size=10, tries=tries))
