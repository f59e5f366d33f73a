"""Contactile's board DEV001 with up to five force sensors C3DFBS, and PapillArray sensors behind their Controller.

Both are on a USB serial port. Wire format of the DEV001: the maker's firmware 1.0.0 (contactile/dev001, 579be76 of
2024-08-07, ``src/main.cpp``) with its library (contactile/c3dfbs, 7651517 of 2025-02-04). Commands are lines of text,
answered by text. ``stream start -d all -f 500 -p binary`` starts all sensors that answer; then each sends records,
little-endian: port u32, time in ms u32, contents u32, and a float32 for each bit of the contents, from the lowest on:
0x20 temperature, 0x200 force z, 0x400 y, 0x800 x, in newtons. ``stream stop`` ends it; ``bias`` and ``bias 3`` take
zero, also while sensors send.

A record has no mark and no checksum, and text lies between records. A record counts only if its port and contents are
possible and those of the next one, right behind it, too. A sensor that was never zeroed sends no number.

Packets of the Controller (16c0:0483): see :mod:`.papillarray_packets`. Commands are ASCII lines without answers
(PTSCOM_2.0_SPEC_SEP22): ``z`` takes zero, ``S`` and ``s`` start and stop the detection of slip, ``f500`` sets the rate.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Mapping, Sequence
from typing import Annotated, Literal

import numpy as np
import numpy.typing as npt
from msgspec import Meta

from skinware.errors import BusError, HandshakeTimeout
from skinware.geometry import Geometry
from skinware.sensor_types import FORCE, TEMPERATURE, SensorType
from skinware_drivers import Link, Match, Module, Notice, Options, Patch, Sensor, operation
from skinware_drivers.fields import NO_NUMBER, Bits, DeviceTime, Identifier, SequenceNumber
from skinware_drivers.hand import Grid, Place
from skinware_drivers.layout import Frame, Layout, Values
from skinware_drivers.serial import Field, Packet, SerialAdapter, Unframed
from skinware_drivers.serial.framing import Encoding, Framing
from skinware_drivers.serial.papillarray_packets import (
    BLOCKS,
    MOST_PILLARS,
    NEWS,
    STAMP_SIZE,
    PapillArrayPackets,
    sizes_of,
)

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
        self.layout = Layout(
            [
                Frame(
                    "record",
                    [Identifier(0, 0x7F8)],
                    [values.end],
                    values,
                    module=Bits(shift=0, width=3),
                    flags=NO_NUMBER,
                    time=DeviceTime(0, "<u4", 1e-3),
                )
            ]
        )
        self._names = names
        self._described: Sequence[Patch] = ()
        self._is_started = False

    async def describe(self, link: Link) -> Sequence[Patch]:
        """Listen which sensors send, once all were started."""
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
        """Return the ports whose sensors send."""
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


_WHOLE, _LISTEN_S = 0xFF, 3.0
_PITCH_M = 0.007  # PTS_2.1_SPEC_JAN25


class PapillArrayOptions(Options, frozen=True):
    rate_hz: Annotated[Literal[100, 250, 500, 1000], Meta(description="packets per second")] = 500


class PapillArrayDriver(SerialAdapter[PapillArrayOptions]):
    """One Controller with its sensors; uid = sensor << 8 | pillar, or sensor << 8 | 255 for the whole sensor."""

    framing: Framing = PapillArrayPackets()
    commands: Encoding | None = Unframed()
    baudrate = 115_200
    types: Sequence[SensorType] = list({kind.id: kind for each in BLOCKS.values() for kind in each.types}.values())
    dtype: npt.DTypeLike = np.float32
    layout: Layout
    payload_size = STAMP_SIZE + MOST_PILLARS * 24

    def __init__(self, options: PapillArrayOptions) -> None:
        super().__init__(options)
        self.period_s: float = 1 / options.rate_hz
        self._heard: dict[int, int] = {}
        self._described: Sequence[Patch] = ()

    async def describe(self, link: Link) -> Sequence[Patch]:
        """Learn from a packet how many sensors there are, with how many pillars, and what is sent of them."""
        if not link.listen_only:
            await self.configure(link)
        self.change_framing(PapillArrayPackets())  # the first packet says what there is
        self._heard |= await self.listen(link)
        if not self._heard:
            raise BusError(f"{link.bus_name}: the Controller sends packets without a sensor: is one plugged in?")
        frames, modules, places = list[Frame](), list[Module](), list[Geometry]()
        for key, size in sorted(self._heard.items(), key=lambda item: (item[0] >> 4, item[0] & 0xF)):
            sensor, block = key >> 4, BLOCKS[key & 0xF]
            count = (size - STAMP_SIZE) // block.size
            uids = [sensor << 8 | pillar for pillar in range(count)] if block.of_pillars else [sensor << 8 | _WHOLE]
            states, others = block.types[: block.states], block.types[block.states :]
            channels = [Sensor(kind.name, uid) for part in (states, others) for uid in uids for kind in part]
            name = f"sensor {sensor} {block.name}"
            n_states = len(states) * len(uids)
            frames.append(_frame(name, key, n_states, len(channels), counted=block.name == "pillars"))
            modules.append(Module(channels, key, block.name, name))
            if block.name == "pillars":
                side = math.isqrt(count)
                grid, place = Grid(-(-count // side), side, _PITCH_M), Place(f"sensor_{sensor}_nominal")
                places.append(grid.at(place, [kind.name for kind in block.types], uids))
        self.layout = Layout(frames)
        self.geometry = Geometry.joined(places) if places else None
        self._described = [Patch("PapillArray", modules)]
        return self._described

    @classmethod
    async def identify(cls, link: Link, *, idle: bool) -> str:  # noqa: ARG003
        """Listen; the Controller sends once its port is open."""
        heard = await cls.listen(link)
        return f"Contactile PapillArray Controller, {len({key >> 4 for key in heard})} sensors"

    async def configure(self, link: Link) -> None:
        await link.send(0, b"f%d\n" % self.options.rate_hz)

    async def attend(self, link: Link) -> None:
        """Notice sensors and blocks that come later; those that are no longer sent become stale."""
        with link.follow(Match(NEWS)) as news:
            while True:
                heard = sizes_of((await news.get()).payload)
                if not heard.items() <= self._heard.items():
                    self._heard |= heard
                    self.tell(self._described[0], Notice.CHANGED)

    @operation(sets_up=True)
    async def tare(self, link: Link, patches: Sequence[Patch]) -> None:  # noqa: ARG002
        """Take the present forces as zero: nothing may touch the sensors for the next 2 s."""
        await link.send(0, b"z\n")

    @operation()
    async def slip(self, link: Link, patches: Sequence[Patch], on: bool = True) -> None:  # noqa: ARG002
        """Start the Controller's detection of slip, once pillars bear load (on=true), or stop it (on=false)."""
        await link.send(0, b"S\n" if on else b"s\n")

    @staticmethod
    async def listen(link: Link) -> Mapping[int, int]:
        """Return identifier and length of each frame of a packet."""
        heard: dict[int, int] = {}
        try:
            with link.follow(Match(0, 0)) as frames:
                async with asyncio.timeout(_LISTEN_S):
                    while (frame := await frames.get()).identifier not in (NEWS, *heard):
                        heard[frame.identifier] = len(frame.payload)
        except TimeoutError:
            raise HandshakeTimeout(
                f"{link.bus_name}: no packet of a PapillArray Controller came within {_LISTEN_S:g} s: are sensors"
                " plugged in, and its lamp HUB white?"
            ) from None
        return sizes_of(frame.payload) if frame.identifier == NEWS else heard


def _frame(name: str, key: int, n_states: int, n_channels: int, *, counted: bool) -> Frame:
    states = Values(STAMP_SIZE, "i1", n_states)
    others = Values(states.end, "<f4", n_channels - n_states, range(n_states, n_channels))
    return Frame(
        name,
        [Identifier(key)],
        [others.end],
        [states, others],
        module=key,
        flags=NO_NUMBER,
        sequence=SequenceNumber(0, "<u4") if counted else None,
        time=DeviceTime(4, "<u4", 1e-6),
    )
