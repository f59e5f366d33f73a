"""The touch of emulated LinkerHands: questions and answers have one identifier.

Sources: linkerhand-python-sdk, linkerhand-ros2-sdk. It is assumed that a hand samples all its parts when the first one
is asked for. With ``program_ms``, a program on the same bus asks for all of them in turn, and moves the fingers.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from typing import Annotated, Any, Literal

import numpy as np
from msgspec import Meta

from skinware_drivers.virtual import CanFrame, Device, Emulator, EmulatorOptions, Places, on_pads

_SIZES = {"12x6": (12, 6), "10x4": (10, 4)}
_OF_HAND = {"hand_23x9": ((23, 9), (28, 20)), "hand_12x6": ((12, 6), (14, 16))}
_FIRST = {"fingers": 0x20, "fingers_90": 0x90}
_KINDS = {"12x6": 2, "10x4": 3, "fingers": 1, "fingers_90": 1, "hand_23x9": 5, "hand_12x6": 7}
_SERIAL = "LHL10-010-014-{}-B-1-A"
_FELT, _WANTED = "felt", "wanted"  # in the memory of a device


class EmulatedLinkerHandOptions(EmulatorOptions, frozen=True):
    hands: Annotated[tuple[int, ...], Meta(description="identifiers of the hands")] = (0x27,)
    touch: Annotated[
        Literal["12x6", "10x4", "fingers", "fingers_90", "hand_23x9", "hand_12x6"],
        Meta(description="matrices, values of each finger, or matrices of the whole hand"),
    ] = "12x6"
    palm: Annotated[bool, Meta(description="the palm has a matrix, too")] = False
    program_ms: Annotated[
        int, Meta(ge=0, description="time between two rounds of questions of the hands' own program, ms; 0: it is off")
    ] = 50
    mute: Annotated[tuple[int, ...], Meta(description="commands that are ignored, as by hands without them")] = ()


class EmulatedLinkerHand(Emulator[EmulatedLinkerHandOptions]):
    """Hands on one bus.

    Values: row by row, from the thumb to the little finger and the palm; or normal force of all fingers, tangential
    force of all, direction, proximity.
    """

    full_scale = 255
    swing = 200
    longest_queue = 1024
    period_s = 0.05
    numbered_by = "hands"

    def __init__(self, options: EmulatedLinkerHandOptions, **more: Any) -> None:
        self.identifiers: Collection[int] = frozenset(options.hands)
        super().__init__(options, **more)
        if options.program_ms:
            self.period_s = options.program_ms / 1e3

    def places(self) -> Places:
        if self.options.touch in _FIRST:
            return np.tile(on_pads(*[(1, 1)] * 5), (4, 1))
        return on_pads(*[(rows * columns, columns) for rows, columns in map(self._size, self._commands)])

    def boot(self, device: Device, now_ns: int) -> None:
        if self.options.program_ms or self.options.streaming:
            self.start(device, now_ns)

    def obey(self, device: Device, identifier: int, payload: bytes, now_ns: int) -> bool:
        """Answer a question; ignore unknown ones."""
        if identifier != device.number or not payload or payload[0] in self.options.mute:
            return False
        if payload == b"\xb0":
            self.reply(device, (identifier, bytes([0xB0, _KINDS[self.options.touch]])), now_ns)
        elif payload == b"\xc0":
            serial = _SERIAL.format("R" if identifier == 0x27 else "L").encode()
            for at in range(0, len(serial), 6):
                self.reply(device, (identifier, bytes([0xC0, at // 6]) + serial[at : at + 6]), now_ns)
        elif payload == self._question(payload[0]):
            if payload[0] == self._commands[0] or _FELT not in device.memory:
                device.memory[_WANTED] = payload[0]
                self.burst(device, now_ns)
            else:
                for frame in self._answers(device, payload[0]):
                    self.reply(device, frame, now_ns)
        else:
            return False
        return True

    def kind_of(self, identifier: int, payload: bytes) -> str:  # noqa: ARG002
        """Name answers by their command: ``0xb1``; the program's own frames have another kind."""
        return "question" if payload == self._question(payload[0]) else f"0x{payload[0]:02x}"

    def kinds(self) -> Sequence[str]:
        return [f"0x{command:02x}" for command in self._commands]

    def frames(self, device: Device, values: Sequence[int]) -> Sequence[CanFrame]:
        """Return the answer to a question; or a round of the program's questions, with answers and a movement."""
        device.memory[_FELT] = values
        if (wanted := device.memory.pop(_WANTED, None)) is not None:
            return list(self._answers(device, wanted))
        sent: list[CanFrame] = []
        for command in self._commands:
            sent += [(device.number, self._question(command)), *self._answers(device, command)]
        return [
            *sent,
            (device.number, bytes.fromhex("01FF80FF10FF20")),
            (device.number, bytes.fromhex("01FE81FE11FE21")),
        ]

    @property
    def _commands(self) -> Sequence[int]:
        if self.options.touch in _FIRST:
            return range(_FIRST[self.options.touch], _FIRST[self.options.touch] + 4)
        return range(0xB1, 0xB7 if self.options.palm else 0xB6)

    def _question(self, command: int) -> bytes:
        if command not in self._commands:
            return b""
        if self.options.touch in _OF_HAND:
            return bytes([command, *self._size(command), 1])
        sizes = {"12x6": "C6", "10x4": "A4"}
        return bytes([command]) + bytes.fromhex(sizes.get(self.options.touch, ""))

    def _size(self, command: int) -> tuple[int, int]:
        if self.options.touch in _OF_HAND:
            return _OF_HAND[self.options.touch][command == 0xB6]
        return _SIZES[self.options.touch]

    def _answers(self, device: Device, command: int) -> Iterator[CanFrame]:
        nth, values = command - self._commands[0], device.memory[_FELT]
        if self.options.touch in _FIRST:
            yield device.number, bytes([command, *values[5 * nth : 5 * nth + 5]])
            return
        rows, columns = self._size(command)
        before = sum(r * c for r, c in map(self._size, self._commands[:nth]))
        matrix = values[before : before + rows * columns]
        if self.options.touch in _SIZES:
            for row in range(rows):
                yield device.number, bytes([command, 16 * row, *matrix[row * columns : row * columns + columns]])
            return
        for at in range(0, len(matrix), 5):
            yield device.number, bytes([command, at // columns, at % columns, *matrix[at : at + 5]])
        yield device.number, bytes([command, 0xFF]) + (sum(matrix) & 0xFFFF).to_bytes(2, "little")
