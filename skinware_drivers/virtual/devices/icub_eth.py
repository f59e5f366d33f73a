"""Emulated skin boards behind an Ethernet board of iCub.

Source: robotology/icub-firmware-shared; the vectors in tests/streams/test_icub_eth.py.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Annotated

from msgspec import Meta

from skinware_drivers.virtual import Device, Places, SerialEmulator, SerialEmulatorOptions, on_pads

_ROOM = 24


def datagram(skin: int, records: Sequence[tuple[int, bytes]], number: int, time_us: int) -> bytes:
    """Return a frame with one signal of a skin, with all its room, after another variable, as in real frames."""
    items = b"".join(struct.pack("<H8s", len(data) << 12 | can, data) for can, data in records)
    array = struct.pack("<BBBB", _ROOM, 10, len(records), 0) + items.ljust(10 * _ROOM, b"\0")
    joint = struct.pack("<BBHI", 0, 4, 8, 0x0100_0004) + b"a joint\0"
    signal = joint + struct.pack("<BBHI", 0, 4, len(array), 0x0300_0002 | skin << 8) + array
    return struct.pack("<IHHQQ", 0x12345678, len(signal), 2, time_us, number) + signal + struct.pack("<I", 0x87654321)


class EmulatedIcubEthOptions(SerialEmulatorOptions, frozen=True):
    boards: Annotated[tuple[int, ...], Meta(description="addresses of the skin boards")] = (1,)
    triangles: Annotated[int, Meta(ge=1, le=12, description="triangles of each board")] = 12
    skin: Annotated[int, Meta(ge=0, le=1, description="CAN port of the Ethernet board that they are on")] = 0
    period_ms: Annotated[float, Meta(ge=1, le=255, description="time between two updates of a board, ms")] = 50


class EmulatedIcubEth(SerialEmulator[EmulatedIcubEthOptions]):
    full_scale = 255
    rest = 240
    swing = -150
    speed_mbit_s = 100
    streams = "always"
    numbered_by = "boards"
    _sent = 0

    def places(self) -> Places:
        return on_pads(*[(12, 4)] * self.options.triangles)

    def kinds(self) -> Sequence[str]:
        """Name the CAN frames that the board's datagrams carry."""
        triangles = range(self.options.triangles)
        return [
            f"0x{0x400 | board << 4 | triangle:03x}-{half}"
            for board in self.numbers
            for triangle in triangles
            for half in ("head", "tail")
        ]

    def messages(self, device: Device, values: Sequence[int]) -> Sequence[bytes]:
        records = []
        for triangle in range(self.options.triangles):
            can = 0x400 | device.number << 4 | triangle
            twelve = bytes(values[12 * triangle : 12 * triangle + 12])
            halves = {"head": b"\x40" + twelve[:7], "tail": b"\xc0" + twelve[7:] + b"\0\0"}
            records += [(can, data) for half, data in halves.items() if f"0x{can:03x}-{half}" not in self.silent]
        self._sent += 1
        return [datagram(self.options.skin, records, self._sent, device.sampled_ns // 1000)]
