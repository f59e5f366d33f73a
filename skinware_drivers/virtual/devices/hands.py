"""Emulated hands on protocols of their own: Ability Hand, Allegro V5, Barrett's BH280 and Tesollo.

* Ability Hand answers the questions of the maker's programs, and counts their commands to move. Source:
  github.com/psyonicinc/ability-hand-api (``ah_api.py``, ``ah_parser.py``, ``ppp_stuffing.py``).
* Allegro V5 sends by itself, as if its own program had started it. Sources: allegro_hand_ros2_v5,
  allegro_hand_ros2_V5_Sense, allegro_hand_v5_plus_python.
* Pucks of a BH280 answer questions about TACT with data. Source: owd ``openwam/CANbus.cc``. It is assumed that a puck
  does not answer before a format was chosen, and that the answer about a property other than TACT goes to group 6.
* Tesollo's hand is on a TCP connection. Source: the maker's program dg_tcp_comm; the vectors in
  tests/streams/test_tesollo.py.
"""

from __future__ import annotations

import struct
from collections.abc import Collection, Sequence
from typing import Annotated, Literal, NamedTuple

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

_ASKED = "asked"  # in the memory of a device: the command to be answered
_MOVES = "moves"  # commands to move so far
_TARGETS = 12


def message(content: bytes) -> bytes:
    stuffed = bytearray()
    for byte in content + bytes([-sum(content) & 0xFF]):
        stuffed += bytes([0x7D, byte ^ 0x20]) if byte in (0x7E, 0x7D) else bytes([byte])
    return b"~" + bytes(stuffed) + b"~"


class EmulatedAbilityHandOptions(SerialEmulatorOptions, frozen=True, forbid_unknown_fields=True, kw_only=True):
    address: Annotated[int, Meta(ge=0, le=255, description="address of the hand")] = 0x50


class EmulatedAbilityHand(SerialEmulator[EmulatedAbilityHandOptions]):
    """One hand, device 1.

    Values: the sensors of index, middle, ring, little finger and thumb, six each.
    """

    full_scale = 4095
    rest = 300
    swing = 3000
    streams = "never"

    def places(self) -> Places:
        return on_pads(*[(6, 2)] * 5)

    def cut(self, heard: bytes) -> tuple[list[bytes], bytes]:
        *parts, rest = heard.split(b"~")
        return [part for part in parts if part], rest[-64:]

    def answer(self, device: Device, command: bytes, now_ns: int) -> bytes | None:
        content, escaped = bytearray(), False
        for byte in command:
            if byte == 0x7D and not escaped:
                escaped = True
                continue
            content.append(byte ^ 0x20 if escaped else byte)
            escaped = False
        if len(content) < 3 or sum(content) & 0xFF or content[0] != self.options.address:
            return None
        kind, variant = content[1] & 0xF0, content[1] & 0x0F
        size = {0xA0: 0, 0x10: _TARGETS, 0x20: _TARGETS, 0x30: _TARGETS, 0x40: _TARGETS}.get(kind)
        if variant > 2 or len(content) - 3 != size:
            return None
        if size:
            device.memory[_MOVES] = device.memory.get(_MOVES, 0) + 1
        if variant == 2:
            return message(bytes([content[1]]) + bytes(24) + bytes(12) + b"\0")
        device.memory[_ASKED] = content[1]
        self.burst(device, now_ns)
        return b""

    def messages(self, device: Device, values: Sequence[int]) -> Sequence[bytes]:
        """Return the answer: 12 bits of each sensor, the lowest first."""
        bits = sum(value << 12 * number for number, value in enumerate(values))
        positions = bytes(range(24))
        return [message(bytes([device.memory[_ASKED]]) + positions + bits.to_bytes(45, "little") + b"\0")]

    def moves(self) -> int:
        return sum(device.memory.get(_MOVES, 0) for device in self.devices.values())


_JOINTS = 16
_PADS = (1, 1), (3, 1), (4, 1), (4, 1), (4, 1)


class EmulatedAllegroV5Options(EmulatorOptions, frozen=True, forbid_unknown_fields=True, kw_only=True):
    period_ms: Annotated[int, Meta(ge=1, description="time between two messages of a kind, ms")] = 10


class EmulatedAllegroV5(Emulator[EmulatedAllegroV5Options]):
    """One V5 Sense on CAN, device 0.

    Values: the pads in the order of the frames, as bytes.
    """

    full_scale = 254
    swing = 200
    identifiers: Collection[int] = frozenset((0x150, 0x154, 0x3C0, 0x3C8, 0x140, 0x148))
    streams = "always"

    def places(self) -> Places:
        return on_pads(*_PADS)

    def frames(self, device: Device, values: Sequence[int]) -> Sequence[CanFrame]:  # noqa: ARG002
        return [(0x054 << 2, bytes(values[:8])), (0x055 << 2, bytes(values[8:]))]


class EmulatedAllegroV5TipsOptions(EmulatedAllegroV5Options, frozen=True, forbid_unknown_fields=True, kw_only=True):
    air_pa: Annotated[int, Meta(ge=0, description="pressure of an untouched fingertip, Pa")] = 0


