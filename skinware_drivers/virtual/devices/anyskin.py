"""An emulated AnySkin board: sends from power-up to the end, and hears nothing.

Source: ``arduino/5X_binary_burst_stream`` of github.com/raunaqbhirangi/anyskin.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Annotated

import numpy as np
import numpy.typing as npt
from msgspec import Meta

from skinware_drivers.virtual.emulator import Device
from skinware_drivers.virtual.press import on_a_grid
from skinware_drivers.virtual.serial_device import SerialEmulator, SerialEmulatorOptions


class EmulatedAnySkinOptions(SerialEmulatorOptions, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What the board is."""

    mags: Annotated[int, Meta(ge=1, le=64, description="magnetometers of the board")] = 5


class EmulatedAnySkin(SerialEmulator[EmulatedAnySkinOptions]):
    """One board, device 1; see :class:`skinware_drivers.virtual.serial_device.SerialEmulator`.

    Values: temperature, x, y and z of magnetometer 0, of magnetometer 1 ... in degrees Celsius and microtesla.
    """

    full_scale = 50_000
    lowest = -50_000
    rest = 25
    swing = 400

    def places(self) -> npt.NDArray[np.float64]:
        return on_a_grid(self.options.mags, self.options.mags, each=4)

    def boot(self, device: Device, now_ns: int) -> None:
        self.start(device, now_ns)

    def messages(self, device: Device, values: Sequence[int]) -> Sequence[bytes]:  # noqa: ARG002
        return [struct.pack(f"<{len(values)}f", *values) + b"\r\n"]
