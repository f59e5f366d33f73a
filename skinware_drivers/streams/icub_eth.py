"""Read ROBOSKIN boards behind iCub's Ethernet boards (EMS, MC4PLUS, MC2PLUS): CAN frames in UDP datagrams."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator, Sequence
from typing import Annotated, Literal

import msgspec
import numpy as np
import numpy.typing as npt
from msgspec import Meta

from skinware.errors import BusError
from skinware.sensor_types import SensorType
from skinware_drivers.can.roboskin import RoboskinDriver
from skinware_drivers.can.roboskin_layout import SKIN_TYPES, Kind, RoboskinOptions
from skinware_drivers.description import Patch
from skinware_drivers.layout import Layout
from skinware_drivers.link import Link
from skinware_drivers.options import Options
from skinware_drivers.serial.adapter import SerialAdapter
from skinware_drivers.serial.framing import Field, Framer, Framing, Splitting
from skinware_drivers.serial.framings import Split
from skinware_drivers.serial.packets import Length, Packet

_HEADER, _NUMBER, _OVERHEAD, _LONGEST_DATAGRAM = 16, 8, 28, 1500
_OVERTAKEN = 64
_HEAD = struct.Struct("<BBHI")
_SAY, _SIGNAL = 2, 4
_TIME, _SIGNATURE, _VERSION = 0x04, 0x08, 0xC0
_SKIN = 0x0300_0002
_ITEM, _LONGEST_CAN = 10, 8


class _Rops(Split):
    def framer(self) -> Framer:
        framer = super().framer()
        framer.splitting = _in_order(self.splitting)
        return framer


def rops(port: int) -> Split:
    """Return the framing that finds the CAN frames of the skin on a CAN port, 1 or 2.

    A frame that one of the next 64 of its stream has overtaken becomes one that is too long for CAN, and that the bus
    refuses.
    """
    wanted = _SKIN | (port - 1) << 8
    return _Rops(_FRAMES, lambda _, body: _can_frames(body[_NUMBER:], wanted))


def _in_order(splitting: Splitting) -> Splitting:
    newest = 0

    def split(identifier: int, body: bytes) -> Iterable[tuple[int, bytes]]:
        nonlocal newest
        number = int.from_bytes(body[:_NUMBER], "little")
        if 0 < newest - number <= _OVERTAKEN:
            return [(0, bytes(_LONGEST_DATAGRAM))]
        newest = number
        return splitting(identifier, body)

    return split


def _can_frames(operations: bytes, wanted: int) -> Iterator[tuple[int, bytes]]:
    """Yield (identifier, payload) of the CAN frames in the operations of a frame that carry a variable."""
    place = 0
    while len(operations) - place >= _HEAD.size:
        control, code, size, variable = _HEAD.unpack_from(operations, place)
        begin = place + _HEAD.size
        place = begin + -(-size // 4) * 4 + (4 if control & _SIGNATURE else 0) + (8 if control & _TIME else 0)
        if control & _VERSION or place > len(operations):
            return  # the beginning of the next one is not known
        if code in (_SAY, _SIGNAL) and variable == wanted:
            yield from _items(operations[begin : begin + size])


def _items(array: bytes) -> Iterator[tuple[int, bytes]]:
    if len(array) < 4 or array[1] != _ITEM or array[2] > array[0]:
        return
    for at in range(4, min(len(array) - _ITEM, 4 + _ITEM * (array[2] - 1)) + 1, _ITEM):
        info = array[at] | array[at + 1] << 8
        length = info >> 12
        if length <= _LONGEST_CAN:
            yield info & 0x7FF, array[at + 2 : at + 2 + length]


_FRAMES = Packet(
    sync=(0x78, 0x56, 0x34, 0x12),
    length=Length(Field(4, 2), more=_OVERHEAD),
    maximum=_LONGEST_DATAGRAM,
    trailer=(0x21, 0x43, 0x65, 0x87),
    header=_HEADER,
)


class IcubEthOptions(Options, frozen=True):
    """Options of the driver: the CAN port, and those of ``roboskin`` that matter while only listening."""

    port: Annotated[Literal[1, 2], Meta(description="CAN port of the Ethernet board that the skin is on")] = 1
    period_ms: Annotated[int, Meta(ge=1, le=255, description="time between two updates, as the boards are set up")] = 50
    skin_type: Annotated[int, Meta(ge=0, le=15, description="skin type that the boards are set up with")] = 0
    kind: Annotated[str, Meta(description="kind of all modules: triangle, fingertip or palm; empty: by skin_type")] = ""
    modules: Annotated[tuple[Kind, ...], Meta(description="modules of other kinds")] = ()
    old_style: Annotated[bool, Meta(description="set up in the old way: skin data in message class 3")] = False
    learn_s: Annotated[float, Meta(gt=0, le=60, description="how long to learn which modules send, s")] = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        self.of_roboskin()

    def of_roboskin(self) -> RoboskinOptions:
        """Return them as options of the driver of the boards on CAN."""
        given = msgspec.structs.asdict(self)
        del given["port"]
        return RoboskinOptions(**given)


class IcubEthDriver(SerialAdapter[IcubEthOptions]):
    """The skin boards on one CAN port of an Ethernet board; patches, modules and uids are those of ``roboskin``."""

    framing: Framing = rops(1)
    types: Sequence[SensorType] = SKIN_TYPES
    dtype: npt.DTypeLike = np.uint8
    layout: Layout
    watch = RoboskinDriver.watch
    payload_size = 8

    def __init__(self, options: IcubEthOptions) -> None:
        super().__init__(options)
        self.framing = rops(options.port)
        self._boards = RoboskinDriver(options.of_roboskin())
        self.layout, self.period_s = self._boards.layout, self._boards.period_s

    async def describe(self, link: Link) -> Sequence[Patch]:
        """Learn the boards and modules from the data."""
        patches = self._boards.patches_heard(await link.listen(self.options.learn_s), ())
        if not patches:
            raise BusError(f"{link.bus_name}: no skin data: has the robot's program started the skin of this board?")
        return patches

    async def join(self, link: Link, known: Sequence[Patch]) -> Sequence[Patch]:
        return self._boards.patches_heard(await link.listen(self.options.learn_s), known)

    async def revive(self, link: Link, patch: Patch) -> None:
        """Wait: only the robot's program sets a board up."""
