"""Packets of Contactile's PapillArray Controller: their structure, and the frames that they become.

Wire format: the maker's PTSCOM_2.0_SPEC_SEP22 (text in langxin11/contactile_pts_lab, 2797753 of 2026-05-16), whose
figures are no text; what they show is from the readers in that repository (``python_ws/pts_protocol.py``, 5bb5ea0) and
in langxin11/parallel_gripper_tactile (``papillarray_hardware``, fa5f792), which read hardware and agree with the
maker's library. All is little-endian. A packet is ``55 66 77 88``, data, their sum u16, ``AA BB CC DD``, and the first
end behind a beginning counts.

Data: the size of a position u8; type u16 and position of each block, up to the first block, or zeros before it; blocks:

* 1: number of the packet u32, time in us u64.
* 3: sensors u16, a position for each; for each sensor pillars u16, a position for each, and for each pillar 2 u16,
  force in N and displacement in mm, three f32 each.
* 4: sensors u16, a position for each, and for each sensor 2 u16, force in N and torque in N mm, three f32 each.
* 5: as 3, for each pillar 1 u16, slip state i8, friction f32.
* 6: as 4, for each sensor 1 u16, detection u8, friction and target grip force in N f32.

All positions count from the beginning of the data, also within blocks: the maker's library misreads others. Blocks of
other types are skipped. Each block becomes a frame for each sensor: the packet's number, low half of the time, i8, f32.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from skinware.sensor_types import FORCE, SensorType
from skinware_drivers.serial.checksums import Sum
from skinware_drivers.serial.framing import Framed, Framer, ReceivedFraming, begun

_BEGIN, _END = b"\x55\x66\x77\x88", b"\xaa\xbb\xcc\xdd"
_MOST_BYTES, _MOST_SENSORS, MOST_PILLARS, _LARGEST_POSITION = 4096, 20, 100, 8
_SUM = Sum(width=16)
_CONTROLLER, NEWS = 1, 0x400
STAMP_SIZE = 8
"""Bytes of the packet's number and time before the values of a frame."""
_VENDOR = 0xC0C7 << 12


def _own(number: int, names: Sequence[str], unit: str, scale: float = 1.0) -> list[SensorType]:
    return [SensorType(name, _VENDOR | number + n, unit, scale=scale) for n, name in enumerate(names)]


def _axes(name: str) -> list[str]:
    return [f"{name}_{axis}" for axis in "xyz"]


class PacketBlock(NamedTuple):
    """A kind of block.

    Attributes:
        entry: number in front of the values of a pillar or sensor.
        of_pillars: it has values for each pillar, not only for each sensor.
        types: of the values of a pillar or sensor.
        states: of them, from the first on, are i8; the others are f32.
    """

    name: str
    entry: int
    of_pillars: bool
    types: Sequence[SensorType]
    states: int = 0

    @property
    def size(self) -> int:
        """Bytes of the values of one pillar or sensor."""
        return 4 * len(self.types) - 3 * self.states


_FRICTION = _own(10, ["friction"], "1")
BLOCKS: Mapping[int, PacketBlock] = {
    3: PacketBlock("pillars", 2, True, [*FORCE, *_own(1, _axes("displacement"), "m", 1e-3)]),
    4: PacketBlock("total", 2, False, [*_own(4, _axes("total_force"), "N"), *_own(7, _axes("torque"), "N m", 1e-3)]),
    5: PacketBlock("slip of pillars", 1, True, [*_own(11, ["slip_state"], "1"), *_FRICTION], states=1),
    6: PacketBlock(
        "slip", 1, False, [*_own(12, ["slip_detection"], "1"), *_FRICTION, *_own(13, ["grip_force"], "N")], states=1
    ),
}


@dataclass(frozen=True)
class PapillArrayPackets(ReceivedFraming):
    """The framing, for receiving: a frame for each block and sensor, with the identifier sensor << 4 | block.

    Before them, packets of another structure have a frame with identifier and length of each.
    """

    maximum_body: int = field(default=STAMP_SIZE + MOST_PILLARS * 24, init=False)

    def framer(self) -> Framer:
        return _PapillArrayFramer()


class _Cut(NamedTuple):
    """A frame among the bytes of all."""

    identifier: int
    begin: int
    stop: int


class _Shape(NamedTuple):
    """The structure of packets.

    Attributes:
        size: bytes of their data.
        at, content: places and content of the bytes that are no values: equal in all packets of this structure.
        take: places of the bytes of all frames.
        frames: their parts of these bytes.
    """

    size: int
    at: npt.NDArray[np.int64]
    content: bytes
    take: npt.NDArray[np.int64]
    frames: Sequence[_Cut]

    def fits(self, data: npt.NDArray[np.uint8]) -> bool:
        return len(data) == self.size and data[self.at].tobytes() == self.content


