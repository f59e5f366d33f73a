"""Emulated patches that are read with skintalk: silent until '1', then a record for every cell, until '0'.

Source: ``skintalk.c`` of github.com/t173/skinvis. Frames are the bytes on the line.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt
from msgspec import Meta

from skinware_drivers.serial.framing import Unframed
from skinware_drivers.virtual.emulator import CanFrame, Device, Emulator, EmulatorOptions, on_a_grid


class EmulatedSkintalkOptions(EmulatorOptions, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Which patches there are."""

    patches: Annotated[tuple[int, ...], Meta(description="numbers of the patches")] = (1, 2, 3, 4, 5, 6, 7, 8)
    cells: Annotated[int, Meta(ge=1, le=16, description="cells of each patch")] = 16
    period_ms: Annotated[int, Meta(ge=1, description="time between two records of a cell, ms")] = 20


class EmulatedSkintalk(Emulator[EmulatedSkintalkOptions]):
    """Patches on one line; see :class:`skinware_drivers.virtual.emulator.Emulator`. Values: one for each cell."""

    full_scale = 0x7F_FFFF
    lowest = -0x80_0000
    rest = 50_000
    swing = 2_000_000
    payload_size = 64
    framing: Unframed = Unframed(payload_size)

    def __init__(self, options: EmulatedSkintalkOptions, **more: Any) -> None:
        self.numbers: Sequence[int] = options.patches
        super().__init__(options, **more)

    def places(self) -> npt.NDArray[np.float64]:
        """The cells of a patch."""
        return on_a_grid(self.options.cells, 4)

    def obey(self, device: Device, identifier: int, payload: bytes, now_ns: int) -> bool:  # noqa: ARG002
        """Start and stop; other bytes mean nothing."""
        for byte in payload:
            if byte == ord("1"):
                self.start(device, now_ns)
            elif byte == ord("0"):
                self.stop(device)
        return b"0" in payload or b"1" in payload

    def frames(self, device: Device, values: Sequence[int]) -> Sequence[CanFrame]:
        """A record for each cell."""
        return [
            (0, bytes((0x55, device.number << 4 | cell)) + struct.pack(">i", value)[1:])
            for cell, value in enumerate(values)
        ]
