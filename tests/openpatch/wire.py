"""The open patch protocol written down a second time, as plainly as possible, to hold the first against it."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass, field


def crc32(data: bytes) -> int:
    """Bit by bit: polynomial 0x04C11DB7 reflected, begun with and inverted by all ones."""
    crc = 0xFFFFFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0xEDB88320 if crc & 1 else 0)
    return crc ^ 0xFFFFFFFF


def stuff(data: bytes) -> bytes:
    """COBS without the delimiter."""
    out, block, open_block = b"", b"", True
    for byte in data:
        open_block = True
        if byte:
            block += bytes([byte])
        if not byte or len(block) == 254:
            out += bytes([len(block) + 1]) + block
            open_block = byte == 0
            block = b""
    return out + bytes([len(block) + 1]) + block if open_block else out


def frame(message_type: int, payload: bytes) -> bytes:
    message = bytes([message_type]) + payload
    return stuff(message + struct.pack("<I", crc32(message))) + b"\0"


def text(words: str) -> bytes:
    return words.encode() + b"\0"


@dataclass
class Said:
    """What a patch says of itself; changed by tests that lie."""

    product: str = "tip"
    serial_number: str = "7"
    firmware: str = "1.0"
    periods_us: tuple[int, int, int] = (10000, 1000, 1000000)
    types: list[tuple[int, float, float, float, float, str, str]] = field(
        default_factory=lambda: [
            (1, 0.5, -10.0, 0.0, 100.0, "pressure", "kPa"),
            (5, 0.25, 0.0, 0.0, 0.0, "temperature", "degC"),
        ]
    )
    kinds: list[tuple[str, int, list[tuple[int, list[int]]]]] = field(
        default_factory=lambda: [("tip", 2, [(3, [0]), (1, [1])])]
    )
    modules: list[tuple[int, int]] = field(default_factory=lambda: [(0, 2)])
    more: list[bytes] = field(default_factory=list)

    def items(self) -> list[bytes]:
        head = b"\x01" + struct.pack("<III", *self.periods_us)
        head += text(self.product) + text(self.serial_number) + text(self.firmware)
        types = [
            b"\x02" + struct.pack("<Iffff", *numbers) + text(name) + text(unit) for *numbers, name, unit in self.types
        ]
        kinds = [
            b"\x03"
            + text(name)
            + bytes([dtype, len(runs)])
            + b"".join(struct.pack("<HB", count, len(axes)) + bytes(axes) for count, axes in runs)
            for name, dtype, runs in self.kinds
        ]
        modules = b"\x04" + bytes([len(self.modules)]) + bytes(byte for entry in self.modules for byte in entry)
        return [head, *types, *kinds, modules, *self.more]


def greeting(
    items: Sequence[bytes], *, major: int = 1, reset: int = 0, streaming: bool = False, uptime_ms: int = 0
) -> bytes:
    return struct.pack("<BBBBIIH", major, 0, reset, streaming, uptime_ms, crc32(b"".join(items)), len(items))
