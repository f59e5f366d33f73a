"""The board DEV001 of Contactile: records by hand among text, sensors that were not zeroed, an emulated board."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
import pytest

from skinware.errors import HandshakeTimeout
from skinware.status import Status
from skinware_drivers.serial.contactile import Dev001Driver, Dev001Options
from skinware_drivers.testing.comparison import until_fresh
from skinware_drivers.testing.driving import emulated_skin
from skinware_drivers.testing.rig import play
from skinware_drivers.testing.waiting import read_until
from skinware_drivers.virtual.devices.contactile import EmulatedDev001, EmulatedDev001Options
from skinware_drivers.virtual.hand_clock import HandClock
from tests.drivers.test_conformance import TestDev001 as Conformance
from tests.serial.spoken import Spoken

START = b"stream start -d all -f 100 -p binary\n"
BODY = bytes.fromhex("b5853b00 200e0000 0000dc41 0000c03f 00000040 000080bf")  # 27.5; force z 1.5, y 2, x -1


def record(port: int) -> bytes:
    return struct.pack("<I", port) + BODY


def found(stream: bytes, **options: Any) -> list[tuple[int, bytes]]:
    framer = Dev001Driver(Dev001Options(**options)).framing.framer()
    frames = [frame for at in range(len(stream)) for frame in framer.feed(stream[at : at + 1])]
    counters = framer.counters
    assert counters.bytes_in == counters.frame_bytes + counters.skipped_bytes + framer.pending
    return [(frame.identifier, frame.body) for frame in frames]


def test_records_among_text() -> None:
    """The last record before text, which nothing confirms, is not shown."""
    stream = b"Port 0:\r\n Starting data stream\r\n" + record(0) + record(4) + record(0) + b"Biasing...\r\n"
    assert found(stream + record(1) + record(2) * 4)[:3] == [(0, BODY), (4, BODY), (1, BODY)]


def test_what_is_no_record() -> None:
    for at, byte in ((0, 5), (1, 1), (8, 0x00), (9, 0x06), (11, 1)):
        bad = bytearray(record(0))
        bad[at] = byte
        assert found(record(0) + record(1) + bytes(bad) + record(2) + record(3) * 2) == [
            (0, BODY),
            (2, BODY),
            (3, BODY),
        ]


def test_forces_alone() -> None:
    body = BODY[:4] + bytes.fromhex("000e0000") + BODY[12:]
    assert found((struct.pack("<I", 3) + body) * 2, temperature=False) == [(3, body)]


def test_the_driver_starts_zeroes_and_stops() -> None:
    async def scenario(clock: HandClock) -> None:
        case = type("Two", (Conformance,), {"emulator_options": {"ports": (1, 3), "biased": False}})()
        async with case.running(clock) as rig:
            await rig.until(lambda frame: bool((frame.status == Status.SUSPECT).sum() == 6), "")
            assert rig.record.frames[-1].structure.module_name.tolist() == [b"port 1", b"port 3"]
            assert rig.runner is not None
            adapter, link = rig.adapter, rig.runner.lines[0].link
            assert isinstance(adapter, Dev001Driver)
            await adapter.tare(link, ())
            await rig.until(lambda frame: not frame.status.any(), "")
            await rig.stop()
        start = b"stream start -d all -f 500 -p binary\n"
        assert [payload for _, payload in rig.wire.sent] == [start, b"bias\n", b"stream stop\n"]

    play(scenario)


def test_a_sensor_that_sends_later(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO", "skinware.driver")

    async def scenario(clock: HandClock) -> None:
        case = type("Late", (Conformance,), {"emulator_options": {"silence": ("port4",), "silence_after_s": 0}})()
        async with case.running(clock) as rig:
            frame = await until_fresh(rig)
            assert frame.structure.n_sensors == 16
            rig.devices.silent.clear()
            await rig.sleep(3)

    play(scenario)
    assert "sensors: 20" in caplog.text


def test_a_silent_board() -> None:
    async def scenario(clock: HandClock) -> None:
        case = type("Empty", (Conformance,), {"emulator_options": {"ports": ()}})()
        async with case.handshakes(clock) as rig:
            with pytest.raises(HandshakeTimeout, match="no sensor sends"):
                await rig.adapter.describe(rig.link)

    play(scenario)


def test_what_a_sending_board_says_of_itself() -> None:
    async def scenario(clock: HandClock) -> None:
        case = type("Sending", (Conformance,), {"emulator_options": {"streaming": True}})()
        async with case.handshakes(clock) as rig:
            rig.devices.devices[1].memory["binary"] = True
            assert await Dev001Driver.identify(rig.link, idle=False) == "Contactile DEV001, 5 sensors"
            assert not rig.wire.sent

    play(scenario)


def test_commands_of_the_emulated_board() -> None:
    board = Spoken(EmulatedDev001(EmulatedDev001Options(ports=(0, 2), biased=False)))
    assert b"Port 1: [Not connected]" in board.answers(b"info\n")[0]
    text, *records = board.answers(START, 1000)
    assert text.startswith(b"Port 0:")
    assert len(records) == pytest.approx(100, abs=2)
    assert np.isnan(np.frombuffer(records[0], "<f4", 3, 16)).all()
    assert board.answers(b"bias\n", 1)[0].startswith(b"Biasing...")
    assert len(board.answers(b"s 0 start -d fx,fz -f 50 -p binary\n", 100)[-1]) == 2 * 20
    [text] = board.answers(b"stream stop\n", 100)
    assert b"stopped" in text
    assert len(board.answers(b"z\n\0", 100)[-1]) == 2 * 24


def test_on_a_port() -> None:
    with emulated_skin("dev001", name="buttons", ports=(0, 1)) as skin:
        frame = read_until(skin.reader, lambda f: not f.status.any())
        assert frame.structure.n_sensors == 8
        assert (frame.physical("temperature") == 27).all()
