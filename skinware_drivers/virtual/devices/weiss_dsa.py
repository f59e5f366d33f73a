"""An emulated DSACON32m with the six matrices of a hand SDH.

Source: the makers' SDHLibrary; the vectors in tests/serial/test_weiss_dsa.py.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Annotated

from msgspec import Meta

from skinware_drivers.virtual import Device, Places, SerialEmulator, SerialEmulatorOptions, on_pads
from skinware_drivers.virtual.devices.weiss_wts import BEGIN, crc, cut_commands

_OK, _WRONG = 0, 1


def message(command: int, payload: bytes) -> bytes:
    """Return a message on the line; without payload it has no checksum."""
    body = struct.pack("<BH", command, len(payload)) + payload
    return BEGIN + body + (struct.pack("<H", crc(body)) if payload else b"")


class EmulatedWeissDsaOptions(SerialEmulatorOptions, frozen=True, forbid_unknown_fields=True, kw_only=True):
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
            return message(number, struct.pack("<H", _WRONG))
        if number == 0x01:
            return message(number, struct.pack("<HIBHBBBBIH", _OK, 4711, 2, 300, 0, 0, 0, 0, 0, 0)[:18])
        if number == 0x02:
            return message(number, struct.pack("<HHHBIB", _OK, len(self._rows), 0, 1, 42, 0))
        if number == 0x0B and len(arguments) == 1 and arguments[0] < len(self._rows):
            matrix = struct.pack("<HffHH6s2sB", _OK, 3.4, 3.4, 6, self._rows[arguments[0]], b"ABCDEF", b"", 1)
            return message(number, matrix + struct.pack("<7fB", 0, 0, 0, 0, 0, 0, 4095, 0))
        if number == 0x03 and len(arguments) == 3:
            self.stop(device)
            device.memory["runs"] = bool(arguments[0] & 1)
            if arguments[0] & 0x80 and any(arguments[1:]):
                self.start(device, now_ns)
            self.say(device, message(number, struct.pack("<H", _OK)), now_ns)
            if arguments[0] & 0x80 and not any(arguments[1:]):
                self.burst(device, now_ns)  # a single frame, as the maker's program asks for it
            return b""
        return None

    def kind_of(self, identifier: int, payload: bytes) -> str:  # noqa: ARG002
        return "answer" if payload[3] else "data"

    def messages(self, device: Device, values: Sequence[int]) -> Sequence[bytes]:
        uptime_ms = (device.sampled_ns - device.ready_ns) // 1_000_000 & 0xFFFF_FFFF
        if not device.memory.get("runs"):
            return [message(0x00, struct.pack(f"<IB{len(values)}H", uptime_ms, 0, *values))]
        units: list[list[int]] = []
        for value in values:
            if units and units[-1][1] == value and units[-1][0] < 15:
                units[-1][0] += 1
            else:
                units.append([1, value])
        coded = [times << 12 | value for times, value in units]
        return [message(0x00, struct.pack(f"<IB{len(coded)}H", uptime_ms, 1, *coded))]

    @property
    def _rows(self) -> list[int]:
        """Rows of each matrix: those near the palm are longer."""
        return [14, 13] * self.options.fingers
