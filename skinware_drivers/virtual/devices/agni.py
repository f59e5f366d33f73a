"""An emulated device of the AGNI serial protocol.

Source: agni_serial_protocol, ``serial_protocol_defines.h`` (BSD), and for the sensors that its library knows by name
``registered_sensors_impl.h``; the vectors in tests/serial/test_agni.py.
"""

from __future__ import annotations

import functools
import operator
import struct
from collections.abc import Sequence
from typing import Annotated, Any

import numpy as np
from msgspec import Meta

from skinware_drivers.serial.agni_devices import DEVICES, AgniDevice, Name
from skinware_drivers.virtual import Device, Places, SerialEmulator, SerialEmulatorOptions, cut_packets, on_pads

_DEVICE, _TYPE = 7, 0x0203
_KNOWN: dict[Name, AgniDevice] = {"undefined": AgniDevice("<u2"), **DEVICES}
_MYRMEX = ((13, 14, 2, 0), (12, 3, 1, 4), (11, 9, 7, 5), (10, 15, 8, 6))
"""Converter of each taxel in the first four rows and columns of a quarter of them."""
_BAD_CHECKSUM, _UNKNOWN, _NO_SUCH_SENSOR = 0xF0, 0xF1, 0xF2


def message(number: int, body: bytes) -> bytes:
    sent = bytes((0xF0, 0xC4, number)) + body
    return sent + bytes([functools.reduce(operator.xor, sent)])


class EmulatedAgniOptions(SerialEmulatorOptions, frozen=True):
    sensors: Annotated[tuple[int, ...], Meta(description="number of values of each sensor, if it may vary")] = (16, 4)
    devices: Annotated[
        tuple[Name, ...],
        Meta(description="the makers' name of each sensor, in order; the last one is also that of all others"),
    ] = ("undefined",)


class EmulatedAgni(SerialEmulator[EmulatedAgniOptions]):
    """One device, number 1.

    Values: of sensor 1, of sensor 2 ... as the makers' library shows them. Its time is in microseconds.
    """

    full_scale: int | Sequence[int] = 4095
    swing = 3500

    def __init__(self, options: EmulatedAgniOptions, **more: Any) -> None:
        names, sizes = options.devices or ("undefined",), options.sensors or (1,)
        n_sensors = max(len(options.sensors), len(options.devices))
        self._names = [names[min(n, len(names) - 1)] for n in range(n_sensors)]
        known = [_KNOWN[name] for name in self._names]
        self._counts = [
            one.count(one.size) if one.is_single else sizes[min(n, len(sizes) - 1)] for n, one in enumerate(known)
        ]
        scales = [[127 if one.dtype == "<i1" else 4095] * n for one, n in zip(known, self._counts, strict=True)]
        self.full_scale = [scale for each in scales for scale in each]
        super().__init__(options, **more)

    def places(self) -> Places:
        return on_pads(*[(count, 4) for count in self._counts])

    def cut(self, heard: bytes) -> tuple[list[bytes], bytes]:
        return cut_packets(heard, b"\xf0\xc4", _total)

    def messages(self, device: Device, values: Sequence[int]) -> Sequence[bytes]:
        uptime_us = (device.sampled_ns - device.ready_ns) // 1000
        stamp, sent, at = struct.pack("<I", uptime_us & 0xFFFF_FFFF), [], 0
        for number, (name, count) in enumerate(zip(self._names, self._counts, strict=True), 1):
            sent.append(message(number, stamp + _payload(name, values[at : at + count], device.cycle)))
            at += count
        return sent

    def kind_of(self, identifier: int, payload: bytes) -> str:
        return super().kind_of(identifier, payload) if identifier else f"sensor{payload[2]}"

    def answer(self, device: Device, command: bytes, now_ns: int) -> bytes:
        target, number = command[2:4]
        if functools.reduce(operator.xor, command):
            return message(0xFE, bytes([_BAD_CHECKSUM]))
        if target > len(self._counts) or (target and number != 0xD0):
            return message(0xFE, bytes([_NO_SUCH_SENSOR]))
        if number == 0xC0:
            lengths = [
                len(_payload(name, [0] * count, 0)) for name, count in zip(self._names, self._counts, strict=True)
            ]
            kinds = [_TYPE + list(_KNOWN).index(name) for name in self._names]
            each = b"".join(struct.pack("<HH", *pair) for pair in zip(kinds, lengths, strict=True))
            return message(0, bytes((1, _DEVICE, len(self._counts))) + each)
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


def _payload(name: Name, values: Sequence[int], cycle: int) -> bytes:
    if name == "tactile_module_16x16_v2":
        words = [0] * 256
        for taxel, value in enumerate(values):
            row, column = divmod(taxel, 16)
            channel = 4 * (row // 4) + column // 4
            words[16 * _MYRMEX[row % 4][column % 4] + channel] = channel << 12 | value
        return struct.pack("<256H", *words)
    if name == "iobject_myrmex":
        channel = cycle % 16
        converters = [n for pair in zip(range(30), range(30, 60), strict=True) for n in pair]
        return struct.pack("<60H", *(channel << 12 | values[16 * n + channel] for n in converters))
    if name.startswith("tactile_glove"):
        return b"".join(struct.pack("<BH", number, 4095 - value) for number, value in enumerate(values))
    return np.array(values, _KNOWN[name].dtype).tobytes()


def _total(command: bytes) -> int:
    if len(command) < 4 or command[3] != 0xD0:
        return 5 if len(command) >= 4 else 0
    each = 1 if command[2] else 3  # to a sensor, its period; to the device, numbers of sensors and periods
    return 7 + each * int.from_bytes(command[4:6], "little") if len(command) >= 6 else 0
