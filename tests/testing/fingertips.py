"""Two fingertips on CAN, with a right driver; and many drivers of them that are wrong, each in one way."""

from __future__ import annotations

import asyncio
import os
import struct
import threading
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from skinware.sensor_types import PRESSURE
from skinware_drivers.can import CanAdapter
from skinware_drivers.description import Module, Patch, taxels
from skinware_drivers.fields import Bits, Byte, Identifier, Match, SequenceNumber
from skinware_drivers.hand import Grid, Place
from skinware_drivers.layout import Cycle, Expand, Frame, Layout, Values
from skinware_drivers.link import Link
from skinware_drivers.options import NoOptions
from skinware_drivers.virtual import CanFrame, Device, Emulator, EmulatorOptions, on_a_grid

NODES = (1, 2)
NODE = Bits(shift=0, width=4)


def layout(
    dtype: str = ">u2", offset: int = 1, to: Sequence[Sequence[int]] = ((0, 1, 2), (3, 4, 5)), mask: int = 0x7F0
) -> Layout:
    """Two frames of three taxels make one burst of a fingertip; the first byte says which half it is."""
    return Layout(
        [
            Frame(name, [Identifier(0x100, mask), Byte(0, half)], [7], Values(offset, dtype, 3, to[half]), patch=NODE)
            for half, name in enumerate(("proximal", "distal"))
        ],
        Cycle(["proximal", "distal"], maximum_age_s=0.01),
    )


class Fingertips(CanAdapter[NoOptions]):
    """The right driver."""

    types = (PRESSURE.measured(unit="counts"),)
    dtype = np.int32
    layout = layout()
    patches = tuple(Patch(f"finger {node}", [Module(taxels(6, first_uid=node << 8))], key=node) for node in NODES)

    async def describe(self, link: Link) -> Sequence[Patch]:
        if not link.listen_only:
            await self._who(link, NODES[0])
        return self.patches

    async def start(self, link: Link) -> None:
        for node in NODES:
            await link.send(0x80 | node, b"\1")

    async def stop(self, link: Link) -> None:
        for node in NODES:
            await link.send(0x80 | node, b"\0")

    async def probe(self, link: Link, patch: Patch) -> bool:
        await self._who(link, patch.key)
        return True

    async def revive(self, link: Link, patch: Patch) -> None:
        await link.send(0x80 | patch.key, b"\1")

    async def _who(self, link: Link, node: int) -> None:
        await link.request(0x80 | node, b"\2", Match(0x180 | node), timeout_s=0.1)


class EmulatedFingertips(Emulator[EmulatorOptions]):
    """Silent until started."""

    full_scale = 0xFFFF
    swing = 1000
    numbers = NODES
    period_s = 0.02
    identifiers = frozenset(base | node for base in (0x80, 0x100, 0x180) for node in NODES)

    def places(self) -> npt.NDArray[np.float64]:
        return on_a_grid(6, 3)

    def obey(self, device: Device, identifier: int, payload: bytes, now_ns: int) -> bool:
        if identifier != 0x80 | device.number:
            return False
        if payload == b"\1":
            self.start(device, now_ns)
        elif payload == b"\0":
            self.stop(device)
        else:
            self.reply(device, (0x180 | device.number, b"fingertip"[:8]), now_ns)
        return True

    def frames(self, device: Device, values: Sequence[int]) -> Sequence[CanFrame]:
        return [(0x100 | device.number, struct.pack(">B3H", half, *values[3 * half : 3 * half + 3])) for half in (0, 1)]


class EmulatedSigned(EmulatedFingertips):
    """The same with values below 0."""

    full_scale = 0x7FFF
    lowest = -0x8000

    def frames(self, device: Device, values: Sequence[int]) -> Sequence[CanFrame]:
        return [(0x100 | device.number, struct.pack(">B3h", half, *values[3 * half : 3 * half + 3])) for half in (0, 1)]


