"""An emulated device of the AGNI serial protocol: its bytes on the line.

Source: agni_serial_protocol, ``serial_protocol_defines.h`` (BSD); the vectors in tests/serial/test_agni.py.
"""

from __future__ import annotations

import functools
import operator
import struct
from collections.abc import Sequence
from typing import Annotated

import numpy as np
import numpy.typing as npt
from msgspec import Meta

from skinware_drivers.virtual.commands import cut
from skinware_drivers.virtual.emulator import CanFrame, Device, Emulator, EmulatorOptions, on_a_grid

_DEVICE, _TYPE = 7, 0x0203
_BAD_CHECKSUM, _UNKNOWN, _NO_SUCH_SENSOR = 0xF0, 0xF1, 0xF2


def message(number: int, body: bytes) -> bytes:
    """A message as it goes over the line."""
    sent = bytes((0xF0, 0xC4, number)) + body
    return sent + bytes([functools.reduce(operator.xor, sent)])


class EmulatedAgniOptions(EmulatorOptions, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What the device is."""

    sensors: Annotated[tuple[int, ...], Meta(description="number of values of each sensor")] = (16, 4)
    period_ms: Annotated[int, Meta(ge=1, le=65_535, description="unless it is told another")] = 10


class EmulatedAgni(Emulator[EmulatedAgniOptions]):
    """One device, number 1; see :class:`skinware_drivers.virtual.emulator.Emulator`.

    Values: uint16, those of sensor 1, of sensor 2 ... Its time is in microseconds.

    Attributes:
        payload_size: longest message.
    """

    full_scale = 4095
    swing = 3500
    numbers: Sequence[int] = (1,)
    payload_size = 4104

    def places(self) -> npt.NDArray[np.float64]:
        """All values."""
        return on_a_grid(sum(self.options.sensors), 4)

    def obey(self, device: Device, identifier: int, payload: bytes, now_ns: int) -> bool:  # noqa: ARG002
        """Obey every command that the bytes complete."""
        heard = device.memory.get("heard", b"") + payload
        commands, device.memory["heard"] = cut(heard, b"\xf0\xc4", _total)
        for command in commands:
            answer = self._do(device, command, now_ns)
            if answer:
                self.reply(device, (0, answer), now_ns)
        return bool(commands)

    def burst(self, device: Device, time_ns: int) -> None:
        """Messages tell the time since power-up."""
        device.memory["us"] = (time_ns - device.ready_ns) // 1000
        super().burst(device, time_ns)

    def frames(self, device: Device, values: Sequence[int]) -> Sequence[CanFrame]:
        """A message for each sensor."""
        stamp, sent, at = struct.pack("<I", device.memory["us"] & 0xFFFF_FFFF), [], 0
        for number, count in enumerate(self.options.sensors, 1):
            sent.append((0, message(number, stamp + struct.pack(f"<{count}H", *values[at : at + count]))))
            at += count
        return sent

    def _do(self, device: Device, command: bytes, now_ns: int) -> bytes:
        target, number = command[2:4]
        if functools.reduce(operator.xor, command):
            return message(0xFE, bytes([_BAD_CHECKSUM]))
        if target:
            return message(0xFE, bytes([_NO_SUCH_SENSOR]))
        if number == 0xC0:
            each = b"".join(struct.pack("<HH", _TYPE, 2 * count) for count in self.options.sensors)
            return message(0, bytes((1, _DEVICE, len(self.options.sensors))) + each)
        if number == 0xF0:
            return message(0xF0, b"")
        if number == 0x00:
            self.stop(device)
        elif number == 0xF1:
            self.start(device, now_ns, device.memory.get("ms", self.options.period_ms) / 1e3)
        elif number == 0xD0:
            device.memory["ms"] = max(1, int.from_bytes(command[7:9], "little"))
            if device.streams_from_ns is not None:
                self.stop(device)
                self.start(device, now_ns, device.memory["ms"] / 1e3)
        else:
            return message(0xFE, bytes([_UNKNOWN]))
        return b""


def _total(command: bytes) -> int:
    if len(command) < 4 or command[3] != 0xD0:
        return 5 if len(command) >= 4 else 0
    return 7 + 3 * int.from_bytes(command[4:6], "little") if len(command) >= 6 else 0
