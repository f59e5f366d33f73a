"""An emulated board of AnySkin, which sends from power-up on, and hears nothing.

Source: ``arduino/5X_binary_burst_stream`` of github.com/raunaqbhirangi/anyskin.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Annotated

from msgspec import Meta

from skinware_drivers.virtual import Device, Places, SerialEmulator, SerialEmulatorOptions, on_a_grid


class EmulatedAnySkinOptions(SerialEmulatorOptions, frozen=True):
    mags: Annotated[int, Meta(ge=1, le=64, description="magnetometers of the board")] = 5


class EmulatedAnySkin(SerialEmulator[EmulatedAnySkinOptions]):
    """One board, device 1.

    Values: temperature, x, y and z of magnetometer 0, of magnetometer 1 ... in degrees Celsius and microtesla.
    """

    full_scale = 50_000
    lowest = -50_000
    rest = 25
    swing = 400
    streams = "always"

    def places(self) -> Places:
        return on_a_grid(self.options.mags, self.options.mags, each=4)

    def messages(self, device: Device, values: Sequence[int]) -> Sequence[bytes]:  # noqa: ARG002
        return [struct.pack(f"<{len(values)}f", *values) + b"\r\n"]
