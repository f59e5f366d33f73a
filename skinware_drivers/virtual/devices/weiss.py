"""Emulated devices of Weiss Robotics: a WTS tactile sensor, and a DSACON32m with the six matrices of a hand SDH.

Source: the programs wts_driver and wts_ft, and the makers' SDHLibrary; the vectors in tests/serial/test_weiss_wts.py
and test_weiss_dsa.py.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Annotated

from msgspec import Meta

from skinware_drivers.virtual import (
    Device,
    Places,
    SerialEmulator,
    SerialEmulatorOptions,
    cut_packets,
    on_a_grid,
    on_pads,
)

BEGIN = b"\xaa\xaa\xaa"
_REPORTS = {0x38: b"WTS", 0x50: struct.pack("<BBHI", 1, 1, 0x1000, 4711), 0x52: b"emulated"}
"""Answers about the kind of sensor, the module (firmware 1.0.0) and its tag."""
_SINGLE = 0x20
_NEEDED = {_SINGLE: 1, 0x21: 3, 0x22: 0, 0x23: 0, 0x30: 0, 0x46: 0, **dict.fromkeys(_REPORTS, 0)}  # bytes of arguments
_OK, _BAD_CHECKSUM, _TOO_SHORT, _UNKNOWN = 0, 11, 13, 14


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
        bare_when_empty: a command without payload has no checksum.
    """

    def size(part: bytes) -> int:
        if len(part) < 6:
            return 0
        length = int.from_bytes(part[4:6], "little")
        return 8 + length if length or not bare_when_empty else 6

    return cut_packets(heard, BEGIN, size)


def message(command: int, payload: bytes) -> bytes:
    head = BEGIN + struct.pack("<BH", command, len(payload)) + payload
    return head + struct.pack("<H", crc(head))


class EmulatedWeissWtsOptions(SerialEmulatorOptions, frozen=True):
    columns: Annotated[int, Meta(ge=1, le=32, description="cells in a row")] = 4
    rows: Annotated[int, Meta(ge=1, le=32, description="rows of cells")] = 8


class EmulatedWeissWts(SerialEmulator[EmulatedWeissWtsOptions]):
    full_scale = 4095
    swing = 3500

    def places(self) -> Places:
        return on_a_grid(self.options.columns * self.options.rows, self.options.columns)

    def cut(self, heard: bytes) -> tuple[list[bytes], bytes]:
        return cut_commands(heard)

    def answer(self, device: Device, command: bytes, now_ns: int) -> bytes:
        status, answer = self._do(device, command, now_ns)
        if command[3] == _SINGLE and not status:
            device.memory["asked"] = True
            self.burst(device, now_ns)
            return b""
        return message(command[3], struct.pack("<H", status) + answer)

    def messages(self, device: Device, values: Sequence[int]) -> Sequence[bytes]:
        """Return one message with all cells, without run lengths."""
        uptime_ms = (device.sampled_ns - device.ready_ns) // 1_000_000
        header = struct.pack("<IB", uptime_ms & 0xFFFF_FFFF, 0)
        if device.memory.pop("tare", False):
            device.memory["zero"] = list(values)
        zero = device.memory.get("zero", [0] * len(values))
        cells = [max(0, value - at_rest) for value, at_rest in zip(values, zero, strict=True)]
        data = header + struct.pack(f"<{len(cells)}H", *cells)
        if device.memory.pop("asked", False):
            return [message(_SINGLE, struct.pack("<H", _OK) + data)]
        return [message(0x00, data)]

    def _do(self, device: Device, command: bytes, now_ns: int) -> tuple[int, bytes]:
        number, arguments = command[3], command[6:-2]
        if crc(command[:-2]) != int.from_bytes(command[-2:], "little"):
            return _BAD_CHECKSUM, b""
        if number not in _NEEDED:
            return _UNKNOWN, b""
        if len(arguments) < _NEEDED[number]:
            return _TOO_SHORT, b""
        if number == 0x30:
            return _OK, struct.pack("<5H", self.options.columns, self.options.rows, 340, 340, self.full_scale)
        if number == 0x46:
            return _OK, struct.pack("<h", 253)
        if number in (_SINGLE, *_REPORTS):
            return _OK, _REPORTS.get(number, b"")
        if number == 0x23:
            device.memory["tare"] = True
        elif number == 0x22:
            self.stop(device)
        else:
            self.stop(device)
            self.start(device, now_ns, max(1, struct.unpack_from("<H", arguments, 1)[0]) / 1e3)
        return _OK, b""


