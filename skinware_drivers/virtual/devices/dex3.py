"""Emulated Dex3-1 hands of Unitree, as the robot's program publishes them; the records of the bus ``dds``.

Source: unitreerobotics/unitree_ros2, ``unitree_hg/msg``; the participant of tests/streams/dex3_peer.py. A device is a
hand: 0 left, 1 right.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from typing import Annotated

import numpy as np
from msgspec import Meta

from skinware_drivers.virtual import Device, Places, SerialEmulator, SerialEmulatorOptions, on_pads

_PADS = 9
_PRESSURE, _TEMPERATURE = (100_000,) * 12, (25,) * 12
_MOTOR = struct.pack("<B3x4f2hf2II4I", 1, 0, 0, 0, 0, 35, 35, 24, 0, 0, 0, 0, 0, 0, 0)
_IMU = struct.pack("<13fh2x", 1, *(0,) * 8, 9.81, *(0,) * 3, 40)
_POWER = struct.pack("<4f4I", 24, 1, 12, 5, 0, 0, 0, 0)


class EmulatedDex3Options(SerialEmulatorOptions, frozen=True, forbid_unknown_fields=True, kw_only=True):
    hands: Annotated[tuple[int, ...], Meta(description="hands: 0 left, 1 right")] = (0, 1)
    period_ms: Annotated[float, Meta(ge=1, description="time between two samples of a hand, ms")] = 2


class EmulatedDex3(SerialEmulator[EmulatedDex3Options]):
    full_scale = ((1_000_000,) * 12 + (100,) * 12) * _PADS
    lowest = (_PRESSURE + (0,) * 12) * _PADS
    rest = (_PRESSURE + _TEMPERATURE) * _PADS
    swing = ((250_000,) * 12 + (8,) * 12) * _PADS
    speed_mbit_s = 100
    streams = "always"
    numbered_by = "hands"

    def places(self) -> Places:
        cells = on_pads(*[(12, 4)] * _PADS).reshape(_PADS, 12, 3)
        return np.concatenate([cells, cells], axis=1).reshape(-1, 3)

    def kind_of(self, identifier: int, payload: bytes) -> str:  # noqa: ARG002
        return f"hand{payload[6]}" if len(payload) > 6 else ""

    def messages(self, device: Device, values: Sequence[int]) -> Sequence[bytes]:
        pads = b"".join(struct.pack("<24f2I", *values[24 * pad : 24 * pad + 24], 0, 0) for pad in range(_PADS))
        sample = b"\0\1\0\0" + struct.pack("<I", 7) + 7 * _MOTOR + struct.pack("<I", _PADS) + pads + _IMU + _POWER
        stamp = device.sampled_ns // 10_000 & 0xFFFF_FFFF
        record = struct.pack("<2sIBBI", b"\xdd\x5a", 16 + len(sample), device.number, 0, stamp) + sample
        return [record + struct.pack("<I", zlib.crc32(record))]
