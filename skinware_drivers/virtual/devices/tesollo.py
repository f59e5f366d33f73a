"""An emulated hand of Tesollo on a TCP connection.

Source: the maker's program dg_tcp_comm; the vectors in tests/streams/test_tesollo.py.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Annotated, Literal, NamedTuple

from msgspec import Meta

from skinware_drivers.virtual import Device, Places, SerialEmulator, SerialEmulatorOptions, cut_packets, on_pads

_MOTORS_AND_FINGERS = {"1f": (3, 1), "2f": (6, 2), "3f": (12, 3), "4f": (18, 4), "5f": (20, 5), "5f15": (15, 5)}


class _Tips(NamedTuple):
    kind: int  # number on the wire
    n_values: int
    form: str


_TIPS = {
    "tactile_m": _Tips(3, 15, ">15B"),
    "tactile_s": _Tips(5, 18, ">18H"),
    "six_axes": _Tips(1, 6, ">6h"),
    "four_axes": _Tips(4, 4, ">3h4xh"),
}
_MODEL = {"1f": 0x1F02, "2f": 0x2F03, "3f": 0x3F02, "4f": 0x4F02, "5f": 0x5F22, "5f15": 0x5F44}


class EmulatedTesolloOptions(SerialEmulatorOptions, frozen=True):
    hand: Annotated[Literal["1f", "2f", "3f", "4f", "5f", "5f15"], Meta(description="model")] = "5f"
    tips: Annotated[Literal["tactile_m", "tactile_s", "six_axes", "four_axes"], Meta(description="kind of sensors")] = (
        "tactile_m"
    )
    fitted: Annotated[int, Meta(ge=1, le=31, description="fingers that have one, as bits")] = 31
    pads: Annotated[bool, Meta(description="send zeros for fingers that have none")] = False
    old: Annotated[bool, Meta(description="firmware that does not report its sensors")] = False


class EmulatedTesollo(SerialEmulator[EmulatedTesolloOptions]):
    full_scale = 250
    swing = 220
    speed_mbit_s = 100
    streams = "never"

    def places(self) -> Places:
        count = _TIPS[self.options.tips].n_values
        return on_pads(*[(count, max(1, count // 3))] * len(self._fitted))

    def cut(self, heard: bytes) -> tuple[list[bytes], bytes]:
        return cut_packets(heard, b"\0", lambda part: max(3, part[1]) if len(part) > 1 else 0)

    def answer(self, device: Device, command: bytes, now_ns: int) -> bytes | None:
        if command[2] == 8:
            about = struct.pack(">BHBB", 8, _MODEL[self.options.hand], 1, 5)
            if not self.options.old:
                about += bytes([_TIPS[self.options.tips].kind, self.options.fitted])
            return struct.pack(">H", 2 + len(about)) + about
        if command[2] == 1 and not {1, 5}.isdisjoint(command[3:]):
            device.memory["asked"] = command[3:]
            self.burst(device, now_ns)
            return b""
        if command[2] == 11:
            device.memory["offset"] = True
            return b""
        return None

    def messages(self, device: Device, values: Sequence[int]) -> Sequence[bytes]:
        motors, _ = _MOTORS_AND_FINGERS[self.options.hand]
        body = b""
        if 1 in device.memory["asked"]:
            body += b"".join(struct.pack(">BhhhB", motor + 1, 10 * motor, -motor, 305, 0) for motor in range(motors))
        sent, tips = iter(values), _TIPS[self.options.tips]
        for finger in range(_MOTORS_AND_FINGERS[self.options.hand][1] if 5 in device.memory["asked"] else 0):
            if finger in self._fitted:
                body += struct.pack(tips.form, *[next(sent) for _ in range(tips.n_values)])
            elif self.options.pads:
                body += bytes(struct.calcsize(tips.form))
        if 6 in device.memory["asked"]:
            body += bytes(4)
        return [struct.pack(">HB", len(body) + 3, 1) + body]

    @property
    def _fitted(self) -> list[int]:
        _, fingers = _MOTORS_AND_FINGERS[self.options.hand]
        return [finger for finger in range(fingers) if self.options.fitted & 1 << finger]
