"""An emulated converter with its sensors: silent until it is set up. It shares nothing with the driver.

Wire format: github.com/shadow-robot/optoforce and github.com/alknemeyer/optoforce.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Annotated, Literal

import numpy as np
import numpy.typing as npt
from msgspec import Meta
from skinware_drivers.virtual import Device, SerialEmulator, SerialEmulatorOptions, cut_packets, on_a_grid


class EmulatedOptoforceOptions(SerialEmulatorOptions, frozen=True):
    """Which model it is, and what is wrong with it."""

    sensors: Annotated[Literal[1, 4], Meta(description="how many sensors it has")] = 1
    status: Annotated[int, Meta(ge=0, le=0xFFFF, description="its status word, as 0x200")] = 0


class EmulatedOptoforce(SerialEmulator[EmulatedOptoforceOptions]):
    """One converter."""

    lowest = -32768
    full_scale = 32767
    swing = 9_000

    def places(self) -> npt.NDArray[np.float64]:
        """Three axes each."""
        return on_a_grid(self.options.sensors, columns=2, each=3)

    def cut(self, heard: bytes) -> tuple[list[bytes], bytes]:
        """There is one command: AA 00 32 03 period filter zero sum."""
        return cut_packets(heard, b"\xaa\x00\x32\x03", lambda _: 9)

    def answer(self, device: Device, command: bytes, now_ns: int) -> bytes | None:
        """Obey without a word."""
        if command[7:] != checksum(command[:7]):
            return None
        period_ms, device.memory["filter"], zero = command[4:7]
        if zero:
            device.memory["tared"] = True
        self.stop(device)
        if period_ms:
            self.start(device, now_ns, period_ms / 1000)
        return b""

    def messages(self, device: Device, values: Sequence[int]) -> Sequence[bytes]:
        """One packet with all sensors."""
        model = 0x0A if self.options.sensors == 1 else 0x1C
        packet = struct.pack(">4B2H", 0xAA, 7, 8, model, device.cycle & 0xFFFF, self.options.status)
        packet += struct.pack(f">{len(values)}h", *values)
        return [packet + checksum(packet)]


def checksum(data: bytes) -> bytes:
    """Behind the data."""
    return struct.pack(">H", sum(data))
