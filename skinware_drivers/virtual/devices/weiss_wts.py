"""An emulated WTS tactile sensor of Weiss Robotics, and the checksum and commands of that maker.

Source: the programs wts_driver and wts_ft; the vectors in tests/serial/test_weiss_wts.py.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Annotated

from msgspec import Meta

from skinware_drivers.virtual import Device, Places, SerialEmulator, SerialEmulatorOptions, cut_packets, on_a_grid

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


class EmulatedWeissWtsOptions(SerialEmulatorOptions, frozen=True, forbid_unknown_fields=True, kw_only=True):
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

    def kind_of(self, identifier: int, payload: bytes) -> str:  # noqa: ARG002
        return "answer" if payload[3] else "data"

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
