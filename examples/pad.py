"""An emulated pad of six taxels on CAN, silent until a command starts it."""

import struct
from collections.abc import Sequence
from typing import Annotated

import msgspec

from skinware_drivers.virtual import CanFrame, Device, Emulator, EmulatorOptions, on_a_grid


class EmulatedPadOptions(EmulatorOptions, frozen=True):
    firmware: Annotated[int, msgspec.Meta(description="the firmware version it answers with", ge=0, le=255)] = 3


class EmulatedPad(Emulator[EmulatedPadOptions]):
    full_scale = 4095  # the greatest value
    rest = 200  # untouched
    swing = 3000  # what a firm press adds
    period_s = 0.01  # from burst to burst
    numbers = (1, 2)  # the devices on the bus
    identifiers = frozenset((0x100, 0x201, 0x202, 0x301, 0x302))  # all that they and their host use

    def places(self):
        return on_a_grid(6, columns=3)  # where each value is felt

    def frames(self, device: Device, values: Sequence[int]) -> Sequence[CanFrame]:
        packed = "".join(f"{value:03x}" for value in values[:4])
        return [
            (0x200 + device.number, bytes.fromhex(packed)),
            (0x300 + device.number, struct.pack(">2H", *values[4:])),
        ]

    def obey(self, device: Device, identifier: int, payload: bytes, now_ns: int) -> bool:
        if identifier != 0x100 or len(payload) != 2 or payload[1] != device.number:
            return False  # not for this one
        if payload[0] == 1:
            self.start(device, now_ns)
        elif payload[0] == 0:
            self.stop(device)
        else:
            self.reply(device, (0x300 + device.number, bytes([self.options.firmware])), now_ns)
        return True