class EmulatedAllegroV5Tips(Emulator[EmulatedAllegroV5TipsOptions]):
    """One V5 Plus on CAN, device 0. Values: index, middle, ring finger and thumb, in Pa above those of the air."""

    full_scale = 30_000
    lowest = -1_000
    swing = 4_000
    identifiers: Collection[int] = EmulatedAllegroV5.identifiers
    streams = "always"

    def places(self) -> Places:
        return on_pads(*[(1, 1)] * 4)

    def frames(self, device: Device, values: Sequence[int]) -> Sequence[CanFrame]:  # noqa: ARG002
        pascals = [value + self.options.air_pa for value in values]
        return [(0x0F0 << 2, struct.pack("<2i", *pascals[:2])), (0x0F2 << 2, struct.pack("<2i", *pascals[2:]))]


class EmulatedAllegroV5UdpOptions(SerialEmulatorOptions, frozen=True, forbid_unknown_fields=True, kw_only=True):
    period_ms: Annotated[float, Meta(ge=0.1, description="time between two datagrams, ms")] = 3


class EmulatedAllegroV5Udp(SerialEmulator[EmulatedAllegroV5UdpOptions]):
    """One V5 Sense over UDP, device 1: its messages are datagrams. Values: the pads, in 0.1 kPa."""

    full_scale = 1016
    swing = 800
    speed_mbit_s = 100
    datagrams = True
    streams = "always"

    def places(self) -> Places:
        return on_pads(*_PADS)

    def messages(self, device: Device, values: Sequence[int]) -> Sequence[bytes]:
        number = device.cycle & 0xFFFF_FFFF
        joints = [100 * joint for joint in range(_JOINTS)]
        sample = struct.pack("<I16h16h16H16i", number, *joints, *joints, *values, *joints)
        header = struct.pack(
            "<IBBHII", 0x32423556, 1, 2, len(sample), number, device.sampled_ns // 1_000_000 & 0xFFFF_FFFF
        )
        return [header + sample]


_TACT = 106
_TOP_10, _FULL = 1, 2


class EmulatedBarrettOptions(EmulatorOptions, frozen=True, forbid_unknown_fields=True, kw_only=True):
    nodes: Annotated[tuple[int, ...], Meta(description="nodes of the pucks")] = (11, 12, 13, 14)


class EmulatedBarrett(Emulator[EmulatedBarrettOptions]):
    """Pucks on one bus. Values are in 1/256 N/cm2."""

    full_scale = 0xFFF
    swing = 3_000
    identifiers: Collection[int] = frozenset(range(0x800)) - {
        i for i in range(0x800) if i >> 5 & 31 not in range(11, 15) and i & 0x41F not in (0x405, 11, 12, 13, 14)
    }
    numbered_by = "nodes"

    def places(self) -> Places:
        return on_a_grid(24, 3)

    def boot(self, device: Device, now_ns: int) -> None:  # noqa: ARG002
        """Wait for questions; with ``streaming``, the format is chosen already."""
        if self.options.streaming:
            device.memory["format"] = _FULL

    def obey(self, device: Device, identifier: int, payload: bytes, now_ns: int) -> bool:
        """Obey a command about TACT, or answer a question about another property."""
        if identifier not in (device.number, 0x405) or not payload:
            return False
        number, is_set = payload[0] & 0x7F, payload[0] >= 0x80
        if number != _TACT:
            if is_set:
                return False
            self.reply(device, (device.number << 5 | 0x406, bytes([0x80 + number, 0, 201, 0])), now_ns)
            return True
        if is_set:
            device.memory["format"] = payload[2]
        if device.memory.get("format") not in (_TOP_10, _FULL):
            return is_set
        self.burst(device, now_ns)
        return True

    def kind_of(self, identifier: int, payload: bytes) -> str:
        """Name the frames of all cells by identifier and part: ``0x569-0``."""
        part = f"-{payload[0] >> 4}" if identifier & 0x41F == 0x409 else ""
        return f"{super().kind_of(identifier, payload)}{part}"

    def kinds(self) -> Sequence[str]:
        """Name five frames of all cells, and one of the ten strongest, from each puck."""
        senders = [number << 5 | 0x400 for number in self.numbers]
        whole = [self.kind_of(sender | 9, bytes([part << 4])) for sender in senders for part in range(5)]
        return [*whole, *(self.kind_of(sender | 8, b"") for sender in senders)]

    def frames(self, device: Device, values: Sequence[int]) -> Sequence[CanFrame]:
        sender = device.number << 5 | 0x400
        if device.memory["format"] == _FULL:
            cells = "".join(f"{value:03x}" for value in [*values, 0])
            return [(sender | 9, bytes.fromhex(f"{i:x}{cells[15 * i : 15 * i + 15]}")) for i in range(5)]
        strongest = sorted(sorted(range(24), key=lambda cell: -values[cell])[:10])
        cells = sum(0x800000 >> cell for cell in strongest).to_bytes(3, "big").hex()
        levels = "".join(f"{min(values[cell] >> 8, 15):x}" for cell in strongest)
        return [(sender | 8, bytes.fromhex(cells + levels))]


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


class EmulatedTesolloOptions(SerialEmulatorOptions, frozen=True, forbid_unknown_fields=True, kw_only=True):
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

    def kind_of(self, identifier: int, payload: bytes) -> str:  # noqa: ARG002
        return "data" if payload[2] == 1 else "answer"

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
