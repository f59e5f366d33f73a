"""Emulated fingertips TSF-85 of Robotiq, both on one line.

Source: the maker's package ``pyrobotiqtactile``, which reads them in tests/serial/test_robotiq_tsf.py.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Annotated

import numpy as np
from msgspec import Meta

from skinware_drivers.virtual import Device, Places, SerialEmulator, SerialEmulatorOptions, cut_packets, on_a_grid

_FIELDS = {
    "static": (0x10, 0, 28),
    "dynamic": (0x20, 28, 1),
    "accelerometer": (0x30, 29, 3),
    "gyroscope": (0x40, 32, 3),
    "magnetometer": (0x50, 35, 3),
    "temperature": (0x60, 38, 1),
}
_VERSION = bytes.fromhex("010203")


class EmulatedRobotiqTsfOptions(SerialEmulatorOptions, frozen=True):
    fingers: Annotated[tuple[int, ...], Meta(description="fingertips: 0, 1")] = (0, 1)
    slow: Annotated[int, Meta(ge=1, description="only every so many packets have magnetometer and temperature")] = 1
    timed: Annotated[bool, Meta(description="send the device's time in microseconds")] = True


class EmulatedRobotiqTsf(SerialEmulator[EmulatedRobotiqTsfOptions]):
    """Two fingertips that send on command; in the bootloader they are silent until they lose their power."""

    full_scale = (65535,) * 28 + (32767,) * 11
    lowest = (0,) * 28 + (-32768,) * 11
    rest = (400,) * 28 + (0,) * 3 + (16384,) + (0,) * 6 + (250,)
    swing = (9000,) * 28 + (800,) + (0,) * 10
    numbered_by = "fingers"

    def places(self) -> Places:
        return np.concatenate([on_a_grid(28, 4), [[0.5, 0.5, 0.0]] * 11])

    def cut(self, heard: bytes) -> tuple[list[bytes], bytes]:
        return cut_packets(heard, b"\x9a\0", lambda part: 4 + part[3] if len(part) > 3 else 0)

    def answer(self, device: Device, command: bytes, now_ns: int) -> bytes | None:
        number, data = command[2], command[4:]
        if device.memory.get("bootloader"):
            return None
        if number == 0xE2:
            self.stop(device)
            device.memory["bootloader"] = True
        elif number == 0xE3:
            return self._packet(number, _VERSION) if device.number == self.numbers[0] else b""
        elif number == 0x61:
            self.burst(device, now_ns)
        elif number in (0x58, 0x59) and data:
            self.stop(device)
            if data[0]:
                self.start(device, now_ns, data[0] / 1e3)
        else:
            return None
        return b""

    def kinds(self) -> Sequence[str]:
        return [f"{name}{finger}" for finger in self.numbers for name in _FIELDS]

    def messages(self, device: Device, values: Sequence[int]) -> Sequence[bytes]:
        data = b""
        for name, (kind, first, count) in _FIELDS.items():
            is_due = device.cycle % self.options.slow == 0 or name not in ("magnetometer", "temperature")
            if is_due and f"{name}{device.number}" in self.silent:
                self.counts["silenced"] += 1
            elif is_due:
                form = f">{count}{'H' if name == 'static' else 'h'}"
                data += bytes([kind | device.number << 2]) + struct.pack(form, *values[first : first + count])
        if self.options.timed:
            data += bytes([0x70 | device.number << 2]) + struct.pack(">Q", device.sampled_ns // 1000)
        return [self._packet(0x61, data)]

    @staticmethod
    def _packet(command: int, data: bytes) -> bytes:
        return bytes([0x9A, 0, command, len(data)]) + data
