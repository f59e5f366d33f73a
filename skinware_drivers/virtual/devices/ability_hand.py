"""An emulated Ability Hand, which answers the questions of the maker's programs and counts their commands to move.

Source: github.com/psyonicinc/ability-hand-api (``ah_api.py``, ``ah_parser.py``, ``ppp_stuffing.py``).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

from msgspec import Meta

from skinware_drivers.virtual import Device, Places, SerialEmulator, SerialEmulatorOptions, on_pads

_ASKED = "asked"  # in the memory of a device: the command to be answered
_MOVES = "moves"  # commands to move so far
_TARGETS = 12


def message(content: bytes) -> bytes:
    stuffed = bytearray()
    for byte in content + bytes([-sum(content) & 0xFF]):
        stuffed += bytes([0x7D, byte ^ 0x20]) if byte in (0x7E, 0x7D) else bytes([byte])
    return b"~" + bytes(stuffed) + b"~"


class EmulatedAbilityHandOptions(SerialEmulatorOptions, frozen=True):
    address: Annotated[int, Meta(ge=0, le=255, description="address of the hand")] = 0x50


class EmulatedAbilityHand(SerialEmulator[EmulatedAbilityHandOptions]):
    """One hand, device 1.

    Values: the sensors of index, middle, ring, little finger and thumb, six each.
    """

    full_scale = 4095
    rest = 300
    swing = 3000
    streams = "never"

    def places(self) -> Places:
        return on_pads(*[(6, 2)] * 5)

    def cut(self, heard: bytes) -> tuple[list[bytes], bytes]:
        *parts, rest = heard.split(b"~")
        return [part for part in parts if part], rest[-64:]

    def answer(self, device: Device, command: bytes, now_ns: int) -> bytes | None:
        content, escaped = bytearray(), False
        for byte in command:
            if byte == 0x7D and not escaped:
                escaped = True
                continue
            content.append(byte ^ 0x20 if escaped else byte)
            escaped = False
        if len(content) < 3 or sum(content) & 0xFF or content[0] != self.options.address:
            return None
        kind, variant = content[1] & 0xF0, content[1] & 0x0F
        size = {0xA0: 0, 0x10: _TARGETS, 0x20: _TARGETS, 0x30: _TARGETS, 0x40: _TARGETS}.get(kind)
        if variant > 2 or len(content) - 3 != size:
            return None
        if size:
            device.memory[_MOVES] = device.memory.get(_MOVES, 0) + 1
        if variant == 2:
            return message(bytes([content[1]]) + bytes(24) + bytes(12) + b"\0")
        device.memory[_ASKED] = content[1]
        self.burst(device, now_ns)
        return b""

    def messages(self, device: Device, values: Sequence[int]) -> Sequence[bytes]:
        """Return the answer: 12 bits of each sensor, the lowest first."""
        bits = sum(value << 12 * number for number, value in enumerate(values))
        positions = bytes(range(24))
        return [message(bytes([device.memory[_ASKED]]) + positions + bits.to_bytes(45, "little") + b"\0")]

    def moves(self) -> int:
        return sum(device.memory.get(_MOVES, 0) for device in self.devices.values())
