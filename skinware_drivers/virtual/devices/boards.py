"""Emulated boards with sensors of one kind, most of them with open firmware.

* AnySkin, a CPM finger with CySkin technology, and FlexiTac or 3D-ViTac send from power-up on, and hear nothing.
  Sources: ``arduino/5X_binary_burst_stream`` of github.com/raunaqbhirangi/anyskin; can2wifi2ros
  ``arduino_can2wifi/arduino_can2wifi.ino``; ``32_16_fast.ino`` of FlexiTac/FlexiTac_Hardware_Repo, and for the text
  ``MatrixArray.ino`` of binghao-huang/3D-ViTac_Tactile_Hardware. A real FlexiTac sends the next marker right after a
  frame; this one sends it a period later, so that a frame is known to be whole only then.
* Patches for skintalk are silent until '1', then send a record for every cell, until '0'; an OctoCan3 takes 'X' and
  'S'. Sources: ``skintalk.c`` of github.com/t173/skinvis, ``main.c`` of github.com/t173/octocan3.
* Devices of the AGNI serial protocol. Source: agni_serial_protocol, ``serial_protocol_defines.h`` (BSD); the vectors in
  tests/serial/test_agni.py.
* Fingertips TSF-85 of Robotiq, both on one line. Source: the maker's package ``pyrobotiqtactile``, which reads them in
  tests/serial/test_robotiq_tsf.py.
"""

from __future__ import annotations

import functools
import operator
import struct
from collections.abc import Collection, Sequence
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from msgspec import Meta

from skinware_drivers.virtual import (
    CanFrame,
    Device,
    Emulator,
    EmulatorOptions,
    Places,
    SerialEmulator,
    SerialEmulatorOptions,
    cut_packets,
    on_a_grid,
    on_pads,
)


class EmulatedAnySkinOptions(SerialEmulatorOptions, frozen=True, forbid_unknown_fields=True, kw_only=True):
    mags: Annotated[int, Meta(ge=1, le=64, description="magnetometers of the board")] = 5


class EmulatedAnySkin(SerialEmulator[EmulatedAnySkinOptions]):
    """One board, device 1.

    Values: temperature, x, y and z of magnetometer 0, of magnetometer 1 ... in degrees Celsius and microtesla.
    """

    full_scale = 50_000
    lowest = -50_000
    rest = 25
    swing = 400
    streams = "always"

    def places(self) -> Places:
        return on_a_grid(self.options.mags, self.options.mags, each=4)

    def messages(self, device: Device, values: Sequence[int]) -> Sequence[bytes]:  # noqa: ARG002
        return [struct.pack(f"<{len(values)}f", *values) + b"\r\n"]


_SENT_AS = [13, 15, 12, 14, 10, 11, 8, 9, 6, 4, 7, 0, 3, 5, 2, 1]
"""Position of taxel 0, 1, 2 ... in the sixteen values of a set."""


class EmulatedCyskinCpmOptions(EmulatorOptions, frozen=True, forbid_unknown_fields=True, kw_only=True):
    period_ms: Annotated[int, Meta(ge=1, description="time between two sets, ms")] = 20


class EmulatedCyskinCpm(Emulator[EmulatedCyskinCpmOptions]):
    full_scale = 0xFFFF
    rest = 800
    swing = 6_000
    identifiers: Collection[int] = frozenset((0x405, 0x407, 0x409, 0x40B))
    streams = "always"

    def places(self) -> Places:
        return on_a_grid(16, 4)

    def frames(self, device: Device, values: Sequence[int]) -> Sequence[CanFrame]:  # noqa: ARG002
        wire = [0] * 16
        for taxel, at in enumerate(_SENT_AS):
            wire[at] = values[taxel]
        return [(0x405 + 2 * i, struct.pack("<4H", *wire[4 * i : 4 * i + 4])) for i in range(4)]


