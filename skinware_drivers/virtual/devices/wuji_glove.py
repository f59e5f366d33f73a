"""An emulated tactile glove of Wuji.

Source: github.com/wuji-technology/wujihandpy (MIT) with the vector in tests/serial/test_wuji_glove.py.
"""

from __future__ import annotations

import binascii
import math
import struct
from collections.abc import Sequence
from typing import Annotated, Literal

from msgspec import Meta

from skinware_drivers.virtual import Device, Places, SerialEmulator, SerialEmulatorOptions, cut_packets, on_a_grid

_OK, _BAD_LENGTH, _BAD_CHECKSUM, _UNKNOWN, _BAD_PAYLOAD = 0x00, 0x10, 0x11, 0x12, 0x13
_NEEDED = {0x0101: 0, 0x0102: 0, 0x0103: 0, 0x0301: 0, 0x0401: 1, 0x0501: 2, 0x0502: 5}  # bytes of arguments


def message(sync: int, body: bytes) -> bytes:
    covered = struct.pack("<H", len(body) + 6) + body
    return bytes((0xAA, sync)) + covered + struct.pack("<H", binascii.crc_hqx(covered, 0xFFFF))


class EmulatedWujiGloveOptions(SerialEmulatorOptions, frozen=True):
    hand: Literal["left", "right"] = "left"
    period_ms: Annotated[
        float, Meta(ge=1, le=1000, description="time between two frames until the host changes it, ms")
    ] = 1e3 / 120
    invalid: Annotated[tuple[int, ...], Meta(description="cells that send NaN")] = ()


class EmulatedWujiGlove(SerialEmulator[EmulatedWujiGloveOptions]):
    """One board, device number 1.

    Values: those of the cells, in 1/4096 of their range.
    """

    full_scale = 4096
    swing = 3500
    speed_mbit_s = 12  # USB, full speed

    def places(self) -> Places:
        return on_a_grid(768, 32)

    def cut(self, heard: bytes) -> tuple[list[bytes], bytes]:
        return cut_packets(
            heard, b"\xaa\x56", lambda part: max(10, min(512, part[2] | part[3] << 8)) if len(part) >= 4 else 0
        )

    def answer(self, device: Device, command: bytes, now_ns: int) -> bytes:
        """Answer with the command's number, a status and the data."""
        status, answer = self._do(device, command, now_ns)
        return message(0x57, command[4:8] + bytes([status]) + answer)

    def messages(self, device: Device, values: Sequence[int]) -> Sequence[bytes]:
        cells = [math.nan if at in self.options.invalid else value / 4096 for at, value in enumerate(values)]
        sent = device.memory["sent"] = device.memory.get("sent", -1) + 1
        hand = struct.pack("<B3x", self.options.hand == "right")
        uptime_ms = (device.sampled_ns - device.ready_ns) // 1_000_000
        tail = struct.pack("<HI", sent & 0xFFFF, uptime_ms & 0xFFFF_FFFF)
        return [message(0x55, hand + struct.pack("<768f", *cells) + tail)]

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
        if number == 0x0102:
            return _OK, b"emulated"
        if number == 0x0103:
            return _OK, bytes([self.options.hand == "right"])
        if number == 0x0301:
            uptime_ms = (now_ns - device.ready_ns) // 1_000_000
            return _OK, struct.pack("<IIIIH", uptime_ms, device.memory.get("sent", -1) + 1, 0, 0, 0)
        if number == 0x0401:
            if arguments[0]:
                self.start(device, now_ns, 1 / self._hz(device))
            else:
                self.stop(device)
            return _OK, b""
        return self._setting(device, arguments, now_ns)

    def _hz(self, device: Device) -> int:
        hz: int = device.memory.get("hz", round(1e3 / self.options.period_ms))
        return hz

    def _setting(self, device: Device, arguments: bytes, now_ns: int) -> tuple[int, bytes]:
        if arguments == b"\1\0":
            return _OK, bytes([1, device.streams_from_ns is not None])
        if arguments[:2] != b"\2\0":
            return _BAD_PAYLOAD, b""
        if len(arguments) == 2:
            return _OK, struct.pack("<BH", 0, self._hz(device))
        hz = int.from_bytes(arguments[3:], "little")
        if arguments[2] or not hz:
            return _BAD_PAYLOAD, b""
        device.memory["hz"] = hz
        self.change_period(device, now_ns, 1 / hz)
        return _OK, b""
