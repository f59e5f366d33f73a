"""Drivers of serial devices, as users see them: several ports, faults, and devices that babble."""

from __future__ import annotations

import asyncio
import json
import os
import resource
import select
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from skinware import DriverReader, DriverSnapshot
from skinware.cli.info import command as info
from skinware.errors import ConfigurationError
from skinware.status import BusReason, BusState, Status
from skinware_drivers.can.socketcan import SocketCanBus
from skinware_drivers.counters import OWN_BUS_COUNTERS
from skinware_drivers.options import NoOptions
from skinware_drivers.running.generation import FlowLoop
from skinware_drivers.serial.bus import SerialBus
from skinware_drivers.serial.checksums import XOR
from skinware_drivers.serial.packets import LengthTable, Packet
from skinware_drivers.testing.waiting import wait_until
from tests.sdk.driving import read_until
from tests.serial.lines import (
    ANSWER,
    ASK,
    FRAMING,
    N_TAXELS,
    FingertipDriver,
    data_frame,
    device,
    driving,
    line,
    receive,
)


@pytest.fixture(autouse=True, params=[FlowLoop, asyncio.SelectorEventLoop])
def loop(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Which event loop drivers run in: one in whose rests C reads lines, or another."""
    monkeypatch.setattr("skinware_drivers.testing.driving.FlowLoop", request.param)


def fresh(frame: DriverSnapshot, tip: int) -> bool:
    part = slice(tip * N_TAXELS, (tip + 1) * N_TAXELS)
    return not frame.status[part].any()


def test_several_ports_feed_one_buffer_and_one_may_go_and_come_back(tmp_path: Path) -> None:
    link = tmp_path / "port"
    with line() as first, line() as second, line() as again:
        link.symlink_to(second.path)
        with device(first, "left"), driving(first.path, str(link)) as runner:
            with device(second, "right"):
                wait_until(lambda: runner.ready)
                reader = DriverReader("fingertip")
                frame = read_until(reader, lambda frame: fresh(frame, 0) and fresh(frame, 1))
                assert [bytes(name) for name in reader.structure.patch_name] == [b"left", b"right"]
                values = frame.values.reshape(2, N_TAXELS)
                assert (values == values[:, :1]).all()
            second.unplug()
            frame = read_until(reader, lambda frame: frame.bus_state[1] == BusState.GONE and fresh(frame, 0))
            read_until(reader, lambda frame: frame.status[N_TAXELS] == Status.STALE and fresh(frame, 0))
            link.unlink()
            link.symlink_to(again.path)
            with device(again, "right"):
                read_until(
                    reader, lambda frame: frame.bus_state[1] == BusState.LIVE and fresh(frame, 0) and fresh(frame, 1)
                )
            reader.close()


def test_a_port_that_babbles_takes_nothing_from_the_others() -> None:
    """Garbage as fast as a pseudo terminal carries it: more than a hundred times what a line of 3 Mbaud can."""
    garbage = os.urandom(4096)
    with line() as good, line() as mad:
        with device(good, "good") as tip, device(mad, "mad") as babbler, driving(good.path, mad.path) as runner:
            wait_until(lambda: runner.ready)
            with DriverReader("fingertip") as reader:
                read_until(reader, lambda frame: fresh(frame, 0) and fresh(frame, 1))
                babbler._flood = garbage
                before, memory = tip.value, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
                bus = runner.lines[1].bus
                assert isinstance(bus, SerialBus)
                seen = bus.counters.framing.bytes_in
                values: list[int] = []
                for frame in reader.in_order(timeout_s=30):
                    if fresh(frame, 0):
                        values.append(int(frame.values[0]))
                    if (
                        tip.value > before + 100
                        and bus.counters.framing.bytes_in > seen + 3_000_000
                        and bus._is_garbled
                    ):
                        break
                wait_until(lambda: runner.lines[1].condition.reason == BusReason.BUS_ERRORS)
                assert runner.lines[0].condition.reason == BusReason.NONE
                assert values == sorted(values)
                assert len(set(values)) > 80
                assert bus.counters.framing.bytes_in - bus.counters.framing.skipped_bytes < 200_000
                assert bus._stream.pending < 100
                grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - memory
                assert grown < 50_000, f"{grown} KiB more"


def test_a_device_that_says_nothing_is_asked_again() -> None:
    with line() as where, driving(where.path) as runner:
        question = FRAMING.encode(ASK, b"who")
        heard = where.read()
        while len(heard) < 2 * len(question):
            heard += where.read()
        assert heard.startswith(2 * question)
        with device(where):
            wait_until(lambda: runner.ready)
            with DriverReader("fingertip") as reader:
                frame = read_until(reader, lambda frame: fresh(frame, 0))
                assert frame.values.dtype == np.uint16


def test_damaged_frames_are_not_shown() -> None:
    with line() as where, device(where) as tip, driving(where.path) as runner:
        wait_until(lambda: runner.ready)
        damaged = bytearray(data_frame(0xEEEE))
        damaged[4] ^= 1
        shown = 0xAAAA  # to which the device has not counted before
        tip._flood = bytes(damaged) + data_frame(shown) + bytes(damaged)
        with DriverReader("fingertip") as reader:
            read_until(reader, lambda frame: frame.values[0] == shown)
            for _, frame in zip(range(200), reader.in_order(timeout_s=30), strict=False):
                assert (frame.values == shown).all()
        wait_until(lambda: runner.lines[0].bus.counters.errors > 200)  # C tells now and then


def test_every_program_sees_what_became_of_every_byte() -> None:
    damaged = bytearray(data_frame(1))
    damaged[4] ^= 0x40
    answer, good = FRAMING.encode(ANSWER, b"I am tip1"), data_frame(2) + data_frame(3)
    garbage, idle, tail = b"garbage" * 3 + b"\0", b"\0" * 5, data_frame(4)[:7]
    with line() as where, driving(where.path) as runner:
        answers = 0
        while not runner.ready:  # a driver that waited in vain for the first answer asks again
            if select.select([where.master], [], [], 0.01)[0]:
                assert FRAMING.encode(ASK, b"who") in where.read()
                where.write(answer)
                answers += 1
        where.write(garbage + data_frame(2) + idle + bytes(damaged) + data_frame(3) + tail)
        with DriverReader("fingertip") as reader:
            frame = read_until(reader, lambda frame: frame.values[0] == 3)
            total = len(answers * answer + garbage + good + idle + damaged + tail)
            frame = read_until(reader, lambda frame: reader.bus_counters(frame)[0]["bytes_in"] == total)
            counters = reader.bus_counters(frame)[0]
            shown = json.loads(CliRunner().invoke(info, ["fingertip", "--json"]).output)["drivers"][0]["buses"][0]
            assert [shown[name] for name in OWN_BUS_COUNTERS] == [counters[name] for name in OWN_BUS_COUNTERS]
        assert counters["frame_bytes"] == len(answers * answer + good)
        assert counters["idle_bytes"] == len(idle)
        assert counters["skipped_bytes"] == len(garbage + damaged)
        assert (counters["checksum_errors"] + counters["bad_form"], counters["errors"]) == (2, 2)
        assert counters["frames"] == answers + 2
        assert "skipped bytes" in CliRunner().invoke(info, ["fingertip"]).output


def test_a_device_may_tell_how_its_frames_lie_in_the_stream() -> None:
    with line() as where:
        bus = SerialBus(where.path, payload_size=64)
        adapter = FingertipDriver(NoOptions())
        adapter.fit(bus)
        bus.open()
        try:
            where.write(data_frame(1))
            assert len(receive(bus, 1)[0][1]) == 2 * N_TAXELS
            adapter.change_framing(Packet(sync=b"\xf0\xc4", length=LengthTable(2, {7: 9}), checksum=XOR))
            assert adapter.payload_size == 24
            where.write(bytes.fromhex("F0C407") + b"12345" + XOR.to_bytes(bytes.fromhex("F0C407") + b"12345"))
            assert receive(bus, 1)[0][1] == b"12345"
        finally:
            bus.close()


def test_another_kind_of_bus_is_refused() -> None:
    words = r"bus port is a CAN bus; FingertipDriver needs a serial line, as /dev/ttyUSB0, \./port"
    with pytest.raises(ConfigurationError, match=words):
        FingertipDriver(NoOptions()).fit(SocketCanBus("port"))
