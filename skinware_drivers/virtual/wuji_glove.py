"""An emulated tactile glove board of Wuji: its bytes on the line.

Source: github.com/wuji-technology/wujihandpy (MIT); the vector in tests/serial/test_wuji_glove.py.
"""

from __future__ import annotations

import binascii
import math
import struct
from collections.abc import Sequence
from typing import Annotated, Any, Literal

import numpy as np
import numpy.typing as npt
from msgspec import Meta

from skinware_drivers.virtual.commands import cut
from skinware_drivers.virtual.emulator import CanFrame, Device, Emulator, EmulatorOptions, on_a_grid

_OK, _BAD_LENGTH, _BAD_CHECKSUM, _UNKNOWN, _BAD_PAYLOAD = 0x00, 0x10, 0x11, 0x12, 0x13
_NEEDED = {0x0101: 0, 0x0103: 0, 0x0301: 0, 0x0401: 1, 0x0501: 2, 0x0502: 5}  # bytes of arguments
_USUAL_HZ = 120


def message(sync: int, body: bytes) -> bytes:
    """A message as it goes over the line."""
    covered = struct.pack("<H", len(body) + 6) + body
    return bytes((0xAA, sync)) + covered + struct.pack("<H", binascii.crc_hqx(covered, 0xFFFF))


class EmulatedWujiGloveOptions(EmulatorOptions, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What the board is."""

    hand: Literal["left", "right"] = "left"
    invalid: Annotated[tuple[int, ...], Meta(description="cells that send NaN")] = ()


class EmulatedWujiGlove(Emulator[EmulatedWujiGloveOptions]):
    """One board, device number 1; see :class:`skinware_drivers.virtual.emulator.Emulator`.

    Values: those of the cells, in 1/4096 of what they can measure.

    Attributes:
        payload_size: longest message.
    """

    full_scale = 4096
    swing = 3500
    numbers: Sequence[int] = (1,)
    period_s: float = 1 / _USUAL_HZ  # unless it is told another
    payload_size = 3088

    def __init__(self, options: EmulatedWujiGloveOptions, **more: Any) -> None:
        super().__init__(options, **more)
        self.wire.speed = 12  # USB, full speed

    def places(self) -> npt.NDArray[np.float64]:
        """All cells."""
        return on_a_grid(768, 32)

    def obey(self, device: Device, identifier: int, payload: bytes, now_ns: int) -> bool:  # noqa: ARG002
        """Answer every command that the bytes complete."""
        heard = device.memory.get("heard", b"") + payload
        commands, device.memory["heard"] = cut(
            heard, b"\xaa\x56", lambda part: max(10, min(512, part[2] | part[3] << 8)) if len(part) >= 4 else 0
        )
        for command in commands:
            status, answer = self._do(device, command, now_ns)
            self.reply(device, (0, message(0x57, command[4:8] + bytes([status]) + answer)), now_ns)
        return bool(commands)

    def burst(self, device: Device, time_ns: int) -> None:
        """Frames tell the time since power-up."""
        device.memory["ms"] = (time_ns - device.ready_ns) // 1_000_000
        super().burst(device, time_ns)

    def frames(self, device: Device, values: Sequence[int]) -> Sequence[CanFrame]:
        """One message with all cells."""
        cells = [math.nan if at in self.options.invalid else value / 4096 for at, value in enumerate(values)]
        sent = device.memory["sent"] = device.memory.get("sent", -1) + 1
        hand = struct.pack("<B3x", self.options.hand == "right")
        tail = struct.pack("<HI", sent & 0xFFFF, device.memory["ms"] & 0xFFFF_FFFF)
        return [(0, message(0x55, hand + struct.pack("<768f", *cells) + tail))]

    def _do(self, device: Device, command: bytes, now_ns: int) -> tuple[int, bytes]:
        number, arguments = int.from_bytes(command[4:6], "little"), command[8:-2]
        if int.from_bytes(command[2:4], "little") != len(command):
            return _BAD_LENGTH, b""
        if binascii.crc_hqx(command[2:-2], 0xFFFF) != int.from_bytes(command[-2:], "little"):
            return _BAD_CHECKSUM, b""
        if number not in _NEEDED:
            return _UNKNOWN, b""
        if len(arguments) != _NEEDED[number]:
            return _BAD_PAYLOAD, b""
        if number == 0x0101:
            return _OK, b"EMULATED-1".ljust(24, b"\0") + bytes((1, 0, 0, 0, 1, 2, 3, 0))
        if number == 0x0103:
            return _OK, bytes([self.options.hand == "right"])
        if number == 0x0301:
            uptime_ms = (now_ns - device.ready_ns) // 1_000_000
            return _OK, struct.pack("<IIIIH", uptime_ms, device.memory.get("sent", -1) + 1, 0, 0, 0)
        if number == 0x0401:
            return self._stream(device, bool(arguments[0]), now_ns)
        return self._rate(device, arguments, now_ns)

    def _stream(self, device: Device, on: bool, now_ns: int) -> tuple[int, bytes]:
        if on:
            self.start(device, now_ns, 1 / device.memory.get("hz", _USUAL_HZ))
        else:
            self.stop(device)
        return _OK, b""

    def _rate(self, device: Device, arguments: bytes, now_ns: int) -> tuple[int, bytes]:
        if arguments[:2] != b"\2\0":
            return _BAD_PAYLOAD, b""
        if len(arguments) == 2:
            return _OK, struct.pack("<BH", 0, device.memory.get("hz", _USUAL_HZ))
        hz = int.from_bytes(arguments[3:], "little")
        if arguments[2] or not hz:
            return _BAD_PAYLOAD, b""
        device.memory["hz"] = hz
        if device.streams_from_ns is not None:
            self.stop(device)
            self.start(device, now_ns, 1 / hz)
        return _OK, b""
