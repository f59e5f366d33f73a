"""A patch on CAN FD that nobody makes: frames of 64 bytes, 29-bit identifiers, sequence numbers; driver and emulator.

Identifier ``18A50000 | node << 8 | half``. Payload: sequence number (uint16 LE), two bytes of nothing, thirty taxels
(uint16 LE). Two halves a burst. Commands: identifier ``18A40000 | node << 8``, twelve bytes, first 1: send, 0: stop.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from skinware.sensor_types import PRESSURE
from skinware_drivers.bus import EXTENDED_FLAG
from skinware_drivers.can import CanAdapter
from skinware_drivers.description import Module, Patch, taxels
from skinware_drivers.fields import Bits, Identifier, SequenceNumber
from skinware_drivers.layout import Cycle, Frame, Layout, Values
from skinware_drivers.link import Link
from skinware_drivers.options import NoOptions
from skinware_drivers.virtual import CanFrame, Device, Emulator, EmulatorOptions, on_a_grid

NODES = (3, 0xC8)
PERIOD_S = 0.02


def half(number: int) -> Frame:
    return Frame(
        f"half {number}",
        when=(Identifier(EXTENDED_FLAG | 0x18A5_0000 | number, mask=0x1FFF_00FF),),
        length=(64,),
        values=Values(4, "<u2", 30, to=range(30 * number, 30 * number + 30)),
        patch=Bits(shift=8, width=8),
    )


class FdPatchDriver(CanAdapter[NoOptions]):
    types = (PRESSURE.measured(unit="counts", maximum=0xFFFF),)
    dtype = np.uint16
    patches = tuple(Patch(f"node {n}", [Module(taxels(60, first_uid=n << 8))], key=n) for n in NODES)
    layout = Layout(
        (half(0), half(1)),
        Cycle(("half 0", "half 1"), maximum_age_s=PERIOD_S / 2, counter=SequenceNumber(0, "<u2")),
    )

    async def start(self, link: Link) -> None:
        await self._tell(link, NODES, 1)

    async def stop(self, link: Link) -> None:
        await self._tell(link, NODES, 0)

    async def probe(self, link: Link, patch: Patch) -> bool:
        await self._tell(link, (patch.key,), 1)
        return False

    async def _tell(self, link: Link, nodes: Sequence[int], what: int) -> None:
        for node in nodes:
            await link.send(EXTENDED_FLAG | 0x18A4_0000 | node << 8, bytes((what, *range(2, 13))))


class EmulatedFdOptions(EmulatorOptions, frozen=True):
    """None of its own."""


class EmulatedFdPatch(Emulator[EmulatedFdOptions]):
    full_scale = 0xFFFF
    rest = 100
    swing = 20_000
    period_s = PERIOD_S
    numbers = NODES
    identifiers = frozenset(0x98A5_0000 + (node << 8) + part for node in NODES for part in (0, 1))

    def places(self) -> npt.NDArray[np.float64]:
        return on_a_grid(60, 10)

    def obey(self, device: Device, identifier: int, payload: bytes, now_ns: int) -> bool:
        if identifier != 0x98A4_0000 + (device.number << 8) or len(payload) != 12:
            return False
        if payload[0]:
            self.start(device, now_ns)
        else:
            self.stop(device)
        return True

    def frames(self, device: Device, values: Sequence[int]) -> Sequence[CanFrame]:
        return [
            (
                0x98A5_0000 + (device.number << 8) + part,
                struct.pack("<HH30H", device.cycle & 0xFFFF, 0, *values[30 * part : 30 * part + 30]),
            )
            for part in (0, 1)
        ]