_WRONG = 1


def dsa_message(command: int, payload: bytes) -> bytes:
    """Return a message on the line; without payload it has no checksum."""
    body = struct.pack("<BH", command, len(payload)) + payload
    return BEGIN + body + (struct.pack("<H", crc(body)) if payload else b"")


class EmulatedWeissDsaOptions(SerialEmulatorOptions, frozen=True):
    fingers: Annotated[int, Meta(ge=1, le=3, description="fingers, of two matrices each")] = 3
    period_ms: Annotated[float, Meta(ge=10, le=1000, description="time between two frames, ms")] = 100


class EmulatedWeissDsa(SerialEmulator[EmulatedWeissDsaOptions]):
    full_scale = 4095
    swing = 3500

    def places(self) -> Places:
        return on_pads(*[(6 * rows, 6) for rows in self._rows])

    def cut(self, heard: bytes) -> tuple[list[bytes], bytes]:
        return cut_commands(heard, bare_when_empty=True)

    def answer(self, device: Device, command: bytes, now_ns: int) -> bytes | None:
        number, arguments = command[3], command[6:-2]
        if arguments and crc(command[3:-2]) != int.from_bytes(command[-2:], "little"):
            return dsa_message(number, struct.pack("<H", _WRONG))
        if number == 0x01:
            return dsa_message(number, struct.pack("<HIBHBBBBIH", _OK, 4711, 2, 300, 0, 0, 0, 0, 0, 0)[:18])
        if number == 0x02:
            return dsa_message(number, struct.pack("<HHHBIB", _OK, len(self._rows), 0, 1, 42, 0))
        if number == 0x0B and len(arguments) == 1 and arguments[0] < len(self._rows):
            matrix = struct.pack("<HffHH6s2sB", _OK, 3.4, 3.4, 6, self._rows[arguments[0]], b"ABCDEF", b"", 1)
            return dsa_message(number, matrix + struct.pack("<7fB", 0, 0, 0, 0, 0, 0, 4095, 0))
        if number == 0x03 and len(arguments) == 3:
            self.stop(device)
            device.memory["runs"] = bool(arguments[0] & 1)
            if arguments[0] & 0x80 and any(arguments[1:]):
                self.start(device, now_ns)
            self.say(device, dsa_message(number, struct.pack("<H", _OK)), now_ns)
            if arguments[0] & 0x80 and not any(arguments[1:]):
                self.burst(device, now_ns)  # a single frame, as the maker's program asks for it
            return b""
        return None

    def messages(self, device: Device, values: Sequence[int]) -> Sequence[bytes]:
        uptime_ms = (device.sampled_ns - device.ready_ns) // 1_000_000 & 0xFFFF_FFFF
        if not device.memory.get("runs"):
            return [dsa_message(0x00, struct.pack(f"<IB{len(values)}H", uptime_ms, 0, *values))]
        units: list[list[int]] = []
        for value in values:
            if units and units[-1][1] == value and units[-1][0] < 15:
                units[-1][0] += 1
            else:
                units.append([1, value])
        coded = [times << 12 | value for times, value in units]
        return [dsa_message(0x00, struct.pack(f"<IB{len(coded)}H", uptime_ms, 1, *coded))]

    @property
    def _rows(self) -> list[int]:
        """Rows of each matrix: those near the palm are longer."""
        return [14, 13] * self.options.fingers