class EmulatedFlexiTacOptions(SerialEmulatorOptions, frozen=True, forbid_unknown_fields=True, kw_only=True):
    rows: Annotated[int, Meta(ge=1, le=64, description="rows of the pad")] = 12
    columns: Annotated[int, Meta(ge=1, le=64, description="columns of the pad")] = 32
    firmware: Annotated[Literal["binary", "text"], Meta(description="firmware of the pad")] = "binary"
    broken_rows: Annotated[tuple[int, ...], Meta(description="rows whose cells all read 0")] = ()
    broken_columns: Annotated[tuple[int, ...], Meta(description="columns whose cells all read 0")] = ()


class EmulatedFlexiTac(SerialEmulator[EmulatedFlexiTacOptions]):
    """One pad, device 1.

    Values: one for each cell, row by row.
    """

    full_scale = 255
    rest = 20
    swing = 220
    speed_mbit_s: ClassVar[int] = 2
    streams = "always"

    def __init__(self, options: EmulatedFlexiTacOptions, **more: Any) -> None:
        super().__init__(options, **more)
        self._sound = np.ones((options.rows, options.columns), np.int64)
        self._sound[list(options.broken_rows)] = 0
        self._sound[:, list(options.broken_columns)] = 0

    def places(self) -> Places:
        return on_a_grid(self.options.rows * self.options.columns, self.options.columns)

    def messages(self, device: Device, values: Sequence[int]) -> Sequence[bytes]:  # noqa: ARG002
        cells = np.reshape(values, self._sound.shape) * self._sound
        if self.options.firmware == "binary":
            return [b"\xaa\x55" + cells.astype(np.uint8).tobytes()]
        lines = ["".join(f"{cell} " for cell in row) for row in cells.tolist()]
        return ["\r\n".join([*lines, "", ""]).encode()]


class EmulatedSkintalkOptions(SerialEmulatorOptions, frozen=True, forbid_unknown_fields=True, kw_only=True):
    patches: Annotated[tuple[int, ...], Meta(description="numbers of the patches")] = (1, 2, 3, 4, 5, 6, 7, 8)
    cells: Annotated[int, Meta(ge=1, le=16, description="cells of each patch")] = 16
    firmware: Annotated[Literal["octocan", "octocan3"], Meta(description="whose commands are obeyed")] = "octocan"
    period_ms: Annotated[float, Meta(ge=0.1, description="time between two records of a cell, ms")] = 20


class EmulatedSkintalk(SerialEmulator[EmulatedSkintalkOptions]):
    """Patches on one line.

    Values: one for each cell.
    """

    full_scale = 0x7F_FFFF
    lowest = -0x80_0000
    rest = 50_000
    swing = 2_000_000
    numbered_by = "patches"

    @property
    def _commands(self) -> dict[bytes, bytes]:
        """Answer to each command."""
        if self.options.firmware == "octocan":
            return {b"1": b"", b"0": b""}
        return {b"X": b"Logging\r\n", b"S": b"STOPPING\r\n", b"C": b"Calibrating\r\n"}

    def places(self) -> Places:
        return on_a_grid(self.options.cells, 4)

    def cut(self, heard: bytes) -> tuple[list[bytes], bytes]:
        """Cut commands of one byte; other bytes mean nothing."""
        return [bytes([byte]) for byte in heard if bytes([byte]) in self._commands], b""

    def answer(self, device: Device, command: bytes, now_ns: int) -> bytes:
        text = self._commands[command]
        if command in b"1X":
            self.start(device, now_ns)
        elif command in b"0S":
            self.stop(device)
        return text

    def kind_of(self, identifier: int, payload: bytes) -> str:  # noqa: ARG002
        """Name cells by the byte for patch and cell: ``0x13``."""
        return f"0x{payload[1]:02x}"

    def messages(self, device: Device, values: Sequence[int]) -> Sequence[bytes]:
        return [
            bytes((0x55, device.number << 4 | cell)) + struct.pack(">i", value)[1:] for cell, value in enumerate(values)
        ]


