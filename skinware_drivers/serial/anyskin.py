"""AnySkin and ReSkin: magnetometers under a magnetic skin, on the serial port of a microcontroller.

Wire format: the maker's firmware, ``arduino/5X_binary_burst_stream`` (github.com/raunaqbhirangi/anyskin). 115200 baud
on USB. A message is, for each magnetometer, temperature, x, y and z as little-endian float32, and 0D 0A behind them
all: 82 bytes for five. The library that the firmware uses gives degrees Celsius and microtesla.

A message has no beginning, no checksum and no counter, and the board takes no command. 0D 0A can also occur within
values: after any error a message counts only if it ends with 0D 0A and the 82 bytes behind it do, too.
"""

from __future__ import annotations

from typing import Annotated

import numpy as np
from msgspec import Meta

from skinware.sensor_types import MAGNETIC_FIELD_X, MAGNETIC_FIELD_Y, MAGNETIC_FIELD_Z, TEMPERATURE
from skinware_drivers import Frame, Layout, Module, Options, Patch, Values, taxels
from skinware_drivers.fields import NO_NUMBER
from skinware_drivers.serial import Packet, SerialAdapter


class AnySkinOptions(Options, frozen=True):
    mags: Annotated[int, Meta(description="magnetometers of the board", ge=1, le=64)] = 5
    period_ms: Annotated[int, Meta(description="nominal time between two messages, ms", ge=1)] = 10


class AnySkinDriver(SerialAdapter[AnySkinOptions]):
    """One board on a serial line: one module, as a message has all of it.

    The four sensors of a magnetometer share its number as their uid. Values are as the board sends them; those that are
    no number are ``SUSPECT``.
    """

    types = (
        TEMPERATURE,
        *(t.measured(scale=1e-6) for t in (MAGNETIC_FIELD_X, MAGNETIC_FIELD_Y, MAGNETIC_FIELD_Z)),
    )
    dtype = np.float32

    def __init__(self, options: AnySkinOptions) -> None:
        super().__init__(options)
        size = 16 * options.mags
        self.framing = Packet(length=size + 2, trailer=b"\r\n", confirmed=True)
        values = Values(offset=0, dtype="<f4", count=4 * options.mags)
        self.layout = Layout((Frame("message", (), (size,), values, flags=NO_NUMBER),))
        channels = taxels(options.mags, *(t.name for t in self.types))
        self.patches = (Patch("anyskin", (Module(channels, kind="board"),)),)
