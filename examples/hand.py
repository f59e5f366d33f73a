"""A hand of five fingers on one RS-485 line, which only answer: skin-driver --driver ./hand.py --bus virtual."""

from collections.abc import Sequence

import numpy as np

from skinware.sensor_types import PRESSURE
from skinware_drivers import Bits, Frame, Layout, Match, Module, NoOptions, Patch, Poll, Values, taxels
from skinware_drivers.serial import SUM8, Field, Packet, SerialAdapter
from skinware_drivers.virtual import Device, SerialEmulator, SerialEmulatorOptions, cut_packets, on_a_grid

FINGERS = (1, 2, 3, 4, 5)
READ = b"\x04"


class HandDriver(SerialAdapter[NoOptions]):
    framing = Packet(sync=(0xA5,), identifier=Field(1), length=15, checksum=SUM8)  # answers
    commands = Packet(sync=(0xA5,), identifier=Field(1), length=4, checksum=SUM8)  # questions
    baudrate = 1_000_000
    types = (PRESSURE.measured(unit="counts", maximum=4095),)
    dtype = np.uint16
    period_s = 0.02
    layout = Layout([Frame("pressures", length=[12], values=Values(0, "<u2", 6), patch=Bits(0, 3))])
    patches = tuple(Patch(f"finger {n}", [Module(taxels(6, first_uid=n << 8))], key=n) for n in FINGERS)

    @property
    def polls(self) -> Sequence[Poll]:
        return [Poll(n, READ, self.period_s, answer=Match(n), timeout_s=0.003) for n in FINGERS]


class EmulatedHand(SerialEmulator[SerialEmulatorOptions]):
    full_scale = 4095
    swing = 3000
    numbers = (1, 2, 3, 4, 5)

    def places(self):
        return on_a_grid(6, columns=2)

    def cut(self, heard: bytes) -> tuple[list[bytes], bytes]:
        return cut_packets(heard, b"\xa5", lambda _: 4)

    def answer(self, device: Device, command: bytes, now_ns: int) -> bytes | None:
        if command != packet(bytes([device.number, 4])):
            return None  # for another finger
        self.burst(device, now_ns)
        return b""  # nothing except the data

    def messages(self, device: Device, values: Sequence[int]) -> Sequence[bytes]:
        return [packet(bytes([device.number]) + np.array(values, "<u2").tobytes())]


def packet(data: bytes) -> bytes:
    return b"\xa5" + data + bytes([(0xA5 + sum(data)) % 256])
