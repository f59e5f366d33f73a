"""Emulated hands Allegro V5, which send by themselves, as if their own program had started them.

Sources: allegro_hand_ros2_v5, allegro_hand_ros2_V5_Sense, allegro_hand_v5_plus_python.
"""

from __future__ import annotations

import struct
from collections.abc import Collection, Sequence
from typing import Annotated

from msgspec import Meta

from skinware_drivers.virtual import (
    CanFrame,
    Device,
    Emulator,
    EmulatorOptions,
    Places,
    SerialEmulator,
    SerialEmulatorOptions,
    on_pads,
)

_JOINTS = 16
_PADS = (1, 1), (3, 1), (4, 1), (4, 1), (4, 1)


class EmulatedAllegroV5Options(EmulatorOptions, frozen=True):
    period_ms: Annotated[int, Meta(ge=1, description="time between two messages of a kind, ms")] = 10


class EmulatedAllegroV5(Emulator[EmulatedAllegroV5Options]):
    """One V5 Sense on CAN, device 0.

    Values: the pads in the order of the frames, as bytes.
    """

    full_scale = 254
    swing = 200
    identifiers: Collection[int] = frozenset((0x150, 0x154, 0x3C0, 0x3C8, 0x140, 0x148))
    streams = "always"

    def places(self) -> Places:
        return on_pads(*_PADS)

    def frames(self, device: Device, values: Sequence[int]) -> Sequence[CanFrame]:  # noqa: ARG002
        return [(0x054 << 2, bytes(values[:8])), (0x055 << 2, bytes(values[8:]))]


class EmulatedAllegroV5TipsOptions(EmulatedAllegroV5Options, frozen=True):
    air_pa: Annotated[int, Meta(ge=0, description="pressure of an untouched fingertip, Pa")] = 0


class EmulatedAllegroV5Tips(Emulator[EmulatedAllegroV5TipsOptions]):
    """One V5 Plus on CAN, device 0. Values: index, middle, ring finger and thumb, in Pa above those of the air."""

    full_scale = 30_000
    lowest = -1_000
    swing = 4_000
    identifiers: Collection[int] = EmulatedAllegroV5.identifiers
    streams = "always"

    def places(self) -> Places:
        return on_pads(*[(1, 1)] * 4)

    def frames(self, device: Device, values: Sequence[int]) -> Sequence[CanFrame]:  # noqa: ARG002
        pascals = [value + self.options.air_pa for value in values]
        return [(0x0F0 << 2, struct.pack("<2i", *pascals[:2])), (0x0F2 << 2, struct.pack("<2i", *pascals[2:]))]


class EmulatedAllegroV5UdpOptions(SerialEmulatorOptions, frozen=True):
    period_ms: Annotated[float, Meta(ge=0.1, description="time between two datagrams, ms")] = 3


class EmulatedAllegroV5Udp(SerialEmulator[EmulatedAllegroV5UdpOptions]):
    """One V5 Sense over UDP, device 1: its messages are datagrams. Values: the pads, in 0.1 kPa."""

    full_scale = 1016
    swing = 800
    speed_mbit_s = 100
    datagrams = True
    streams = "always"

    def places(self) -> Places:
        return on_pads(*_PADS)

    def messages(self, device: Device, values: Sequence[int]) -> Sequence[bytes]:
        number = device.cycle & 0xFFFF_FFFF
        joints = [100 * joint for joint in range(_JOINTS)]
        sample = struct.pack("<I16h16h16H16i", number, *joints, *joints, *values, *joints)
        header = struct.pack(
            "<IBBHII", 0x32423556, 1, 2, len(sample), number, device.sampled_ns // 1_000_000 & 0xFFFF_FFFF
        )
        return [header + sample]
