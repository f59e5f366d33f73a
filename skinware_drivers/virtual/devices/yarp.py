"""An emulated port of an iCub's skin, which sends vectors in a binary carrier of YARP.

Source: exchanges with YARP 3.8.1 and 4.0.0; the vectors in tests/yarp/test_messages.py. The bus has its name and the
name server that knows it: ``skin-emulate --driver yarp --bus yarp://HOST:PORT/NAME``.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Annotated, Literal

from msgspec import Meta

from skinware_drivers.virtual import Device, Places, SerialEmulator, SerialEmulatorOptions, on_pads

_BOOT_TIME_S = 1_700_000_000.0
_TAGS = {3: 256 + 10, 4: 256 + 20}


class EmulatedYarpOptions(SerialEmulatorOptions, frozen=True):
    length: Annotated[int, Meta(ge=1, le=3072, description="values of a message")] = 192
    yarp: Annotated[
        Literal[3, 4], Meta(description="major version of its YARP, which decides how a list of doubles is marked")
    ] = 4
    envelope: Annotated[bool, Meta(description="send number and time of each message")] = True
    period_ms: Annotated[float, Meta(ge=1, description="time between two messages, ms")] = 20


class EmulatedYarp(SerialEmulator[EmulatedYarpOptions]):
    full_scale = 255
    rest = 0
    swing = 150
    speed_mbit_s = 100
    streams = "always"

    def places(self) -> Places:
        return on_pads(*[(min(12, self.options.length - first), 4) for first in range(0, self.options.length, 12)])

    def messages(self, device: Device, values: Sequence[int]) -> Sequence[bytes]:
        """Return one vector, as in YARP's binary carriers."""
        text = f"D {device.cycle} {_BOOT_TIME_S + device.sampled_ns / 1e9:.6f}\0".encode()
        command = struct.pack("<i", len(text)) + b"~\0\0\1" + text if self.options.envelope else b"\0\0\0\0~D\0\1"
        head = struct.pack("<ii", _TAGS[self.options.yarp], len(values))
        numbers = struct.pack(f"<{len(values)}d", *values)
        index = struct.pack("<3ii", len(command), len(head), len(numbers), 0)
        return [b"YA\n\0\0\0RP\3\1" + 8 * b"\xff" + index + command + head + numbers]
