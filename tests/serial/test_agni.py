"""The driver of the AGNI protocol: vectors of the wire, and the driver on a pseudo terminal."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

from skinware import PatchState
from skinware.errors import RequestFailed
from skinware_drivers.link import Link
from skinware_drivers.registry import make_bus
from skinware_drivers.serial.agni import AgniDriver, AgniOptions, command
from skinware_drivers.testing.driving import emulated_skin
from skinware_drivers.virtual.devices.agni import EmulatedAgni, EmulatedAgniOptions, message
from tests.sdk.driving import read_until, restarted_on_demand
from tests.serial.spoken import Spoken

CONFIGURATION = bytes.fromhex("F0 C4 00 C0 F4")
STOP = bytes.fromhex("F0 C4 00 00 34")
START = bytes.fromhex("F0 C4 00 F1 C5")


def test_bytes_of_commands_are_those_of_the_vectors() -> None:
    assert (command(0xC0), command(0x00), command(0xF1)) == (CONFIGURATION, STOP, START)
    period = command(0xD0, bytes.fromhex("0200 01 0A00 02 0A00"))
    assert period == message(0, bytes.fromhex("D0 0200 01 0A00 02 0A00"))


def test_a_period_is_sent_in_tenths_of_a_millisecond(monkeypatch: pytest.MonkeyPatch) -> None:
    driver, sent = AgniDriver(AgniOptions(period_ms=20)), list[bytes]()

    async def send(_link: object, _identifier: int, payload: bytes) -> None:
        sent.append(payload)

    monkeypatch.setattr(Link, "send", send)
    driver._n_sensors = 2
    asyncio.run(driver.configure(Link(make_bus("/dev/null"))))
    assert sent == [command(0xD0, bytes.fromhex("0200 01 C800 02 C800"))]


def test_the_emulated_device_byte_for_byte() -> None:
    device = Spoken(EmulatedAgni(EmulatedAgniOptions(sensors=(1, 2), pattern="cycle")))
    assert device.answers(b"noise" + CONFIGURATION) == [message(0, bytes.fromhex("01 07 02 0302 0200 0302 0400"))]
    assert device.answers(CONFIGURATION[:-1] + b"\0") == [bytes.fromhex("F0 C4 FE F0 3A")]
    assert device.answers(command(0x99)) == [bytes.fromhex("F0 C4 FE F1 3B")]
    assert device.answers(command(0xF0)) == [bytes.fromhex("F0 C4 F0 C4")]
    assert device.answers(command(0xD0, bytes.fromhex("0200 01 C800 02 C800"))) == []
    assert (
        device.answers(bytes.fromhex("F0 C4 01 D0 02 00 F4 01 12")) == []
    )  # of one sensor, as the maker's host sends it
    assert device.answers(bytes.fromhex("F0 C4 01 D0 02 00 C8 00 2F")) == []
    assert device.answers(bytes.fromhex("F0 C4 03 D0 02 00 C8 00 2D")) == [bytes.fromhex("F0 C4 FE F2 38")]
    frames = device.answers(START, 65)
    assert len(frames) in (6, 8)
    for at, frame in enumerate(frames):
        assert frame == message(at % 2 + 1, frame[3:7] + (at // 2).to_bytes(2, "little") * (at % 2 + 1))
    assert device.answers(STOP, 100) == []


def test_a_device_that_streams_already_and_describes_itself() -> None:
    emulated: dict[str, Any] = {"pattern": "cycle", "streaming": True, "sensors": (5, 300)}
    with emulated_skin(
        AgniDriver, EmulatedAgni, driver_options={"time_unit_us": 1.0, "period_ms": 20}, **emulated
    ) as skin:
        reader = skin.reader
        frame = read_until(reader, lambda f: not f.status.any())
        structure = frame.structure
        assert structure.patch_name.tolist() == [b"device 7"]
        assert structure.module_kind.tolist() == [b"type 515"] * 2
        assert structure.sensor_module.tolist() == [0] * 5 + [1] * 300
        frame = read_until(reader, lambda f: len(set(f.values.tolist())) == 1)
        assert frame.module_time_ns[0] == frame.module_time_ns[1]
        with pytest.raises(RequestFailed, match="give 1 to 6553"):
            reader.call("period", ms=0)
        reader.call("period", ms=10)
        read_until(reader, lambda f: int(f.values[0]) > int(frame.values[0]) + 3)


def test_it_is_set_up_again_after_a_restart_and_damage_is_not_shown() -> None:
    faults: dict[str, Any] = {"lose": 0.02, "truncate": 0.02, "corrupt": 0.02, "repeat": 0.02}
    devices = restarted_on_demand(EmulatedAgni)
    with emulated_skin(AgniDriver, devices, pattern="cycle", boot_s=0.1, **faults) as skin:
        reader = skin.reader
        for live in (True, False, True):
            if not live:
                devices.restart_now = True
            frame = read_until(reader, lambda f, live=live: (f.patch_state[0] == PatchState.LIVE) == live)  # type: ignore[misc]
            for module in (0, 1):
                assert len(set(frame.values[frame.structure.module_index(module)].tolist())) == 1
