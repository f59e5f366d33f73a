"""Robotiq's own parser of TSF-85 packets reads packets that are made here; tests of the driver, the emulator."""

from __future__ import annotations

import struct

from comparing import Comparison
from pyrobotiqtactile.protocol import PacketParser

FINGERS = 2
FIELDS = {
    "static_tactile": (0x10, "28H", list(range(1000, 1028))),
    "dynamic_tactile": (0x20, "h", [-7]),
    "accelerometer": (0x30, "3h", [1, -2, 3]),
    "gyroscope": (0x40, "3h", [-4, 5, -6]),
    "magnetometer": (0x50, "3h", [7, -8, 9]),
    "temperature": (0x60, "h", [251]),
    "timestamp": (0x70, "Q", [1 << 40]),
}


def packet(finger: int, *names: str) -> bytes:
    """9A, a check byte (00 as in the maker's program), the command 61, the length, and fields."""
    data = b""
    for name in names:
        kind, form, values = FIELDS[name]
        data += bytes([kind | finger << 2]) + struct.pack(f">{form}", *(value + finger for value in values))
    return bytes([0x9A, 0, 0x61, len(data)]) + data


def main() -> None:
    comparison = Comparison("pyrobotiqtactile")
    for finger in range(FINGERS):
        together = packet(finger, *FIELDS)
        for name, packets in {
            "all fields in a packet": [together],
            "a packet for each field": [packet(finger, each) for each in FIELDS],
            "behind garbage": [b"\x00\xff" + together],
        }.items():
            parser = PacketParser()
            for each in parser.feed(b"".join(packets)):
                parser.parse_sensor_packet(each)
            found = parser.fingers[finger]
            theirs = {key: getattr(found, key) for key in FIELDS}
            ours = {key: [value + finger for value in values] for key, (_, _, values) in FIELDS.items()}
            alone = {key: values if len(values) > 1 else values[0] for key, values in ours.items()}
            comparison.agree(f"finger {finger}, {name}", alone, theirs)
    commands = [PacketParser.build_autosend_command(5), PacketParser.build_autosend_command(5, synchronous=False)]
    comparison.agree("commands", ["9a00580105", "9a00590105"], [each.hex() for each in commands])
    comparison.agree("version", "9a00e300", PacketParser.build_get_version_command().hex())
    comparison.end()


if __name__ == "__main__":
    main()
