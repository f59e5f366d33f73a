"""The checksum and the commands of emulated devices of Weiss Robotics."""

from __future__ import annotations

from skinware_drivers.virtual import cut_packets

BEGIN = b"\xaa\xaa\xaa"


def crc(data: bytes) -> int:
    """Return the checksum bit by bit: the polynomial of the CCITT, shifted the other way."""
    state = 0xFFFF
    for byte in data:
        entry = ((state ^ byte) & 0xFF) << 8
        for _ in range(8):
            entry = (entry << 1 ^ (0x1021 if entry & 0x8000 else 0)) & 0xFFFF
        state = entry ^ state >> 8
    return state


def cut_commands(heard: bytes, *, bare_when_empty: bool = False) -> tuple[list[bytes], bytes]:
    """Return the whole commands, by the length in each, and the rest.

    Args:
        heard: bytes of the line.
        bare_when_empty: a command without payload has no checksum.
    """

    def size(part: bytes) -> int:
        if len(part) < 6:
            return 0
        length = int.from_bytes(part[4:6], "little")
        return 8 + length if length or not bare_when_empty else 6

    return cut_packets(heard, BEGIN, size)
