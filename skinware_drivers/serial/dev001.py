"""Contactile's board DEV001 with up to five force sensors C3DFBS, on its USB serial port.

Wire format: the maker's firmware 1.0.0 (contactile/dev001, 579be76 of 2024-08-07, ``src/main.cpp``) with its library
(contactile/c3dfbs, 7651517 of 2025-02-04). Commands are lines of text, answered by text. ``stream start -d all -f 500
-p binary`` starts all sensors that answer; then each sends records, little-endian: port u32, time in ms u32, contents
u32, and a float32 for each bit of the contents, from the lowest on: 0x20 temperature, 0x200 force z, 0x400 y, 0x800 x,
in newtons. ``stream stop`` ends it; ``bias`` and ``bias 3`` take zero, also while sensors send.

A record has no mark and no checksum, and text lies between records. A record counts only if its port and contents are
possible and those of the next one, right behind it, too. A sensor that was never zeroed sends no number.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Sequence
from typing import Annotated

import numpy as np
import numpy.typing as npt
from msgspec import Meta

from skinware.errors import HandshakeTimeout
from skinware.sensor_types import FORCE, TEMPERATURE, SensorType
from skinware.status import Status
from skinware_drivers import Link, Match, Module, Notice, Options, Patch, Sensor, operation
from skinware_drivers.fields import Bits, DeviceTime, Identifier, Sentinel
from skinware_drivers.layout import Frame, Layout, Values
from skinware_drivers.serial import Field, Packet, SerialAdapter, Unframed
from skinware_drivers.serial.framing import Encoding

_PORTS = range(5)
_ANY = range(256)
_HEAD, _BEFORE_BODY = 12, 4
_FORCES, _TEMPERATURE = 0x0E00, 0x20
_AGAIN_S = 1.0
_FIRST_S = 3.0


class Dev001Options(Options, frozen=True):
    rate_hz: Annotated[int, Meta(ge=25, le=1000, description="records per second of each sensor")] = 500
    temperature: Annotated[bool, Meta(description="send temperatures, too")] = True
    learn_s: Annotated[float, Meta(ge=0.1, le=10, description="time to learn which ports have a sensor, s")] = 0.5


class Dev001Driver(SerialAdapter[Dev001Options]):
    """One board: a patch, with a module for each sensor; uid = port."""

    commands: Encoding | None = Unframed()
    baudrate = 115_200
    types: Sequence[SensorType] = (*FORCE, TEMPERATURE.measured(unit="counts"))  # not published
    dtype: npt.DTypeLike = np.float32

    def __init__(self, options: Dev001Options) -> None:
        super().__init__(options)
        self.period_s: float = 1 / options.rate_hz
        names = (["temperature"] if options.temperature else []) + ["force_z", "force_y", "force_x"]
        contents = _FORCES | (_TEMPERATURE if options.temperature else 0)
        possible = [list(_PORTS), 0, 0, 0, *[_ANY] * 4, *contents.to_bytes(4, "little")]
        size = _HEAD + 4 * len(names)
        self.framing = Packet(sync=possible, length=size, header=_BEFORE_BODY, identifier=Field(0), confirmed="each")
        values = Values(_HEAD - _BEFORE_BODY, "<f4", len(names))
        no_number = [Sentinel(Status.SUSPECT, value) for value in (math.nan, math.inf, -math.inf)]
        self.layout = Layout(
            [
                Frame(
                    "record",
                    [Identifier(0, 0x7F8)],
                    [values.end],
                    values,
                    module=Bits(shift=0, width=3),
                    flags=no_number,
                    time=DeviceTime(0, "<u4", 1e-3),
                )
            ]
        )
        self._names = names
        self._described: Sequence[Patch] = ()
        self._is_started = False

    async def describe(self, link: Link) -> Sequence[Patch]:
        """Listen which sensors send, once all were started.

        Raises:
            HandshakeTimeout: none does.
        """
        if not link.listen_only:
            self._is_started = False
            await self.start(link)
            self._is_started = True
        ports = sorted(await self.heard(link) | {module.key for patch in self._described for module in patch.modules})
        modules = [
            Module([Sensor(name, port) for name in self._names], port, "C3DFBS", f"port {port}") for port in ports
        ]
        self._described = [Patch("DEV001", modules)]
        return self._described

    @classmethod
    async def identify(cls, link: Link, *, idle: bool) -> str:  # noqa: ARG003
        """Listen whether a board sends: its commands are words that others might obey."""
        ports = await cls(Dev001Options()).heard(link)
        return f"Contactile DEV001, {len(ports)} sensors"

    async def start(self, link: Link) -> None:
        """Make the sensors send, unless ``describe`` just did: the board's text would spoil their records."""
        if self._is_started:
            self._is_started = False
            return
        what = "all" if self.options.temperature else "force"
        await link.send(0, f"stream start -d {what} -f {self.options.rate_hz} -p binary\n".encode())

    async def stop(self, link: Link) -> None:
        await link.send(0, b"stream stop\n")

    async def attend(self, link: Link) -> None:
        """Notice sensors that send later."""
        with link.follow(Match(0, 0)) as others:
            while True:
                await others.get()
                self.tell(self._described[0], Notice.CHANGED)
                await link.sleep(_AGAIN_S)

    @operation(sets_up=True)
    async def tare(self, link: Link, patches: Sequence[Patch]) -> None:  # noqa: ARG002
        """Take the present forces as zero: nothing may touch the sensors, which send nothing meanwhile."""
        await link.send(0, b"bias\n")

    async def heard(self, link: Link) -> set[int]:
        """Return the ports whose sensors send.

        Raises:
            HandshakeTimeout: none does.
        """
        with link.follow(Match(0, 0)) as records:
            try:
                async with asyncio.timeout(_FIRST_S):
                    ports = {(await records.get()).identifier}
            except TimeoutError:
                raise HandshakeTimeout(
                    f"{link.bus_name}: no sensor sends within {_FIRST_S:g} s: does the text command `info` of the board"
                    " find any, in the mode (I2C, SPI) that the board is in?"
                ) from None
            await link.sleep(self.options.learn_s)
            while not records.empty():
                ports.add(records.get_nowait().identifier)
        return ports
