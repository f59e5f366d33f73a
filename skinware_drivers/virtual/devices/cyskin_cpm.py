"""An emulated CPM finger with CySkin technology, which sends from power-up on, and hears nothing.

Source: can2wifi2ros ``arduino_can2wifi/arduino_can2wifi.ino``.
"""

from __future__ import annotations

import struct
from collections.abc import Collection, Sequence
from typing import Annotated

from msgspec import Meta

from skinware_drivers.virtual import CanFrame, Device, Emulator, EmulatorOptions, Places, on_a_grid

_SENT_AS = [13, 15, 12, 14, 10, 11, 8, 9, 6, 4, 7, 0, 3, 5, 2, 1]
"""Position of taxel 0, 1, 2 ... in the sixteen values of a set."""


class EmulatedCyskinCpmOptions(EmulatorOptions, frozen=True):
    period_ms: Annotated[int, Meta(ge=1, description="time between two sets, ms")] = 20


class EmulatedCyskinCpm(Emulator[EmulatedCyskinCpmOptions]):
    full_scale = 0xFFFF
    rest = 800
    swing = 6_000
    identifiers: Collection[int] = frozenset((0x405, 0x407, 0x409, 0x40B))
    streams = "always"

    def places(self) -> Places:
        return on_a_grid(16, 4)

    def frames(self, device: Device, values: Sequence[int]) -> Sequence[CanFrame]:  # noqa: ARG002
        wire = [0] * 16
        for taxel, at in enumerate(_SENT_AS):
            wire[at] = values[taxel]
        return [(0x405 + 2 * i, struct.pack("<4H", *wire[4 * i : 4 * i + 4])) for i in range(4)]
