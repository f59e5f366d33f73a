"""Emulated boards of Paxini's PX-6AX GEN3.

Source: the captured requests and the programs named in docs/drivers/paxini.md; the vectors in
tests/serial/test_paxini.py.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Annotated, Any, Literal

import numpy as np
import numpy.typing as npt
from msgspec import Meta

from skinware_drivers.virtual import Device, Places, SerialEmulator, SerialEmulatorOptions, cut_packets, on_pads

_LONGEST_COMMAND = 64
_NO_COMMAND = 2

Forces = npt.NDArray[np.int64]
"""(n, 3) Fx, Fy and Fz of taxels in 0.1 N."""


def message(*parts: bytes) -> bytes:
    """Return a message on the line: these bytes, and their LRC."""
    sent = b"".join(parts)
    return sent + bytes([-sum(sent) & 0xFF])


class EmulatedPaxiniOptions(SerialEmulatorOptions, frozen=True):
    board: Annotated[
        Literal["converter", "high_speed"], Meta(description="sensors that are asked, or a hand that streams")
    ] = "converter"
    sensors: Annotated[tuple[int, ...], Meta(description="converter: ids of its sensors")] = (3,)
    sensor_version: Annotated[str, Meta(description="converter: version text of its sensors")] = (
        "PAXINI PXSR-STDDP03F-v1.0.5"
    )
    points: Annotated[int, Meta(ge=1, le=255, description="taxels of each sensor, or of each module on a finger")] = 31
    slots: Annotated[tuple[int, ...], Meta(description="high-speed: slots to which a module is connected, 0 to 27")] = (
        *(0, 2, 4, 6, 10, 14, 18),
        *range(20, 23),
    )
    acknowledge: Annotated[
        Literal["reply", "frame", "nothing"],
        Meta(description="high-speed: acknowledgement of the start"),
    ] = "reply"
    error: Annotated[int, Meta(ge=0, le=255, description="high-speed: error code in all its frames")] = 0
    calibrates_s: Annotated[float, Meta(ge=0, le=60, description="high-speed: duration of a calibration, s")] = 1.0
    period_ms: Annotated[float, Meta(ge=1, le=1000, description="high-speed: time between two frames, ms")] = 11


class EmulatedPaxini(SerialEmulator[EmulatedPaxiniOptions]):
    """Sensors behind a converter board, by their ids; or one high-speed board, number 1.

    Values: Fx, Fy, Fz of each taxel, -128 to 127. The byte of Fz means 0 to 255.
    """

    full_scale = 127
    lowest = -128
    swing = 60

    def __init__(self, options: EmulatedPaxiniOptions, **more: Any) -> None:
        if options.board == "converter":
            self.numbers: Sequence[int] = options.sensors
            self.streams = "never"
        super().__init__(options, **more)

    def places(self) -> Places:
        options = self.options
        modules = [options.points] if options.board == "converter" else [self.points_of(slot) for slot in options.slots]
        return on_pads(*[(points, max(1, round(0.85 * points**0.5))) for points in modules], each=3)

    def text(self) -> str:
        return self.options.sensor_version

    def slots(self) -> Sequence[int]:
        return self.options.slots

    def points_of(self, slot: int) -> int:
        """Return the taxels of the module in a slot; those on the palm send at most nine."""
        return self.options.points if slot < 20 else min(9, self.options.points)

    def feel(self, device: Device, time_s: float) -> Sequence[int]:
        felt = list(super().feel(device, time_s))
        felt[0::3] = [value // 4 for value in felt[0::3]]
        felt[1::3] = [-value // 6 for value in felt[1::3]]
        return felt

    def cut(self, heard: bytes) -> tuple[list[bytes], bytes]:
        """Cut by the length of a command, which each board has in another place; ignore those of the other board."""
        return cut_packets(heard, b"\x55\xaa", self._length)

    def answer(self, device: Device, command: bytes, now_ns: int) -> bytes | None:
        if len(command) <= _NO_COMMAND or sum(command) & 0xFF:
            return None
        if self.options.board == "high_speed":
            return self._answer_of_hand(device, command, now_ns)
        return self._answer_of_sensor(device, command, now_ns)

    def messages(self, device: Device, values: Sequence[int]) -> Sequence[bytes]:
        felt = np.array(values).reshape(-1, 3)
        felt[:, 2] &= 0xFF
        if device.memory.pop("tare", False):
            device.memory["zero"] = felt
        forces = _clipped(felt - device.memory.get("zero", 0))
        if self.options.board == "converter":
            address, count = device.memory["asked"]
            memory = _bytes(_resultant(forces)) + bytes(27) + _bytes(forces)  # from address 1008 on
            asked = memory[address - 1008 :][:count].ljust(count, b"\0")
            return [self._reply(device, 0xFB, address, count, status=1, data=asked)]
        modules = np.split(forces, np.cumsum([self.points_of(slot) for slot in self.slots()]))[:-1]
        data = b"".join(_resultant(each).astype("<u2").tobytes() + _bytes(each) for each in modules)
        return [message(b"\xaa\x56\0", struct.pack("<HB", len(data) + 1, self.options.error), data)]

    def _length(self, part: bytes) -> int:
        if self.options.board == "converter":
            if len(part) < 4:
                return 0
            total = 5 + int.from_bytes(part[2:4], "little")
            return total if total <= _LONGEST_COMMAND else _NO_COMMAND
        if len(part) < 8:
            return 0 if len(part) < 3 or not part[2] else _NO_COMMAND
        total = 9 + (int.from_bytes(part[6:8], "little") if part[3] != 0x03 else 0)
        return total if not part[2] and total <= _LONGEST_COMMAND else _NO_COMMAND

    # Sensors behind a converter board

    def _answer_of_sensor(self, device: Device, command: bytes, now_ns: int) -> bytes | None:
        if command[4] != device.number or len(command) < 14:
            return None
        function, (address, count) = command[6], struct.unpack_from("<IH", command, 7)
        if function == 0xFB and address == 6100:
            text = self.text().encode().ljust(count, b"\0")[:count]
            return self._reply(device, 0xFB, address, count, status=1, data=text)
        if function == 0xFB and 1008 <= address < 1038 + 3 * self.options.points:
            device.memory["asked"] = address, count
            self.burst(device, now_ns)
            return b""
        if function == 0x79 and address == 3 and command[13] == 1:
            device.memory["tare"] = True
            return self._reply(device, 0x79, address, count)
        return self._reply(device, 0x7E, address, count, status=2)

    @staticmethod
    def _reply(device: Device, function: int, address: int, count: int, *, status: int = 0, data: bytes = b"") -> bytes:
        head = struct.pack("<BBBIHB", device.number, 0, function, address, count, status)
        return message(b"\xaa\x55", struct.pack("<H", len(head) + len(data)), head, data)

    # A high-speed board

    def _answer_of_hand(self, device: Device, command: bytes, now_ns: int) -> bytes | None:
        function, register, count = struct.unpack_from("<BHH", command, 3)
        data = command[8:-1]
        if function == 0x03:
            memory = bytearray(0x80)
            memory[0:15] = b"EMULATED V1.0\0\0"
            for slot in self.slots():
                memory[0x10 + slot // 8] |= 1 << slot % 8
                at = 0x30 + 2 * slot if slot < 20 else 0x66 + 2 * (slot - 20)
                memory[at : at + 2] = self.options.points.to_bytes(2, "little")
            memory[0x16:0x18] = 3, device.streams_from_ns is not None  # resultants and taxels
            read = bytes(memory[register : register + count])
            return message(b"\xaa\x55\0", command[3:8], read.ljust(count, b"\0"))
        if function == 0x10 and register == 0x17:
            return self._switch(device, bool(data[0]), now_ns)
        if function == 0x17 and register == 0x02:

            def calibrated(time_ns: int) -> None:
                if device.alive:
                    device.memory["tare"] = True
                    self.say(device, message(b"\xaa\x55\0\x17\x02\0\x01\0\0"), time_ns)

            self.schedule(now_ns + round(1e9 * self.options.calibrates_s), calibrated)
            return b""
        return message(b"\xaa\x55\0", struct.pack("<BHH", 0x81, register, 0))

    def _switch(self, device: Device, on: bool, now_ns: int) -> bytes:
        if on:
            self.start(device, now_ns, self.options.period_ms / 1e3)
        else:
            self.stop(device)
        if on and self.options.acknowledge == "frame":
            return message(b"\xaa\x56\0\x01\0\0")
        if on and self.options.acknowledge == "nothing":
            return b""
        return message(b"\xaa\x55\0\x10\x17\0\x01\0\0")


def _clipped(forces: Forces) -> Forces:
    return np.clip(forces, (-128, -128, 0), (127, 127, 255))


def _resultant(forces: Forces) -> Forces:
    return _clipped(forces.sum(axis=0))


def _bytes(forces: Forces) -> bytes:
    return forces.astype(np.uint8).tobytes()
