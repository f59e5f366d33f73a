"""Robotiq's tactile fingertips TSF-85 of a gripper 2F-85, on a USB serial port (16d0:14cc, older ones 04b4:f232).

Wire format: the maker's ``pyrobotiqtactile`` 0.1.2 (package index, BSD-3). A packet is ``9A``, a check byte, a command,
the number of bytes behind it, and fields. A field is a byte (high nibble: kind, bits 3 and 2: finger) and big-endian
values: 1 static 28 u16 in seven rows, 2 dynamic i16, 3 accelerometer, 4 gyroscope, 5 magnetometer 3 i16 each,
6 temperature i16, 7 time u64. Fields come in any number and order. Commands: ``61`` read once, ``58`` n and ``59`` n
send every n ms, synchronous or not, ``E3`` version. ``E2`` starts the bootloader and is never sent.

The check byte is 00 in the maker's program, which does not check it. By an older program (etienne-roberge/
tactilesensors4, commit 0419b28 of 2021-01-11, ``Communication.h``) it is a CRC-8 of what is behind it, which that
program does not compute either; its polynomial is not published. It is not looked at: a packet with data counts only
if its fields fill it, and if it begins right behind another one or the next one begins right behind it. Each field
becomes a frame: its finger's time u32, values.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, NamedTuple

import numpy as np
import numpy.typing as npt
from msgspec import Meta

from skinware.errors import BusError
from skinware.realtime import NS_PER_S
from skinware.sensor_types import ACCELERATION, ANGULAR_RATE, MAGNETIC_FIELD, PRESSURE, TEMPERATURE, SensorType
from skinware_drivers import Link, Match, Module, Options, Patch, operation, taxels
from skinware_drivers.fields import Bits, DeviceTime, Identifier
from skinware_drivers.layout import Frame, Layout, Values
from skinware_drivers.serial.adapter import SerialAdapter
from skinware_drivers.serial.framing import Encoding, Field, Framed, Framer, Framing, ReceivedFraming
from skinware_drivers.serial.packets import Length, Packet

log: logging.Logger = logging.getLogger("skinware.driver")

_START = 0x9A
_READ, _SYNCHRONOUS, _ASYNCHRONOUS, _VERSION = 0x61, 0x58, 0x59, 0xE3
_WITH_DATA = (_READ, _SYNCHRONOUS, _ASYNCHRONOUS)
_KNOWN = (*_WITH_DATA, _VERSION)
_HEAD, _BEGINNING, _MOST_DATA = 4, 3, 255
_TIME, _FINGERS = 7, 2
_UNTIMED, _ANSWER = 0x400, 0x200
"""Bits of identifiers: a field in a packet without its finger's time; an answer to the command below."""
_TIMEOUT_S, _TRIES, _FIRST_S = 0.5, 2, 3.0
_UNITS_S = (1e-3, 1e-6, 1e-9)
_LIKENESS = 0.2

DYNAMIC = SensorType("dynamic_pressure", 0x16D0 << 12 | 1, "counts", minimum=-32768, maximum=32767)
"""Fast changes of the pressure, whose unit the maker does not publish."""


class _Kind(NamedTuple):
    name: str
    dtype: str
    types: Sequence[SensorType]
    taxels: int = 1

    @property
    def values(self) -> int:
        return self.taxels * len(self.types)


def _counts(types: Sequence[SensorType]) -> list[SensorType]:
    return [kind.measured(unit="counts", minimum=-32768, maximum=32767) for kind in types]


_KINDS: Mapping[int, _Kind] = {
    1: _Kind("static", ">u2", [PRESSURE.measured(unit="counts", minimum=0, maximum=65535)], 28),
    2: _Kind("dynamic", ">i2", [DYNAMIC]),
    3: _Kind("accelerometer", ">i2", _counts(ACCELERATION)),
    4: _Kind("gyroscope", ">i2", _counts(ANGULAR_RATE)),
    5: _Kind("magnetometer", ">i2", _counts(MAGNETIC_FIELD)),
    6: _Kind("temperature", ">i2", _counts([TEMPERATURE])),
}