class EmulatedCounting(EmulatedFingertips):
    """The same with the number of the cycle in the upper half of the first byte."""

    is_counting: ClassVar[bool] = True

    def frames(self, device: Device, values: Sequence[int]) -> Sequence[CanFrame]:
        number = device.cycle % 16 << 4 if self.is_counting else 0x50
        parts = super().frames(device, values)
        return [(identifier, bytes([payload[0] | number]) + payload[1:]) for identifier, payload in parts]


class EmulatedStill(EmulatedCounting):
    """It does not count."""

    is_counting = False


class Counting(Fingertips):
    """The right driver for it."""

    counter: ClassVar[SequenceNumber] = SequenceNumber(0, "u1", mask=0xF0)

    @property
    def layout(self) -> Layout:  # type: ignore[override]
        """The lower half of the first byte distinguishes the halves."""
        frames = [replace(f, when=[f.when[0], Byte(0, n, 0xF)]) for n, f in enumerate(layout().frames)]
        return Layout(frames, Cycle(["proximal", "distal"], maximum_age_s=0.01, counter=self.counter))


# Errors in the layout


class CountsPressures(Counting):
    counter = SequenceNumber(2, "u1")


class WrongLength(Fingertips):
    layout = Layout([replace(f, length=[8, 64]) for f in layout().frames], layout().cycle)


class SwappedBytes(Fingertips):
    layout = layout("<u2")


class Signed(Fingertips):
    layout = layout(">i2")


class OneByteEarly(Fingertips):
    layout = layout(offset=0)


class NextTaxel(Fingertips):
    layout = layout(to=((1, 2, 3), (4, 5, 0)))


class WrongPermutation(Fingertips):
    layout = layout(to=((2, 1, 0), (3, 4, 5)))


class TwoOnOne(Fingertips):
    layout = layout(to=((0, 1, 1), (3, 4, 5)))


class ForgottenFrame(Fingertips):
    layout = Layout([Fingertips.layout.frames[0]])


class HalvesApart(Fingertips):
    layout = Layout(Fingertips.layout.frames)


def _nothing(payload: npt.NDArray[np.uint8], length: npt.NDArray[Any]) -> Any:
    none = np.zeros(0, np.int64)
    return none, none, none


class TakesForeignFrames(Fingertips):
    layout = Layout(
        [Frame("any", [Identifier(0, 0)], range(9), Expand(_nothing), patch=1), *layout().frames],
        layout().cycle,
    )


def expanded(lengths: Sequence[int], spread: Any) -> Layout:
    return Layout([Frame("half", [Identifier(0x100, 0x7F0)], lengths, Expand(spread), patch=NODE)])


def _fill_in(payload: npt.NDArray[np.uint8], length: npt.NDArray[Any]) -> Any:
    """All six taxels of every frame, with 0 for those of the other half."""
    values = np.zeros((len(payload), 6), np.int64)
    words = np.ascontiguousarray(payload[:, 1:7]).view(">u2")
    for at, half in enumerate(payload[:, 0].tolist()):
        values[at, 3 * (half & 1) : 3 * (half & 1) + 3] = words[at]
    row, channel = np.divmod(np.arange(values.size), 6)
    return row, channel, values.reshape(-1)


def _own_half(payload: npt.NDArray[np.uint8], length: npt.NDArray[Any]) -> Any:
    words = np.ascontiguousarray(payload[:, 1:7]).view(">u2").astype(np.int64)
    row = np.repeat(np.arange(len(payload)), 3)
    channel = (payload[:, :1].astype(np.int64) & 1) * 3 + np.arange(3)
    return row, channel.reshape(-1), words.reshape(-1)


def _picky(payload: npt.NDArray[np.uint8], length: npt.NDArray[Any]) -> Any:
    if (payload[:, 0] > 1).any():
        raise ValueError("there is no such half")
    return _own_half(payload, length)


