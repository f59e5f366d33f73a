"""Emulated XELA uSkin boards: silent until started, then a frame of three axes for every taxel.

Source: ur-o2as ``o2as_xela_sensor.py``, uskin_can_drivers ``src/can_communication.cpp``.
"""

from __future__ import annotations

import struct
from collections.abc import Collection, Sequence
from typing import Annotated, Any, Literal

import numpy as np
import numpy.typing as npt
from msgspec import Meta

from skinware_drivers.virtual.emulator import CanFrame, Device, Emulator
from skinware_drivers.virtual.emulator_options import EmulatorOptions
from skinware_drivers.virtual.press import on_a_grid


class EmulatedXelaOptions(EmulatorOptions, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Which boards there are."""

    boards: Annotated[tuple[int, ...], Meta(description="numbers of the boards")] = (1,)
    model: Annotated[
        Literal["4x4", "4x6"],
        Meta(description="4x4: identifiers from 0x710 on; 4x6: hexadecimal 1, row, column"),
    ] = "4x4"
    period_ms: Annotated[int, Meta(ge=1, description="time between two messages of a taxel, ms")] = 10


class EmulatedXela(Emulator[EmulatedXelaOptions]):
    """Boards on one bus; see :class:`skinware_drivers.virtual.emulator.Emulator`.

    Values: x, y, z of taxel 0, of taxel 1 ... Several boards have identifiers 0x20 apart (4x4) or 0x100 apart (4x6).
    """

    full_scale = 0xFFFF
    rest = 33_000
    swing = 9_000

    def __init__(self, options: EmulatedXelaOptions, **more: Any) -> None:
        self.numbers: Sequence[int] = options.boards
        super().__init__(options, **more)
        taxels = {taxel for board in options.boards for taxel in self._taxels(board)}
        self.identifiers: Collection[int] = taxels.union(range(0x200, 0x210))  # commands

    def places(self) -> npt.NDArray[np.float64]:
        return on_a_grid(16, 4, each=3) if self.options.model == "4x4" else on_a_grid(24, 6, each=3)

    def obey(self, device: Device, identifier: int, payload: bytes, now_ns: int) -> bool:
        if identifier != 0x200 + device.number or payload not in (b"\x07\x00", b"\x07\x01"):
            return False
        if payload[1]:
            self.stop(device)
        else:
            self.start(device, now_ns)
        return True

    def kinds(self) -> Sequence[str]:
        return [self.kind_of(taxel, b"") for board in self.numbers for taxel in self._taxels(board)]

    def frames(self, device: Device, values: Sequence[int]) -> Sequence[CanFrame]:
        xyz = zip(values[0::3], values[1::3], values[2::3], strict=True)
        return [(i, struct.pack(">x3Hx", *axes)) for i, axes in zip(self._taxels(device.number), xyz, strict=True)]

    def _taxels(self, board: int) -> list[int]:
        nth = self.numbers.index(board)
        if self.options.model == "4x4":
            return list(range(0x710 + 0x20 * nth, 0x720 + 0x20 * nth))
        return [int(f"{1 + nth}{row}{column}", 16) for column in "012345" for row in "0123"]