@dataclass(frozen=True)
class RobotiqPackets(ReceivedFraming):
    """The framing, for receiving.

    Args:
        times: also make a frame of each field with the time.
    """

    times: bool = False
    maximum_body: int = field(default=_MOST_DATA, init=False)

    def framer(self) -> Framer:
        return _Packets(self.times)


class _Packets(Framer):
    def __init__(self, times: bool) -> None:
        super().__init__()
        self._times = times
        self._followed = -1  # end of the last packet in the stream

    def _find(self, stream: bytes) -> tuple[list[Framed], int]:
        found: list[Framed] = []
        done = 0
        while (at := stream.find(_START, done)) >= 0:
            self.counters.skipped_bytes += at - done
            done = at
            if len(stream) < at + _HEAD:
                return found, at
            command, end = stream[at + 2], at + _HEAD + stream[at + 3]
            follows = self._before + at == self._followed
            needed = end + (_BEGINNING if command in _WITH_DATA and not follows else 0)
            if command in _KNOWN and len(stream) < needed:
                return found, at
            frames = self._frames(stream, at, end) if command in _KNOWN else None
            if frames is not None and needed > end and (stream[end] != _START or stream[end + 2] not in _KNOWN):
                frames = None
            if frames is None:
                self.counters.refused += 1
                self.counters.skipped_bytes += 1
                done = at + 1
            else:
                self.counters.frame_bytes += end - at
                found += frames
                done = end
                self._followed = self._before + end
        self.counters.skipped_bytes += len(stream) - done
        return found, len(stream)

    def _frames(self, stream: bytes, at: int, end: int) -> list[Framed] | None:
        """Return the frames of a packet; None if it is none."""
        command, data, position = stream[at + 2], stream[at + _HEAD : end], self._before + end
        if command not in _WITH_DATA:
            return [Framed(_ANSWER | command, data, position)]
        if not data:  # a command is confirmed
            return [Framed(_ANSWER | command, data, position)]
        fields = _fields(data)
        if fields is None:
            return None
        times = {finger: value[-4:][::-1] for kind, finger, value in fields if kind == _TIME}
        return [
            Framed(
                kind << 4 | finger | (0 if finger in times else _UNTIMED),
                times.get(finger, bytes(4)) + (b"" if kind == _TIME else value),
                position,
            )
            for kind, finger, value in fields
            if kind != _TIME or self._times
        ]


def _fields(data: bytes) -> list[tuple[int, int, bytes]] | None:
    """Return kind, finger and value of the fields of a packet; None if they do not fill it."""
    found = []
    at = 0
    while at < len(data):
        kind, finger = data[at] >> 4, data[at] >> 2 & 3
        size = 8 if kind == _TIME else 2 * _KINDS[kind].values if kind in _KINDS else 0
        if not size or finger >= _FINGERS or at + 1 + size > len(data):
            return None
        found.append((kind, finger, data[at + 1 : at + 1 + size]))
        at += 1 + size
    return found


class RobotiqTsfOptions(Options, frozen=True):
    period_ms: Annotated[int, Meta(ge=1, le=255, description="time between two packets that the sensor sends, ms")] = 10
    learn_s: Annotated[
        float, Meta(ge=0.1, le=60, description="time to learn fingers and how often each kind of value comes, s")
    ] = 1.0


