"""An emulated device of the AGNI serial protocol.

Source: agni_serial_protocol, ``serial_protocol_defines.h`` (BSD); the vectors in tests/serial/test_agni.py.
"""

from __future__ import annotations

import functools
import operator
import struct
from collections.abc import Sequence
from typing import Annotated

from msgspec import Meta

from skinware_drivers.virtual import Device, Places, SerialEmulator, SerialEmulatorOptions, cut_packets, on_pads

_DEVICE, _TYPE = 7, 0x0203
_BAD_CHECKSUM, _UNKNOWN, _NO_SUCH_SENSOR = 0xF0, 0xF1, 0xF2


def message(number: int, body: bytes) -> bytes:
    sent = bytes((0xF0, 0xC4, number)) + body
    return sent + bytes([functools.reduce(operator.xor, sent)])


class EmulatedAgniOptions(SerialEmulatorOptions, frozen=True):
    sensors: Annotated[tuple[int, ...], Meta(description="number of values of each sensor")] = (16, 4)


class EmulatedAgni(SerialEmulator[EmulatedAgniOptions]):
    """One device, number 1.

    Values: uint16, those of sensor 1, of sensor 2 ... Its time is in microseconds.
    """

    full_scale = 4095
    swing = 3500

    def places(self) -> Places:
        return on_pads(*[(count, 4) for count in self.options.sensors])

    def cut(self, heard: bytes) -> tuple[list[bytes], bytes]:
        return cut_packets(heard, b"\xf0\xc4", _total)

    def messages(self, device: Device, values: Sequence[int]) -> Sequence[bytes]:
        uptime_us = (device.sampled_ns - device.ready_ns) // 1000
        stamp, sent, at = struct.pack("<I", uptime_us & 0xFFFF_FFFF), [], 0
        for number, count in enumerate(self.options.sensors, 1):
            sent.append(message(number, stamp + struct.pack(f"<{count}H", *values[at : at + count])))
            at += count
        return sent

    def kind_of(self, identifier: int, payload: bytes) -> str:  # noqa: ARG002
        """Return ``sensor1`` and so on; other messages are answers."""
        return f"sensor{payload[2]}" if 1 <= payload[2] <= len(self.options.sensors) else "answer"

    def answer(self, device: Device, command: bytes, now_ns: int) -> bytes:
        target, number = command[2:4]
        if functools.reduce(operator.xor, command):
            return message(0xFE, bytes([_BAD_CHECKSUM]))
        if target > len(self.options.sensors) or (target and number != 0xD0):
            return message(0xFE, bytes([_NO_SUCH_SENSOR]))
        if number == 0xC0:
            each = b"".join(struct.pack("<HH", _TYPE, 2 * count) for count in self.options.sensors)
            return message(0, bytes((1, _DEVICE, len(self.options.sensors))) + each)
        if number == 0xF0:
            return message(0xF0, b"")
        if number == 0x00:
            self.stop(device)
        elif number == 0xF1:
            self.start(device, now_ns, device.memory.get("period_s", self.options.period_ms / 1e3))
        elif number == 0xD0:
            first = 6 if target else 7  # the last one sent holds for all sensors here
            device.memory["period_s"] = max(1, int.from_bytes(command[first : first + 2], "little")) * 1e-4
            self.change_period(device, now_ns, device.memory["period_s"])
        else:
            return message(0xFE, bytes([_UNKNOWN]))
        return b""


def _total(command: bytes) -> int:
    if len(command) < 4 or command[3] != 0xD0:
        return 5 if len(command) >= 4 else 0
    each = 1 if command[2] else 3  # to a sensor, its period; to the device, numbers of sensors and periods
    return 7 + each * int.from_bytes(command[4:6], "little") if len(command) >= 6 else 0
