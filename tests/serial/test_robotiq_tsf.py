"""Robotiq's fingertips: bytes by hand, and the maker's package as the client of our emulator."""

from __future__ import annotations

import struct

import numpy as np
import pytest

from skinware.status import PatchState, Status
from skinware_drivers.serial.robotiq_tsf import RobotiqPackets, RobotiqTsfDriver, RobotiqTsfOptions, _unit_of
from skinware_drivers.testing.comparison import until_fresh
from skinware_drivers.testing.driving import emulated_on_a_pty, emulated_skin
from skinware_drivers.testing.rig import play
from skinware_drivers.testing.waiting import read_until, wait_until
from skinware_drivers.virtual.devices.robotiq_tsf import EmulatedRobotiqTsf, EmulatedRobotiqTsfOptions
from skinware_drivers.virtual.hand_clock import HandClock
from tests.drivers.test_conformance import TestRobotiqTsf as Conformance
from tests.serial.spoken import Spoken

STATIC = bytes.fromhex("14") + struct.pack(">28H", *range(1000, 1028))
TEMPERATURE = bytes.fromhex("6000fb")
TIME = bytes.fromhex("74") + (0x1122334455).to_bytes(8, "big")
NEXT = bytes.fromhex("9a0061")


def packet(*fields: bytes, check: int = 0, command: int = 0x61) -> bytes:
    data = b"".join(fields)
    return bytes([0x9A, check, command, len(data)]) + data


def test_fields_of_a_packet_one_byte_at_a_time() -> None:
    framer = RobotiqPackets(times=True).framer()
    stream = b"\x9a\x9a\x00" + packet(STATIC, TEMPERATURE, TIME, check=0x5C) + NEXT
    frames = [frame for at in range(len(stream)) for frame in framer.feed(stream[at : at + 1])]
    stamp = bytes.fromhex("55443322")
    assert [(frame.identifier, frame.body) for frame in frames] == [
        (0x11, stamp + STATIC[1:]),
        (0x460, bytes(4) + TEMPERATURE[1:]),
        (0x71, stamp),
    ]
    assert framer.pending == len(NEXT)
    counters = framer.counters
    assert counters.bytes_in == counters.frame_bytes + counters.skipped_bytes + framer.pending


def test_a_packet_behind_another_one_waits_for_no_next_one() -> None:
    framer = RobotiqPackets().framer()
    assert not framer.feed(packet(TEMPERATURE))
    for cut in (3, 6):
        assert [frame.identifier for frame in framer.feed(packet(STATIC) + packet(TEMPERATURE)[:cut])][-1] == 0x411
        assert [frame.identifier for frame in framer.feed(packet(TEMPERATURE)[cut:])] == [0x460]
    assert framer.pending == 0


@pytest.mark.parametrize(
    "bad",
    [
        packet(b"\x80\0\0"),  # no such kind
        packet(b"\x6c\0\0"),  # no such finger
        packet(STATIC)[:-2],  # cut short
        packet(STATIC[:-1]),  # not filled by its fields
        packet(command=0x33),  # no such command
    ],
    ids=lambda bad: bad[:6].hex(),
)
def test_what_is_no_packet(bad: bytes) -> None:
    framer = RobotiqPackets().framer()
    frames = framer.feed(bad + packet(TEMPERATURE) + NEXT)
    assert [frame.identifier for frame in frames] == [0x460]
    assert framer.counters.refused > 0


@pytest.mark.parametrize(("step", "unit_s"), [(10, 1e-3), (10_000, 1e-6), (10_000_000, 1e-9), (77, None), (0, None)])
def test_the_unit_of_the_time_is_learnt(step: int, unit_s: float | None) -> None:
    assert _unit_of({0: [(number * 10_000_000, number * step & 0xFFFF_FFFF) for number in range(50)]}) == unit_s


