"""The bus ``virtual`` of serial devices, and of programs that make values."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from importlib.metadata import entry_points
from typing import Any

import numpy as np
import pytest

from skinware.errors import BusSendError, ConfigurationError
from skinware_drivers.bus import FrameBatch
from skinware_drivers.registry import DRIVERS, load_driver
from skinware_drivers.serial.packets import Packet
from skinware_drivers.testing.waiting import wait_until
from skinware_drivers.virtual import (
    CanFrame,
    Device,
    SerialEmulator,
    SerialEmulatorOptions,
    cut_packets,
    on_a_grid,
)
from skinware_drivers.virtual.bus import VirtualCanBus, VirtualSerialBus, virtual_bus
from skinware_drivers.virtual.hardware import EMULATORS, load_emulator, medium_of


class Strip(SerialEmulator[SerialEmulatorOptions]):
    """Two bytes behind AA, as soon as it gets a question mark; its values are its own."""

    full_scale = 200
    swing = 100
    period_s = 0.002

    def places(self) -> np.ndarray[Any, np.dtype[np.float64]]:
        return on_a_grid(2, columns=2)

    def cut(self, heard: bytes) -> tuple[list[bytes], bytes]:
        return [b"?"] * heard.count(b"?"), b""

    def answer(self, device: Device, command: bytes, now_ns: int) -> bytes:
        self.start(device, now_ns)
        return b""

    def feel(self, device: Device, time_s: float) -> Sequence[int]:
        return [7, 1000]

    def messages(self, device: Device, values: Sequence[int]) -> Sequence[bytes]:
        return [bytes([0xAA, *values])]


class Long(Strip):
    """A frame of 100 numbers on no wire at all."""

    medium = "virtual"

    def frames(self, device: Device, values: Sequence[int]) -> Sequence[CanFrame]:
        return [(5, struct.pack("<100f", *range(100)))]


def received(bus: VirtualSerialBus | VirtualCanBus, payload_size: int) -> list[tuple[int, bytes]]:
    batch = FrameBatch(100, payload_size)
    wait_until(lambda: bus.receive(batch, 0) > 0)
    return [(int(row["identifier"]), row["payload"][: row["length"]].tobytes()) for row in batch.wire[: batch.stop]]


def test_packets_come_out_of_the_bytes_of_an_emulated_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("skinware_drivers.virtual.bus.load_emulator", lambda _name: Strip)
    bus = virtual_bus("strip", {"seed": "1"}, payload_size=8)
    assert isinstance(bus, VirtualSerialBus)
    bus.use(Packet(sync=(0xAA,), length=3), Packet(length=1, sync=(ord("?"),)))
    assert bus.name == "bus virtual:strip"
    bus.open()
    try:
        bus.send(0, b"")
        assert set(received(bus, 8)) == {(0, bytes([7, 200]))}  # what is felt ends at the full scale
    finally:
        bus.close()
    with pytest.raises(BusSendError, match="not open"):
        bus.send(0, b"")


def test_options_of_the_emulator_are_checked(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("skinware_drivers.virtual.bus.load_emulator", lambda _name: Strip)
    with pytest.raises(ConfigurationError, match="unknown option 'sed'; did you mean 'seed'"):
        virtual_bus("strip", {"sed": "1"})


def test_frames_of_a_program_have_any_length() -> None:
    bus = VirtualCanBus("", hardware=Long(SerialEmulatorOptions(streaming=True)), payload_size=400)
    bus.open()
    try:
        first = received(bus, 400)[0]
    finally:
        bus.close()
    assert first == (5, np.arange(100, dtype="<f4").tobytes())


def test_devices_of_can_are_on_can() -> None:
    assert isinstance(virtual_bus("xela"), VirtualCanBus)
    assert isinstance(virtual_bus(""), VirtualCanBus)


def test_every_driver_has_an_emulator_of_its_medium() -> None:
    names = entry_points(group=EMULATORS).names
    assert len(names) > 10
    for name in entry_points(group=DRIVERS).names:
        assert medium_of(load_emulator(name)) == load_driver(name).medium, name


def test_other_emulators_are_of_a_driver_that_their_names_begin_with() -> None:
    drivers = entry_points(group=DRIVERS).names
    for name in entry_points(group=EMULATORS).names - drivers:
        (driver,) = (load_driver(one) for one in drivers if name.startswith(f"{one}_"))
        assert medium_of(load_emulator(name)) in {one.medium for one in (driver, *driver.elsewhere)}, name


def test_commands_come_in_pieces_behind_garbage() -> None:
    strip = Strip(SerialEmulatorOptions())
    strip.skip(0)
    strip.receive(0, b"??!?", 0)
    assert (strip.totals()["commands"], strip.emit(3_000_000)[0].payload) == (1, bytes([0xAA, 7, 200]))
    whole = b"\xaa\x02\x01\x02"
    for at in range(len(whole) + 1):
        first, rest = cut_packets(b"\0\xaa" + whole[:at], b"\xaa\x02", lambda part: 4 if len(part) >= 3 else 0)
        assert first + cut_packets(rest + whole[at:], b"\xaa\x02", lambda _: 4)[0] == [whole]


def test_nothing_else_hangs_on_a_serial_line() -> None:
    with pytest.raises(ConfigurationError, match="nothing else is attached to a serial line"):
        Strip(SerialEmulatorOptions(foreign_hz=1.0))