class FilledIn(Fingertips):
    layout = expanded([7], _fill_in)


class RaisesOnGarbage(Fingertips):
    layout = expanded([7], _picky)


class AnyLength(Fingertips):
    layout = Layout(
        [
            Frame(name, [Identifier(0x100, 0x7F0), Byte(0, half)], range(1, 9), Expand(_own_half), patch=NODE)
            for half, name in enumerate(("proximal", "distal"))
        ],
        Cycle(["proximal", "distal"], maximum_age_s=0.01),
    )


# Errors in the description


class MissingModule(Fingertips):
    patches = Fingertips.patches[:1]


class SameUids(Fingertips):
    patches = tuple(Patch(f"finger {node}", [Module(taxels(6))], key=node) for node in NODES)


class NoMatrix(Fingertips):
    """Its places are three rows of two."""

    patches = tuple(
        Patch(f"finger {node}", [Module(taxels(6, first_uid=node << 8), kind="2x3")], key=node) for node in NODES
    )
    geometry = Grid(3, 2).at(Place("pad"), ["pressure"], [NODES[0] << 8 | taxel for taxel in range(6)])


class ChangesItsMind(Fingertips):
    def __init__(self, options: NoOptions) -> None:
        super().__init__(options)
        self._asked = 0

    async def describe(self, link: Link) -> Sequence[Patch]:
        self._asked += 1
        return [Patch(p.name, [Module(taxels(6, first_uid=p.key << 8 | self._asked))], p.key) for p in self.patches]


class WrongPeriod(Fingertips):
    period_s = 0.04


# Wrong in their manners


class Sleeps(Fingertips):
    async def start(self, link: Link) -> None:
        time.sleep(0.01)  # noqa: ASYNC251 - that is the defect
        await super().start(link)


class Hangs(Fingertips):
    go_on = threading.Event()

    async def start(self, link: Link) -> None:
        self.go_on.wait(30)
        await super().start(link)


class Computes(Fingertips):
    enough = threading.Event()

    async def start(self, link: Link) -> None:
        while not self.enough.is_set():
            pass


class WaitsForEver(Fingertips):
    async def describe(self, link: Link) -> Sequence[Patch]:
        with link.follow(Match(0x181)) as replies:
            await link.send(0x81, b"\2")
            await replies.get()
        return self.patches


class LeaksDescriptors(Fingertips):
    leaked: ClassVar[list[int]] = []

    async def start(self, link: Link) -> None:
        self.leaked.append(os.open("/", os.O_RDONLY))
        await super().start(link)


class LeaksThreads(Fingertips):
    end = threading.Event()

    async def start(self, link: Link) -> None:
        threading.Thread(target=self.end.wait, name="forgotten").start()
        await super().start(link)


class LeaksTasks(Fingertips):
    async def start(self, link: Link) -> None:
        self.task = asyncio.create_task(link.sleep(1e9))
        await super().start(link)


class LeaksMemory(Fingertips):
    def __init__(self, options: NoOptions) -> None:
        super().__init__(options)
        seen: list[bytes] = []

        def spread(payload: npt.NDArray[np.uint8], length: npt.NDArray[Any]) -> Any:
            seen.extend(row.tobytes() for row in payload)
            return _own_half(payload, length)

        self.layout = expanded([7], spread)


class TalksWhenItShouldListen(Fingertips):
    async def describe(self, link: Link) -> Sequence[Patch]:
        await self._who(link, 1)
        return self.patches


class NeverStops(Fingertips):
    async def stop(self, link: Link) -> None:
        pass


class IgnoresRestarts(Fingertips):
    async def probe(self, link: Link, patch: Patch) -> bool:
        return False


class RaisesOnStop(Fingertips):
    async def start(self, link: Link) -> None:
        self.started = True
        await super().start(link)

    async def stop(self, link: Link) -> None:
        del self.started
        await super().stop(link)