def test_kinds_have_their_own_rates() -> None:
    """Slow kinds are fresh at their rate, and stale when they alone fall silent."""

    async def scenario(clock: HandClock) -> None:
        case = type("Slow", (Conformance,), {"emulator_options": {"slow": 50}})()
        async with case.running(clock) as rig:
            await until_fresh(rig)
            await rig.sleep(3)
            assert not rig.record.frames[-1].status.any()
            rig.devices.silent.add("magnetometer1")
            await rig.sleep(3)
            frame = rig.record.frames[-1]
            stale = frame.structure.module_name[
                np.unique(frame.structure.sensor_module[(frame.status & Status.STALE) != 0])
            ]
            assert stale.tolist() == [b"magnetometer"]
            assert (frame.patch_state == PatchState.LIVE).all()

    play(scenario)


def test_the_driver_never_starts_the_bootloader() -> None:
    async def scenario(clock: HandClock) -> None:
        async with Conformance().running(clock) as rig:
            await until_fresh(rig)
            assert rig.runner is not None
            adapter, link = rig.adapter, rig.runner.lines[0].link
            assert isinstance(adapter, RobotiqTsfDriver)
            assert await adapter.version(link, ()) == "01.02.03"
            rig.devices.restart(0, clock.now_ns)
            await rig.sleep(2)
            await rig.stop()
        sent = [payload for _, payload in rig.wire.sent]
        assert {payload[2] for payload in sent} <= {0x58, 0xE3}
        assert sent[-1] == bytes.fromhex("9a00580100")

    play(scenario)


def test_the_emulated_bootloader_is_silent() -> None:
    device = Spoken(EmulatedRobotiqTsf(EmulatedRobotiqTsfOptions()))
    assert device.answers(bytes.fromhex("9a00580105"), 50)
    device.answers(bytes.fromhex("9a00e200"), 50)
    assert not device.answers(bytes.fromhex("9a00580105"), 50)


def test_listening_only() -> None:
    async def scenario(clock: HandClock) -> None:
        case = type("Sending", (Conformance,), {"emulator_options": {"streaming": True}})()
        async with case.running(clock, listen_only=True) as rig:
            await until_fresh(rig)
            assert not rig.wire.sent

    play(scenario)


def test_on_a_port() -> None:
    with emulated_skin("robotiq_tsf", name="fingertips", period_ms=20) as skin:
        frame = read_until(skin.reader, lambda f: not f.status.any())
        structure = frame.structure
        assert structure.patch_name.tolist() == [b"finger 1", b"finger 2"]
        assert [name.decode() for name in structure.module_name[:6]] == [
            "static",
            "dynamic",
            "accelerometer",
            "gyroscope",
            "magnetometer",
            "temperature",
        ]
        assert (frame.physical("acceleration_z") == 16384).all()


def test_with_the_makers_package() -> None:
    """It reads from our emulator what that felt, and its commands are obeyed."""
    robotiq = pytest.importorskip("pyrobotiqtactile", reason="the package pyrobotiqtactile is not installed")
    options = {"pattern": "idle", "period_ms": 5}
    with emulated_on_a_pty("robotiq_tsf", **options) as path, robotiq.RobotiqTactileSensor(port=path) as sensor:
        assert bytes.fromhex("9a00e303010203").startswith(sensor.get_version())  # it returns what has come by then
        sensor.configure(update_period_ms=5, synchronous=False)
        wait_until(lambda: bool((sensor.read_frame(timeout=1).pressure == 400).all()))
        reading = sensor.get_latest_reading()
        assert reading.pressure.shape == (2, 7, 4)
        assert reading.accelerometer.tolist() == [[0, 0, 16384]] * 2
        assert reading.temperature.tolist() == [250] * 2
        assert (reading.timestamp > 0).all()
        sensor.configure(update_period_ms=0, synchronous=False)


def test_options() -> None:
    assert RobotiqTsfDriver(RobotiqTsfOptions(period_ms=4)).period_s == 0.004