class RobotiqTsfDriver(SerialAdapter[RobotiqTsfOptions]):
    """Both fingertips; a patch is a finger, a module is a kind of value; uid = finger << 8 | kind << 5 | taxel."""

    framing: Framing = RobotiqPackets()
    commands: Encoding | None = Packet(
        sync=b"\x9a\0", length=Length(Field(3), more=_HEAD), maximum=_HEAD + _MOST_DATA, identifier=Field(2)
    )
    baudrate = 115_200
    types: Sequence[SensorType] = tuple(kind for each in _KINDS.values() for kind in each.types)
    dtype: npt.DTypeLike = np.int32
    layout: Layout
    payload_size = 256

    def __init__(self, options: RobotiqTsfOptions) -> None:
        super().__init__(options)
        self.period_s: float = options.period_ms / 1e3

    async def describe(self, link: Link) -> Sequence[Patch]:
        """Listen to what the sensor sends, once it was asked to send by itself."""
        if not link.listen_only:
            await self.start(link)
        self.change_framing(RobotiqPackets(times=True))
        try:
            heard = await self._hear(link)
        finally:
            self.change_framing(RobotiqPackets())
        times = {key & 3: stamps for key, stamps in heard.items() if key >> 4 == _TIME}
        self.layout = _layout(_unit_of(times))
        log.info("%s: device time in %s", link.bus_name, _unit_of(times) or "a unit that is not known: it is not used")
        return [self._finger(finger, heard) for finger in sorted({identifier & 3 for identifier in heard})]

    async def _hear(self, link: Link) -> dict[int, list[tuple[int, int]]]:
        """Return when fields came, ns, and their times, by identifier."""
        heard: dict[int, list[tuple[int, int]]] = {}
        with link.follow(Match(0, 0)) as frames:
            for _ in range(round(_FIRST_S / self.options.learn_s) + 1):
                await link.sleep(self.options.learn_s)
                while not frames.empty():
                    frame = frames.get_nowait()
                    if not frame.identifier & _ANSWER:
                        stamp = int.from_bytes(frame.payload[:4], "little")
                        heard.setdefault(frame.identifier, []).append((frame.time_ns, stamp))
                if heard:
                    return heard
        raise BusError(f"{link.bus_name}: no data of fingertips within {_FIRST_S:g} s")

    async def start(self, link: Link) -> None:
        """Let the sensor send by itself."""
        await link.send(_SYNCHRONOUS, bytes([self.options.period_ms]))

    async def stop(self, link: Link) -> None:
        await link.send(_SYNCHRONOUS, b"\0")

    @classmethod
    async def identify(cls, link: Link, *, idle: bool) -> str:  # noqa: ARG003
        """Ask for the version, which disturbs nothing."""
        return f"Robotiq TSF-85, version {await cls(RobotiqTsfOptions()).version(link, ())}"

    @operation(looks=True)
    async def version(self, link: Link, patches: Sequence[Patch]) -> str:  # noqa: ARG002
        """Return the version of the sensor's firmware, as bytes in hex."""
        answer = await link.request(_VERSION, b"", Match(_ANSWER | _VERSION), timeout_s=_TIMEOUT_S, tries=_TRIES)
        return answer.payload.hex(".")

    def _finger(self, finger: int, heard: Mapping[int, Sequence[tuple[int, int]]]) -> Patch:
        modules = []
        for key, kind in _KINDS.items():
            times_ns = sorted(time_ns for bit in (0, _UNTIMED) for time_ns, _ in heard.get(key << 4 | finger | bit, ()))
            period_s = 2 * self.options.learn_s  # not heard, or once
            if len(times_ns) > 1:
                period_s = (times_ns[-1] - times_ns[0]) / NS_PER_S / (len(times_ns) - 1)
            channels = taxels(kind.taxels, *(each.name for each in kind.types), first_uid=finger << 8 | key << 5)
            shape = "7x4" if kind.taxels > 1 else kind.name
            slow = period_s if period_s > 1.5 * self.period_s else None
            modules.append(Module(channels, key=key, kind=shape, name=kind.name, period_s=slow))
        return Patch(f"finger {finger + 1}", modules, key=finger)


def _layout(unit_s: float | None) -> Layout:
    return Layout(
        [
            Frame(
                f"{kind.name}{suffix}",
                [Identifier(bit | key << 4, 0x7F0)],
                [4 + 2 * kind.values],
                Values(4, kind.dtype, kind.values),
                patch=Bits(shift=0, width=2),
                module=Bits(shift=4, width=3),
                time=None if bit or unit_s is None else DeviceTime(0, "<u4", unit_s),
            )
            for key, kind in _KINDS.items()
            for bit, suffix in ((0, ""), (_UNTIMED, " without time"))
        ]
    )


def _unit_of(times: Mapping[int, Sequence[tuple[int, int]]]) -> float | None:
    """Return the unit of the device's time, s, by how fast it goes; None if it is none of the usual ones."""
    for stamps in times.values():
        (first_ns, first), (last_ns, last) = stamps[0], stamps[-1]
        passed_s, counts = (last_ns - first_ns) / NS_PER_S, (last - first) & 0xFFFF_FFFF
        for unit_s in _UNITS_S:
            if counts and abs(passed_s / counts / unit_s - 1) < _LIKENESS:
                return unit_s
    return None
