"""The WTS driver: vectors of the wire, and the driver on a pseudo terminal."""

from __future__ import annotations

from typing import Any

import pytest

from skinware import DriverSnapshot, PatchState
from skinware.errors import ConfigurationError
from skinware_drivers.serial.weiss import WeissWtsDriver, WeissWtsOptions
from skinware_drivers.testing.driving import emulated_skin
from skinware_drivers.virtual.devices.weiss import EmulatedWeissWts, EmulatedWeissWtsOptions, crc, message
from tests.sdk.driving import read_until, restarted_on_demand
from tests.serial.spoken import Spoken

START_10_MS = bytes.fromhex("AA AA AA 21 03 00 00 0A 00 DA B5")
MATRIX = bytes.fromhex("AA AA AA 30 00 00 CA CF")
MS = 1_000_000


def test_bytes_of_commands_are_those_of_the_vectors() -> None:
    assert crc(b"123456789") == 0x6EB4
    framing = WeissWtsDriver.framing
    for wire, command, payload in ((START_10_MS, 0x21, b"\0\x0a\0"), (MATRIX, 0x30, b"")):
        assert framing.encode(command, payload) == wire == message(command, payload)
    assert [frame.body for frame in framing.framer().feed(START_10_MS)] == [b"\0\x0a\0"]


def test_the_emulated_sensor_byte_for_byte() -> None:
    sensor = Spoken(EmulatedWeissWts(EmulatedWeissWtsOptions(columns=2, rows=1, pattern="cycle")))
    assert sensor.answers(MATRIX) == [message(0x30, bytes.fromhex("0000 0200 0100 5401 5401 FF0F"))]
    assert sensor.answers(MATRIX[:-1] + b"\0") == [message(0x30, b"\x0b\0")]
    assert sensor.answers(message(0x77, b"")) == [message(0x77, b"\x0e\0")]
    assert sensor.answers(message(0x21, b"\0")) == [message(0x21, b"\x0d\0")]
    assert sensor.answers(message(0x52, b"")) == [message(0x52, b"\0\0emulated")]
    first, *frames = sensor.answers(START_10_MS, 55)
    assert first == message(0x21, b"\0\0")
    assert len(frames) in (5, 6)
    for cycle, frame in enumerate(frames):
        stamp = frame[6:10]
        assert frame == message(0x00, stamp + b"\0" + cycle.to_bytes(2, "little") * 2)
    assert sensor.answers(message(0x22, b""))[-1] == message(0x22, b"\0\0")
    assert sensor.answers(b"", 100) == []
    [single] = sensor.answers(message(0x20, b"\0"))
    assert single == message(0x20, b"\0\0" + single[8:12] + b"\0" + (cycle + 1).to_bytes(2, "little") * 2)


def test_a_sensor_that_streams_already_and_its_operations() -> None:
    with emulated_skin(WeissWtsDriver, EmulatedWeissWts, pattern="cycle", streaming=True, columns=3, rows=5) as skin:
        reader = skin.reader
        frame = read_until(reader, lambda f: not f.status.any())
        assert frame.structure.n_sensors == 15
        assert frame.structure.types[0].maximum == 4095
        assert len(set(frame.values.tolist())) == 1
        assert reader.call("temperature") == {"bus0": 25.3}
        frame = read_until(reader, lambda f: int(f.values[0]) > 20)

        def behind_ns(later: DriverSnapshot) -> int:
            """How much less the values have grown than they do without tare: by one in each 10 ms."""
            grown = int(later.values[0]) - int(frame.values[0])
            return int(later.module_time_ns[0] - frame.module_time_ns[0]) - 10 * MS * grown

        reader.call("tare")
        read_until(reader, lambda f: behind_ns(f) > 100 * MS)


def test_it_is_set_up_again_after_a_restart_and_damage_is_not_shown() -> None:
    faults: dict[str, Any] = {"lose": 0.02, "truncate": 0.02, "corrupt": 0.02, "repeat": 0.02}
    devices = restarted_on_demand(EmulatedWeissWts)
    with emulated_skin(WeissWtsDriver, devices, pattern="cycle", boot_s=0.1, **faults) as skin:
        reader = skin.reader

        def whole(live: bool) -> None:
            frame = read_until(reader, lambda f: (f.patch_state[0] == PatchState.LIVE) == live)
            assert len(set(frame.values.tolist())) == 1

        whole(live=True)
        devices.restart_now = True
        whole(live=False)
        whole(live=True)


def test_a_payload_that_is_not_hexadecimal_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="not hexadecimal"):
        WeissWtsOptions(tare_payload="x")