_DEVICE, _TYPE = 7, 0x0203
_BAD_CHECKSUM, _UNKNOWN, _NO_SUCH_SENSOR = 0xF0, 0xF1, 0xF2


def message(number: int, body: bytes) -> bytes:
    sent = bytes((0xF0, 0xC4, number)) + body
    return sent + bytes([functools.reduce(operator.xor, sent)])


class EmulatedAgniOptions(SerialEmulatorOptions, frozen=True, forbid_unknown_fields=True, kw_only=True):
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


_FIELDS = {
    "static": (0x10, 0, 28),
    "dynamic": (0x20, 28, 1),
    "accelerometer": (0x30, 29, 3),
    "gyroscope": (0x40, 32, 3),
    "magnetometer": (0x50, 35, 3),
    "temperature": (0x60, 38, 1),
}
_VERSION = bytes.fromhex("010203")


class EmulatedRobotiqTsfOptions(SerialEmulatorOptions, frozen=True, forbid_unknown_fields=True, kw_only=True):
    fingers: Annotated[tuple[int, ...], Meta(description="fingertips: 0, 1")] = (0, 1)
    slow: Annotated[int, Meta(ge=1, description="only every so many packets have magnetometer and temperature")] = 1
    timed: Annotated[bool, Meta(description="send the device's time in microseconds")] = True


class EmulatedRobotiqTsf(SerialEmulator[EmulatedRobotiqTsfOptions]):
    """Two fingertips that send on command; in the bootloader they are silent until they lose their power."""

    full_scale = (65535,) * 28 + (32767,) * 11
    lowest = (0,) * 28 + (-32768,) * 11
    rest = (400,) * 28 + (0,) * 3 + (16384,) + (0,) * 6 + (250,)
    swing = (9000,) * 28 + (800,) + (0,) * 10
    numbered_by = "fingers"

    def places(self) -> Places:
        return np.concatenate([on_a_grid(28, 4), [[0.5, 0.5, 0.0]] * 11])

    def cut(self, heard: bytes) -> tuple[list[bytes], bytes]:
        return cut_packets(heard, b"\x9a\0", lambda part: 4 + part[3] if len(part) > 3 else 0)

    def answer(self, device: Device, command: bytes, now_ns: int) -> bytes | None:
        number, data = command[2], command[4:]
        if device.memory.get("bootloader"):
            return None
        if number == 0xE2:
            self.stop(device)
            device.memory["bootloader"] = True
        elif number == 0xE3:
            return self._packet(number, _VERSION) if device.number == self.numbers[0] else b""
        elif number == 0x61:
            self.burst(device, now_ns)
        elif number in (0x58, 0x59) and data:
            self.stop(device)
            if data[0]:
                self.start(device, now_ns, data[0] / 1e3)
        else:
            return None
        return b""

    def kinds(self) -> Sequence[str]:
        return [f"{name}{finger}" for finger in self.numbers for name in _FIELDS]

    def kind_of(self, identifier: int, payload: bytes) -> str:  # noqa: ARG002
        return "packet"

    def messages(self, device: Device, values: Sequence[int]) -> Sequence[bytes]:
        data = b""
        for name, (kind, first, count) in _FIELDS.items():
            is_due = device.cycle % self.options.slow == 0 or name not in ("magnetometer", "temperature")
            if is_due and f"{name}{device.number}" in self.silent:
                self.counts["silenced"] += 1
            elif is_due:
                form = f">{count}{'H' if name == 'static' else 'h'}"
                data += bytes([kind | device.number << 2]) + struct.pack(form, *values[first : first + count])
        if self.options.timed:
            data += bytes([0x70 | device.number << 2]) + struct.pack(">Q", device.sampled_ns // 1000)
        return [self._packet(0x61, data)]

    @staticmethod
    def _packet(command: int, data: bytes) -> bytes:
        return bytes([0x9A, 0, command, len(data)]) + data
