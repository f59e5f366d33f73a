"""Emulated publishers on DDS: records of the bus ``dds``.

* Dex3-1 hands of Unitree, as the robot's program publishes them. Source: unitreerobotics/unitree_ros2,
  ``unitree_hg/msg``; the participants of tests/streams/dex3_peer.py.
* Programs that publish touch on topics of ROS 2; the participants of tests/streams/ros2_peer.py.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta

from skinware_drivers.virtual import Device, Places, SerialEmulator, SerialEmulatorOptions, on_a_grid, on_pads


def _record(device: Device, number: int, sample: bytes) -> bytes:
    """Return a record of the bus ``dds``."""
    stamp = device.sampled_ns // 10_000 & 0xFFFF_FFFF
    record = struct.pack("<2sIHI", b"\xdd\x5a", 16 + len(sample), number, stamp) + sample
    return record + struct.pack("<I", zlib.crc32(record))


_PADS = 9
_PRESSURE, _TEMPERATURE = (100_000,) * 12, (25,) * 12
_MOTOR = struct.pack("<B3x4f2hf2II4I", 1, 0, 0, 0, 0, 35, 35, 24, 0, 0, 0, 0, 0, 0, 0)
_IMU = struct.pack("<13fh2x", 1, *(0,) * 8, 9.81, *(0,) * 3, 40)
_POWER = struct.pack("<4f4I", 24, 1, 12, 5, 0, 0, 0, 0)


class EmulatedDex3Options(SerialEmulatorOptions, frozen=True):
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
        cells = on_pads(*[(12, 3)] * _PADS).reshape(_PADS, 12, 3)
        return np.concatenate([cells, cells], axis=1).reshape(-1, 3)

    def kind_of(self, identifier: int, payload: bytes) -> str:  # noqa: ARG002
        return f"hand{payload[6]}" if len(payload) > 6 else ""

    def messages(self, device: Device, values: Sequence[int]) -> Sequence[bytes]:
        pads = b"".join(struct.pack("<24f2I", *values[24 * pad : 24 * pad + 24], 0, 0) for pad in range(_PADS))
        sample = b"\0\1\0\0" + struct.pack("<I", 7) + 7 * _MOTOR + struct.pack("<I", _PADS) + pads + _IMU + _POWER
        return [_record(device, device.number, sample)]


_ROWS, _COLUMNS = 4, 6
_N = _ROWS * _COLUMNS
_TOPICS_APART = 64
_NUMBERS = {"points": 0, "image": 1, "array": 2, "sensors": 26}
"""Places of the message types in the driver's list."""
_FRAME = b"palm\0"


class EmulatedRos2Options(SerialEmulatorOptions, frozen=True):
    topics: Annotated[tuple[int, ...], Meta(description="numbers of the driver's topics that are published")] = (0,)
    message: Annotated[
        Literal["array", "image", "points", "sensors"],
        Meta(description="Float32MultiArray, Image, PointCloud2 or TactileState, of 4 x 6 taxels"),
    ] = "array"
    period_ms: Annotated[float, Meta(ge=1, description="time between two messages of a topic, ms")] = 20


class EmulatedRos2(SerialEmulator[EmulatedRos2Options]):
    full_scale = 4095
    swing = 3000
    speed_mbit_s = 100
    streams = "always"
    numbered_by = "topics"

    def places(self) -> Places:
        return on_a_grid(_N, _COLUMNS)

    def kind_of(self, identifier: int, payload: bytes) -> str:  # noqa: ARG002
        return f"topic{int.from_bytes(payload[6:8], 'little') // _TOPICS_APART}" if len(payload) > 6 else ""

    def messages(self, device: Device, values: Sequence[int]) -> Sequence[bytes]:
        message = self.options.message
        head = struct.pack("<iII", *divmod(device.sampled_ns, 10**9), len(_FRAME)) + _FRAME + bytes(3)
        if message == "array":
            dimensions = b"".join(_text(label) + struct.pack("<2I", size, size) for label, size in _DIMENSIONS)
            sample = struct.pack("<I", 2) + dimensions + struct.pack(f"<2I{_N}f", 0, _N, *values)
        elif message == "image":
            picture = struct.pack(f"<{_N}H", *values)
            shape = struct.pack("<3I", _ROWS, _COLUMNS, 7) + b"mono16\0" + b"\0"
            sample = head + shape + struct.pack("<2I", 2 * _COLUMNS, len(picture)) + picture
        elif message == "points":
            points = b"".join(struct.pack("<4f", n % _COLUMNS, n // _COLUMNS, 0, one) for n, one in enumerate(values))
            fields = b"".join(
                _text(name) + struct.pack("<IB3xI", 4 * at, 7, 1) for at, name in enumerate(("x", "y", "z", "pressure"))
            )
            sample = head + struct.pack("<3I", 1, _N, 4) + fields + struct.pack("<B3x2I", 0, 16, 16 * _N)
            sample += struct.pack("<I", len(points)) + points + b"\1"
        else:
            sample = head + struct.pack("<I", 2)
            for at, name in enumerate(("thumb", "index")):
                half = values[at * _N // 2 : (at + 1) * _N // 2]
                sample += _text(name) + struct.pack(f"<I{len(half)}f", len(half), *half)
        return [_record(device, device.number * _TOPICS_APART + _NUMBERS[message], b"\0\1\0\0" + sample)]


_DIMENSIONS = (("rows", _ROWS), ("columns", _COLUMNS))


def _text(text: str) -> bytes:
    data = text.encode() + b"\0"
    return struct.pack("<I", len(data)) + data + bytes(-len(data) % 4)
