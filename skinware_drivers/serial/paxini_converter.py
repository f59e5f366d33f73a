"""Paxini's serial converter board, or a single sensor with a serial port: sensors that only answer.

All numbers are little-endian; LRC is minus the sum of all bytes before it.

* Request: ``55 AA | bytes from here to the LRC u16 | sensor | 00 | function | address u32 | count u16 | data | LRC``.
  Functions: FB reads, 79 writes.
* Reply: ``AA 55`` and the same up to the count, then a status u8, data, LRC. Function 7E is an error.
* Addresses, decimal: 1008 the resultant, 3 bytes, then 27 bytes of unknown meaning, then the taxels, from 1038; 6100
  100 characters with the part code; 3 write 1 to take the present forces as zero.

This board puts status 1, an error of the length, into every good reply to a read. So the status of reads is ignored;
the status of writes counts.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

from skinware.errors import BusError, HandshakeTimeout
from skinware_drivers import Byte, Frame, Identifier, Layout, Link, Match, Notice, Patch, Poll
from skinware_drivers.fields import Condition
from skinware_drivers.serial import LRC, Field, Length, Packet, Refused
from skinware_drivers.serial.paxini_modules import (
    MOST_POINTS,
    POINTS_OF_PART,
    SATURATED,
    TAXEL,
    model_of,
    module,
    values,
)

SENSORS: Sequence[int] = range(9)
"""Ids that sensors can have."""
VERSION_BYTES = 100

IDENTIFIER = Field(4, 4, mask=0x07_04_00_FF)
"""The sensor, and the bits of function and address that are 0 in data, but not in any other expected reply: other
replies then belong to no module, and reach the method that waits for them."""

_READ, _WRITE, _ERROR = 0xFB, 0x79, 0x7E
_SENSOR_MASK, _ERROR_MASK = 0xFF, 0x04 << 16
_ZERO, _DATA, _VERSION = 3, 1008, 6100
_BEFORE_TAXELS = 30
_BODY_HEADER = 9  # 00, function, address, count, status
_RESULTANT_STEP = 1
_TIMEOUT_S, _TRIES, _TIMEOUT_OF_ZERO_S = 0.1, 3, 2.0


def read(sensor: int, address: int, count: int) -> bytes:
    sent = b"\x55\xaa" + struct.pack("<HBBBIH", 9, sensor, 0, _READ, address, count)
    return sent + LRC.to_bytes(sent)


def write(sensor: int, address: int, value: int) -> bytes:
    sent = b"\x55\xaa" + struct.pack("<HBBBIHB", 10, sensor, 0, _WRITE, address, 1, value)
    return sent + LRC.to_bytes(sent)


def answer(sensor: int, function: int, address: int) -> Match:
    return Match(_identifier(sensor, function, address), prefix=struct.pack("<BBI", 0, function, address))


def _identifier(sensor: int, function: int, address: int) -> int:
    return (sensor | function << 16 | (address & 0xFF) << 24) & IDENTIFIER.mask


async def ask_version(link: Link, sensor: int, *, tries: int = 1) -> str:
    """Ask a sensor for its version: ``PAXINI PXSR-STDDP03F-v1.0.5``."""
    question = read(sensor, _VERSION, VERSION_BYTES)
    match = answer(sensor, _READ, _VERSION)
    return version_in((await link.request(sensor, question, match, timeout_s=_TIMEOUT_S, tries=tries)).payload)


def version_in(reply: bytes) -> str:
    return "".join(c for c in reply[_BODY_HEADER:].decode("ascii", "replace") if c.isprintable()).strip()


class ReplyHead(NamedTuple):
    """The beginning of a reply; -1 if the reply is too short."""

    function: int
    address: int
    status: int

    @staticmethod
    def of(payload: bytes) -> ReplyHead:
        if len(payload) < _BODY_HEADER:
            return ReplyHead(-1, -1, -1)
        function, address, _, status = struct.unpack_from("<xBIHB", payload)
        return ReplyHead(function, address, status)

    def in_words(self, sensor: int) -> str:
        return f"sensor {sensor} answers with function {self.function:#04x}, status {self.status}, at {self.address}"


class ConverterBoard:
    """The sensors on one line. A sensor that fell silent is asked for its version before it is asked for data again.

    Args:
        sensors: ids of the sensors that must answer; none: all that answer.
        points: taxels of each; 0: by their part codes.
        is_away: returns whether the line is closed.
    """

    framing = Packet(
        sync=(0xAA, 0x55, range(256), range(4), range(16), 0x00),
        length=Length(Field(2, 2), more=5),
        maximum=5 + _BODY_HEADER + 1 + _BEFORE_TAXELS + TAXEL * MOST_POINTS,
        checksum=LRC,
        identifier=IDENTIFIER,
        header=5,
    )

    layout: Layout  # once it was described
    geometry = None

    def __init__(
        self,
        sensors: Sequence[int],
        points: int,
        is_away: Callable[[], bool],
        *,
        period_s: float,
        report: Callable[[Patch, Notice], None],
    ) -> None:
        self.period_s = period_s
        self.report = report
        self._wanted, self._points = sensors, points
        self._is_away = is_away
        self._versions: dict[int, str] = {}
        self._patches: dict[int, Patch] = {}
        self._polls: dict[int, Poll] = {}
        self._silent: set[int] = set()

    @property
    def polls(self) -> Sequence[Poll]:
        """Questions for the data of every sensor, or for the version of a silent one."""
        if self._is_away():  # other sensors may be plugged in meanwhile
            self._silent = set(self._polls)
        return [
            self._poll(sensor, _VERSION, VERSION_BYTES) if sensor in self._silent else poll
            for sensor, poll in self._polls.items()
        ]

    async def is_there(self, link: Link) -> bool:
        for sensor in self._wanted or SENSORS:
            try:
                await ask_version(link, sensor)
            except HandshakeTimeout:
                continue
            return True
        return False

    async def describe(self, link: Link) -> Sequence[Patch]:
        """Ask for the sensors; each is a patch."""
        sensors = self._wanted or SENSORS
        with link.follow(*(answer(sensor, _READ, _VERSION) for sensor in sensors)) as replies:
            for sensor in sensors:
                try:
                    await ask_version(link, sensor, tries=_TRIES if self._wanted else 1)
                except HandshakeTimeout:
                    if self._wanted:
                        raise
            came = [replies.get_nowait() for _ in range(replies.qsize())]  # also those that were late
        found = dict(sorted((reply.identifier & _SENSOR_MASK, version_in(reply.payload)) for reply in came))
        if not found:
            raise HandshakeTimeout(f"{link.bus_name}: no sensor answers, from id {SENSORS[0]} to {SENSORS[-1]}")
        points = {}
        for sensor, version in found.items():
            by_code = (count for code, count in POINTS_OF_PART.items() if code in version)
            points[sensor] = self._points or next(by_code, 0)
            if not points[sensor]:
                raise BusError(
                    f"sensor {sensor} says that it is {version!r}: not a part code whose number of taxels is known; say"
                    " it with the option points"
                )
        for sensor, version in found.items():
            link.log.info("sensor %d is %s, %s", sensor, model_of(points[sensor]), version)
        self._versions, self._silent = found, set()
        return self.know(points)

    def know(self, points: Mapping[int, int]) -> Sequence[Patch]:
        expected = answer(0, _READ, _DATA).prefix  # the same of all sensors
        data = [Byte(1 + at, byte) for at, byte in enumerate(expected[1:])]
        taxels_at = _BODY_HEADER + _BEFORE_TAXELS
        frames = []
        for sensor, count in points.items():
            when: list[Condition] = [Identifier(sensor), *data]
            where = values(count, taxels_at, _BODY_HEADER, _RESULTANT_STEP)
            length = [taxels_at + TAXEL * count]
            frames.append(Frame(f"sensor {sensor}", when, length, where, patch=sensor, flags=SATURATED))
        self.layout = Layout(frames)
        sizes = {sensor: _BEFORE_TAXELS + TAXEL * count for sensor, count in points.items()}
        self._polls = {sensor: self._poll(sensor, _DATA, size) for sensor, size in sizes.items()}
        self._patches = {
            sensor: Patch(f"sensor {sensor}", [module(sensor, count)], sensor) for sensor, count in points.items()
        }
        return list(self._patches.values())

    async def probe(self, link: Link, patch: Patch) -> bool:  # noqa: ARG002
        """Poll the version of a silent sensor from now on: waiting for it here would hold up the others."""
        self._silent.add(patch.key)
        return False

    async def attend(self, link: Link) -> None:
        """Follow the versions of silent sensors, and the errors that sensors answer."""
        error, of_function = "", IDENTIFIER.mask & ~_SENSOR_MASK
        who = answer(0, _READ, _VERSION)._replace(mask=of_function)
        with link.follow(who, Match(0, 0, bytes((0, _ERROR)))) as heard:
            while True:
                reply = await heard.get()
                sensor = reply.identifier & _SENSOR_MASK
                if reply.payload[1] != _ERROR:
                    version, patch = version_in(reply.payload), self._patches.get(sensor)
                    if patch is None or sensor not in self._silent:
                        continue
                    if version == self._versions[sensor]:
                        self._silent.discard(sensor)
                    else:
                        link.log.warning("sensor %d is another one now: %s", sensor, version)
                        del self._patches[sensor]  # logged once
                        self.report(patch, Notice.CHANGED)
                elif (text := ReplyHead.of(reply.payload).in_words(sensor)) != error:
                    error = text
                    link.log.warning("%s", text)

    async def tare(self, link: Link, patches: Sequence[Patch]) -> None:
        """Make sensors take the present forces as zero, one after the other."""
        for patch in patches:
            sensor = patch.key
            done_or_refused = Match(_identifier(sensor, _WRITE, _ZERO), IDENTIFIER.mask & ~_ERROR_MASK)
            reply = await link.request(sensor, write(sensor, _ZERO, 1), done_or_refused, timeout_s=_TIMEOUT_OF_ZERO_S)
            head = ReplyHead.of(reply.payload)
            if (head.function, head.address, head.status) != (_WRITE, _ZERO, 0):
                raise Refused(head.in_words(sensor), head.status)

    def _poll(self, sensor: int, address: int, size: int) -> Poll:
        return Poll(sensor, read(sensor, address, size), self.period_s, answer(sensor, _READ, address))