class _PapillArrayFramer(Framer):
    def __init__(self) -> None:
        super().__init__()
        self._shape: _Shape | None = None

    def _find(self, stream: bytes) -> tuple[list[Framed], int]:
        found: list[Framed] = []
        counters, done = self.counters, 0
        while (at := stream.find(_BEGIN, done)) >= 0:
            counters.skipped_bytes += at - done
            done = at
            end = stream.find(_END, at + len(_BEGIN), at + _MOST_BYTES)
            if end < 0 and len(stream) < at + _MOST_BYTES:
                return found, at
            frames = None if end < 0 else self._frames(stream[at + len(_BEGIN) : end], self._before + end + len(_END))
            if frames is None:
                counters.refused += end < 0
                counters.skipped_bytes += 1
                done = at + 1
            else:
                found += frames
                done = end + len(_END)
                counters.frame_bytes += done - at
        rest = max(done, len(stream) - begun(stream, _BEGIN))
        counters.skipped_bytes += rest - done
        return found, rest

    def _frames(self, data: bytes, end: int) -> list[Framed] | None:
        """Return the frames of a packet; None if it is none, which is counted."""
        packet, total = data[: -_SUM.size], data[-_SUM.size :]
        if _SUM.to_bytes(packet) != total:
            self.counters.checksum_errors += 1
            return None
        parts, news = np.frombuffer(packet, np.uint8), list[Framed]()
        if self._shape is None or not self._shape.fits(parts):
            self._shape = _shape_of(packet)
            if self._shape is None:
                self.counters.refused += 1
                return None
            sizes = [(frame.identifier, frame.stop - frame.begin) for frame in self._shape.frames]
            news = [Framed(NEWS, np.array(sizes, "<u2").tobytes(), end)]
        taken = parts[self._shape.take].tobytes()
        return news + [Framed(cut.identifier, taken[cut.begin : cut.stop], end) for cut in self._shape.frames]


class _ShapeReading:
    """The structure of a packet, read from its beginning."""

    def __init__(self, packet: bytes) -> None:
        self.packet = packet
        self.at = 0
        self.fixed: list[int] = []

    def number(self, size: int) -> int:
        """Return the next number, which is a part of the structure."""
        at = self.at
        self.skip(size)
        self.fixed += range(at, self.at)
        return int.from_bytes(self.packet[at : self.at], "little")

    def skip(self, size: int) -> None:
        self.at += size
        if self.at > len(self.packet):
            raise ValueError

    def go(self, at: int) -> None:
        """Go on at a position; parts lie behind each other, so that a packet cannot repeat itself."""
        if at < self.at:
            raise ValueError
        self.at = at

    def positions(self, width: int, most: int) -> list[int]:
        """Return the positions of parts, behind their number."""
        count = self.number(2)
        if count > most:
            raise ValueError
        return [self.number(width) for _ in range(count)]

    def entries(self, block: PacketBlock, width: int) -> Iterator[list[int]]:
        """Return the places of the values of each sensor: the states of all its pillars first."""
        for sensor in self.positions(width, _MOST_SENSORS):
            self.go(sensor)
            begins = []
            for entry in self.positions(width, MOST_PILLARS) if block.of_pillars else [sensor]:
                self.go(entry)
                if self.number(2) != block.entry:
                    raise ValueError
                begins.append(self.at)
                self.skip(block.size)
            states = [at + n for at in begins for n in range(block.states)]
            yield states + [at + n for at in begins for n in range(block.states, block.size)]


def _shape_of(packet: bytes) -> _Shape | None:
    """Return the structure of a packet; None if it is none."""
    reading = _ShapeReading(packet)
    take, frames = list[int](), list[_Cut]()
    try:
        width, blocks = _positions(reading)
        stamp = list(range(blocks[_CONTROLLER], blocks[_CONTROLLER] + STAMP_SIZE))
        for kind in sorted(BLOCKS.keys() & blocks.keys()):
            reading.at = blocks[kind]
            block = BLOCKS[kind]
            for sensor, places in enumerate(reading.entries(block, width)):
                if places:
                    frames.append(_Cut(sensor << 4 | kind, len(take), len(take) + STAMP_SIZE + len(places)))
                    take += stamp + places
    except (KeyError, ValueError):
        return None
    at = np.array(sorted(reading.fixed), np.int64)
    return _Shape(len(packet), at, np.frombuffer(packet, np.uint8)[at].tobytes(), np.array(take, np.int64), frames)


def _positions(reading: _ShapeReading) -> tuple[int, dict[int, int]]:
    """Return the size of a position, and the position of each block."""
    width, blocks, first = reading.number(1), dict[int, int](), len(reading.packet)
    while 1 <= width <= _LARGEST_POSITION and reading.at + 2 + width <= first and (kind := reading.number(2)):
        blocks[kind] = position = reading.number(width)
        first = min(first, position)
        if not reading.at <= position <= len(reading.packet) - (STAMP_SIZE if kind == _CONTROLLER else 0):
            raise ValueError
    return width, blocks


def sizes_of(news: bytes) -> Mapping[int, int]:
    """Return identifier -> length of the frames of a packet."""
    return dict(np.frombuffer(news, "<u2").reshape(-1, 2).tolist())
