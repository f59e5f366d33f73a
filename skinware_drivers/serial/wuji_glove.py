"""Wuji's tactile glove board: 24 x 32 cells on a USB serial port (0483:5700).

Wire format: github.com/wuji-technology/wujihandpy (MIT), a version of 2026 whose cells are float32. All frames: sync,
length u16 LE of the whole frame, body, CRC-16/CCITT-FALSE u16 LE over everything from the length on.

* ``AA 55`` data: hand u8, 3 bytes of padding, 768 cells float32 LE from 0 to 1 (NaN: invalid), sequence number u16,
  time in ms u32.
* ``AA 56`` commands: number u16, sequence number u16, arguments. ``AA 57`` answers: the same two, status u8, result.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from typing import Annotated

import numpy as np
from msgspec import Meta

from skinware.errors import BusError
from skinware.sensor_types import PRESSURE
from skinware.status import Status
from skinware_drivers import Link, Match, Module, Options, Patch, Sensor, operation
from skinware_drivers.fields import DeviceTime, Identifier, Sentinel, SequenceNumber
from skinware_drivers.layout import Frame, Layout, Values
from skinware_drivers.serial import CRC16_CCITT_FALSE, Answers, Field, Length, Packet, SerialAdapter

_INFO, _HAND, _DIAGNOSTICS, _STREAM, _GET, _SET = 0x0101, 0x0103, 0x0301, 0x0401, 0x0501, 0x0502
_STREAMING, _RATE, _U16 = 1, 2, 0  # keys of configuration values, and the type of the rate
_DATA, _ANSWER = 0x55, 0x57
_ROWS, _COLUMNS = 24, 32
_N = _ROWS * _COLUMNS
_BODY = 3082
_TIMEOUT_S, _TRIES = 1.0, 3  # the line stalls for half a second now and then, by the maker's program
_USUAL_HZ = 120.0
_ANSWERS = Answers(
    "board", {0x10: "bad length", 0x11: "bad checksum", 0x12: "unknown command", 0x13: "bad arguments"}, offset=4
)


class WujiGloveOptions(Options, frozen=True):
    rate_hz: Annotated[int, Meta(ge=0, le=1000, description="frames per second; 0: leave the board's own")] = 0


class WujiGloveDriver(SerialAdapter[WujiGloveOptions]):
    framing = Packet(
        sync=(0xAA, (_DATA, _ANSWER)),
        length=Length(Field(2, 2), more=0),
        maximum=3088,
        checksum=CRC16_CCITT_FALSE,
        covers=(2, -2),
        identifier=Field(1),
    )
    commands = Packet(
        sync=(0xAA, 0x56),
        length=Length(Field(2, 2), more=0),
        maximum=512,
        checksum=CRC16_CCITT_FALSE,
        covers=(2, -2),
    )
    types = (PRESSURE.measured(unit="1", minimum=0, maximum=1),)
    dtype = np.float32
    layout = Layout(
        [
            Frame(
                "frame",
                [Identifier(_DATA)],
                [_BODY],
                Values(4, "<f4", _N),
                flags=[Sentinel(Status.NOT_CONNECTED, math.nan)],
                sequence=SequenceNumber(4 + 4 * _N, "<u2"),
                time=DeviceTime(6 + 4 * _N, "<u4", 1e-3),
            )
        ]
    )

    def __init__(self, options: WujiGloveOptions) -> None:
        super().__init__(options)
        self._number = 0
        self._wanted_hz = options.rate_hz
        self.period_s = 1 / (options.rate_hz or _USUAL_HZ)
        self._on = True
        self._was_on: bool | None = None

    async def describe(self, link: Link) -> Sequence[Patch]:
        """Ask the board which hand it is for; a listener does without."""
        name = "glove"
        if not link.listen_only:
            info, hand = await self._ask(link, _INFO, size=32), await self._ask(link, _HAND, size=1)
            serial_number = info[:24].rstrip(b"\0 ").decode("ascii", "backslashreplace")
            link.log.info("glove board %s, firmware %s", serial_number, info[28:32].hex("."))
            name = {0: "left glove", 1: "right glove"}.get(hand[0], name)
            if not self._wanted_hz:
                self.period_s = 1 / await self._get_rate(link)
        module = Module([Sensor("pressure", cell) for cell in range(_N)], kind=f"{_ROWS}x{_COLUMNS}")
        return [Patch(name, [module])]

    @classmethod
    async def identify(cls, link: Link, *, idle: bool) -> str:  # noqa: ARG003
        """Ask which hand it is for; no question disturbs a board that sends."""
        [patch] = await cls(WujiGloveOptions()).describe(link)
        return f"Wuji {patch.name}"

    async def configure(self, link: Link) -> None:
        if self._wanted_hz:
            await self._set_rate(link, self._wanted_hz)

    async def start(self, link: Link) -> None:
        if self._was_on is None:
            self._was_on = (await self._ask(link, _GET, struct.pack("<H", _STREAMING), size=2))[1] != 0
        await self._ask(link, _STREAM, bytes([self._on]))

    async def stop(self, link: Link) -> None:
        if not self._was_on:  # the maker's example expects a board that sends from its power-up
            await self._ask(link, _STREAM, b"\0")

    async def probe(self, link: Link, patch: Patch) -> bool:  # noqa: ARG002
        """Return whether the board answers; False if it was switched off."""
        if not self._on:
            return False
        await self._ask(link, _INFO, size=32, tries=1)
        return True

    @operation()
    async def rate(self, link: Link, patches: Sequence[Patch], hz: int) -> float:  # noqa: ARG002
        """Set the frames per second; return the rate that the board has now."""
        if not 1 <= hz <= 1000:
            raise ValueError(f"{hz} Hz: give 1 to 1000")
        await self._set_rate(link, hz)
        self._wanted_hz = hz
        return 1 / self.period_s

    @operation()
    async def enable(self, link: Link, patches: Sequence[Patch], on: bool = True) -> None:  # noqa: ARG002
        """Make the board send (on=true) or be silent (on=false)."""
        await self._ask(link, _STREAM, bytes([on]))
        self._on = on

    @operation(looks=True)
    async def counts(self, link: Link, patches: Sequence[Patch]) -> dict[str, float]:  # noqa: ARG002
        """Return the board's counters: uptime_s, frames, checksum_errors, dropouts, usb_resets."""
        uptime_ms, *counts = struct.unpack_from("<IIIIH", await self._ask(link, _DIAGNOSTICS, size=18))
        names = ("frames", "checksum_errors", "dropouts", "usb_resets")
        return {"uptime_s": uptime_ms / 1000, **dict(zip(names, counts, strict=True))}

    async def _set_rate(self, link: Link, hz: int) -> None:
        await self._ask(link, _SET, struct.pack("<HBH", _RATE, _U16, hz))
        self.period_s = 1 / await self._get_rate(link)

    async def _get_rate(self, link: Link) -> float:
        answer = await self._ask(link, _GET, struct.pack("<H", _RATE), size=3)
        hz = int.from_bytes(answer[1:], "little")
        if answer[0] != _U16 or not hz:
            raise BusError(f"the board says that its rate is {answer.hex(' ')}: that is none")
        return float(hz)

    async def _ask(
        self, link: Link, command: int, arguments: bytes = b"", *, size: int = 0, tries: int = _TRIES
    ) -> bytes:
        self._number = self._number % 0xFFFF + 1
        head = struct.pack("<HH", command, self._number)
        answer = Match(_ANSWER, prefix=head)
        reply = await link.request(0, head + arguments, answer, timeout_s=_TIMEOUT_S, tries=tries)
        return _ANSWERS.result(command, reply.payload, size)
