"""An emulated port of an iCub's skin: what it says to a reader that asked for text.

Source: YARP's manual; the vectors in tests/yarp/test_text.py. A device is a port. That it has a name, and is found and
called by it, is made by the bus: ``skin-emulate --driver yarp --bus yarp://HOST:PORT/NAME``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

import numpy as np
import numpy.typing as npt
from msgspec import Meta

from skinware_drivers.virtual.emulator import Device, on_a_grid
from skinware_drivers.virtual.serial_device import SerialEmulator, SerialEmulatorOptions

_BOOT_TIME_S = 1_700_000_000.0


class EmulatedYarpOptions(SerialEmulatorOptions, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What it sends."""

    length: Annotated[int, Meta(ge=1, le=3072, description="values of a message")] = 192
    envelope: Annotated[bool, Meta(description="tell number and time of each message")] = True
    period_ms: Annotated[float, Meta(ge=1, description="time between two messages, ms")] = 20


class EmulatedYarp(SerialEmulator[EmulatedYarpOptions]):
    """One port; see :class:`skinware_drivers.virtual.serial_device.SerialEmulator`."""

    full_scale = 255
    rest = 0
    swing = 150
    speed_mbit_s = 100

    def places(self) -> npt.NDArray[np.float64]:
        """All values."""
        return on_a_grid(self.options.length, 12)

    def boot(self, device: Device, now_ns: int) -> None:
        """Sends to whoever reads."""
        self.start(device, now_ns)

    def messages(self, device: Device, values: Sequence[int]) -> Sequence[bytes]:
        """One vector, as YARP writes doubles."""
        told = " ".join(f"{value}.0" for value in values)
        envelope = f"o {device.cycle} {_BOOT_TIME_S + device.sampled_ns / 1e9:.6f}" if self.options.envelope else "o"
        return [f"d{envelope}\r\n{told}\r\n".encode()]
