"""Against servers and a client of somebody else's making, over TCP and on lines; and lines that are lost."""

from __future__ import annotations

import asyncio
import contextlib
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pymodbus.constants import ExcCodes

import skinware.recording
from skinware.errors import BusNotAvailable, BusSendError, ConfigurationError
from skinware.status import PatchState, Status
from skinware_drivers import Module, NoOptions, Patch, taxels
from skinware_drivers.bus import FrameBatch
from skinware_drivers.bus_names import parse_bus_name
from skinware_drivers.modbus import ModbusAdapter, Registers
from skinware_drivers.modbus.bus import ModbusBus
from skinware_drivers.registry import make_bus
from skinware_drivers.testing.waiting import read_until, wait_until
from tests.commands import running
from tests.modbus.hands import FINGER_AT, Array
from tests.modbus.peers import device, rtu_server, tcp_server
from tests.modbus.rig import PYMODBUS, N, Palm, counted, driven, palm, until_right
from tests.recording.rig import recording
from tests.streams.peers import LOCAL, free_port, server

pytestmark = PYMODBUS


# Names


def test_names() -> None:
    assert parse_bus_name("modbus:tcp://10.0.0.2") == ("modbus", "tcp://10.0.0.2", {})
    assert parse_bus_name("modbus:/dev/ttyUSB0?baudrate=9600") == ("modbus", "/dev/ttyUSB0", {"baudrate": "9600"})
    over_tcp = make_bus("modbus:tcp://10.0.0.2?timeout_ms=5&patience_s=3")
    assert isinstance(over_tcp, ModbusBus)
    assert str(over_tcp._address) == "10.0.0.2:502"
    assert make_bus("modbus:/dev/ttyUSB0?listen=yes").listen_only


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("modbus:tcp://", "which host"),
        ("modbus:tcp://host:0x10", "HOST:PORT"),
        ("modbus:tcp://host?baudrate=9600", "unknown option"),
        ("modbus:tcp://host?listen=yes", "a connection cannot be tapped"),
        ("modbus:/dev/ttyUSB0?timeout_ms=0", "timeout_ms"),
        ("modbus:/dev/ttyUSB0?byte_order=middle", "byte_order"),
        ("modbus:/dev/ttyUSB0?patience_s=3", "unknown option"),
    ],
)
def test_names_that_are_none(name: str, told: str) -> None:
    with pytest.raises(ConfigurationError, match=told):
        make_bus(name)


def test_other_drivers_do_not_run_on_it() -> None:
    with pytest.raises(ConfigurationError, match="is a serial line; Array needs a Modbus line, as modbus:/dev/ttyUSB0"):
        Array(NoOptions()).fit(make_bus("/dev/ttyUSB0"))


# Values


def test_a_driver_reads_a_server(over: Any, way: str) -> None:
    with over(palm()) as name, driven(name) as (driving, reader):
        until_right(reader)

        def all_in_frames() -> bool:  # but for half a reply that has just come
            counters = counted(driving)
            return bool(counters["bytes_in"] == counters["frame_bytes"])

        wait_until(all_in_frames)
        counters = counted(driving)
        assert counters["polls_unanswered"] == counters["errors"] == counters["skipped_bytes"] == 0
        assert driving.runner is not None
        assert driving.runner.builder.generation is not None
        assert driving.runner.builder.generation.flows == (way == "native")


def test_values_follow_in_the_order_of_the_device(over: Any) -> None:
    """The server raises all registers before each first read: no frame may be older than the one before, or torn."""

    async def rise(function: int, start: int, address: int, count: int, registers: list[int], _set: object) -> None:
        if address == FINGER_AT:
            registers[:] = [registers[0] + 1] * len(registers)

    with over(device(1, FINGER_AT, [0] * N, rise)) as name, driven(name) as (_, reader):
        newest = 0
        for _ in range(20):
            before = newest
            frame = read_until(reader, lambda frame, before=before: frame.values[0] > before)  # type: ignore[misc]
            assert (frame.values == frame.values[0]).all()
            newest = int(frame.values[0])


def test_questions_and_replies_are_recorded(over: Any, tmp_path: Path) -> None:
    """Whoever asks, C or Python."""
    file = tmp_path / "palm.mcap"
    with over(palm()) as name, driven(name) as (driving, reader):
        with recording(file, with_wires=True) as recorder:
            wait_until(lambda: any(channel.startswith("/wire/palm/") for channel in recorder.messages))
        until_right(reader)
        with skinware.recording.open(file) as opened:
            [wire] = opened.wires
            items = list(wire.items())
        question = struct.pack(">BBHH", 1, 3, FINGER_AT, 125)  # unit, function, first register, count
        reply = struct.pack(">BBB125H", 1, 3, 250, *range(1000, 1125))
        assert any(question in item.data for item in items if item.is_sent)
        assert reply in b"".join(item.data for item in items if not item.is_sent)
        wait_until(lambda: counted(driving)["state"] == "live")


@pytest.mark.thorough
def test_a_recorded_wire_is_decoded_again(over: Any, tmp_path: Path) -> None:
    """The server raises all registers before each first read: the replay shows values that were seen, and in order."""
    file = tmp_path / "palm.mcap"

    async def rise(function: int, start: int, address: int, count: int, registers: list[int], _set: object) -> None:
        if address == FINGER_AT:
            registers[:] = [registers[0] + 1] * len(registers)

    with over(device(1, FINGER_AT, [0] * N, rise)) as name, driven(name) as (_, reader):
        with recording(file, with_wires=True) as recorder:
            wait_until(lambda: any(channel.startswith("/wire/palm/") for channel in recorder.messages))
            before = int(read_until(reader, lambda frame: frame.values[0] > 0).values[0])
            last = int(read_until(reader, lambda frame: frame.values[0] > before + 20).values[0])
            [wire] = [channel for channel in recorder.messages if channel.startswith("/wire/palm/")]
            written = recorder.messages[wire]
            wait_until(lambda: recorder.messages[wire] >= written + 3)  # what it has of the wire then is written
    with driven(f"replay:{file}", wait=False) as (driving, reader):
        seen = [0]
        while seen[-1] < last - 5:
            frame = read_until(reader, lambda frame: frame.values[0] > seen[-1])
            assert (frame.values == frame.values[0]).all()
            seen.append(int(frame.values[0]))
        assert seen == sorted(seen)
        assert counted(driving)["sent"] == 0


def test_several_units_on_one_line_one_of_them_dead() -> None:
    class Fingers(ModbusAdapter[NoOptions]):
        types = Palm.types
        dtype = np.uint16
        timeout_s = Palm.timeout_s
        patches = tuple(Patch(f"finger {n}", [Module(taxels(4, first_uid=n << 8))], key=n) for n in (1, 2, 3))
        registers = tuple(Registers(0, 4, unit=n, patch=n, function=4) for n in (1, 2, 3))

    units = [device(n, 0, range(10 * n, 10 * n + 4)) for n in (1, 3)]
    with rtu_server(*units) as name, driven(name, Fingers(NoOptions()), wait=False) as (driving, reader):
        frame = read_until(reader, lambda frame: not (frame.status[[0, 1, 2, 3, 8, 9, 10, 11]]).any())
        assert frame.values[[0, 1, 2, 3, 8, 9, 10, 11]].tolist() == [10, 11, 12, 13, 30, 31, 32, 33]
        assert (frame.status[4:8] & Status.NEVER_SEEN).all()
        # this server says that the unit does not answer; a line would be silent
        wait_until(lambda: counted(driving)["polls_unanswered"] + counted(driving)["errors"] >= 3)


def test_exceptions_are_counted_and_values_come_when_they_end(way: str) -> None:
    is_busy = True

    async def act(*_: object) -> ExcCodes | None:
        return ExcCodes.DEVICE_BUSY if is_busy else None

    with tcp_server(palm(act)) as name, driven(name, wait=False) as (driving, reader):
        wait_until(lambda: driving.runner is not None and counted(driving).get("errors", 0) > 5)
        is_busy = False
        until_right(reader)


def test_a_server_that_answers_late_never_shifts_values(way: str) -> None:
    """The twentieth reply comes late. If another question is open by then, this server gives it its number.

    That is after twice the timeout: one that a busy machine does not sleep through.
    """
    timeout_s = 2.0
    asked = 0

    async def act(*_: object) -> None:
        nonlocal asked
        asked += 1
        await asyncio.sleep(1.4 * timeout_s if asked == 20 else 0)

    with tcp_server(palm(act)) as name, driven(f"{name}?timeout_ms={1e3 * timeout_s}") as (driving, reader):
        right = np.arange(1000, 1000 + N)
        wait_until(lambda: counted(driving)["polls_late"] > 0)
        for _ in range(50):
            frame = read_until(reader, lambda frame: True)
            fresh = (frame.status & Status.NEVER_SEEN) == 0
            assert (frame.values[fresh] == right[fresh]).all()


def test_a_driver_may_write_and_is_told_of_exceptions(over: Any) -> None:
    with over(palm()) as name, driven(name) as (_, reader):
        until_right(reader)
        [answer] = reader.call("set", address=FINGER_AT + 9, value=77).values()
        assert answer == 77
        with pytest.raises(Exception, match="no such registers"):
            reader.call("set", address=9, value=77)


# Lines that are lost, and other troubles


def test_a_server_that_ends_is_called_again(way: str) -> None:
    port = free_port()
    with contextlib.ExitStack() as stack:
        with tcp_server(palm(), port=port) as name:
            driving, reader = stack.enter_context(driven(name))
            until_right(reader)
        read_until(reader, lambda frame: (frame.patch_state == PatchState.STALE).all())
        wait_until(lambda: counted(driving)["state"] == "gone")
        with tcp_server(palm(), port=port):
            until_right(reader)


def test_half_a_reply_and_then_nothing() -> None:
    with server() as peer:
        bus = make_bus(f"modbus:tcp://{LOCAL}:{peer.port}?timeout_ms=500", payload_size=600)
        Palm(NoOptions()).fit(bus)
        bus.open()
        try:
            caller = peer.answer()
            batch = FrameBatch(8, 600)

            def take() -> None:
                with contextlib.suppress(BlockingIOError):
                    bus.receive(batch, 0)

            def next_question() -> bytes:
                caller.settimeout(0.01)
                for _ in range(1000):
                    take()
                    with contextlib.suppress(TimeoutError):
                        return caller.recv(12)
                raise AssertionError("it asks nothing")

            first = next_question()
            reply = first[:4] + struct.pack(">HBBB", 253, 1, 3, 250) + bytes(250)
            caller.sendall(reply[:100])
            second = next_question()
            assert second[:2] != first[:2]
            assert bus.counters.polls_unanswered == 1
            caller.sendall(reply[100:])  # late, and whole now; its number says which question it answers
            wait_until(lambda: bus.receive(batch, 0) >= 0 and bus.counters.polls_late == 1)
            assert bus.counters.refused == 0
            assert bus.counters.framing.skipped_bytes == 0
            caller.sendall(b"HTTP/1.1 400 Bad Request")
            with pytest.raises(BusNotAvailable, match="no Modbus"):
                wait_until(lambda: bus.receive(batch, 0) == -1)
        finally:
            bus.close()


def test_what_cannot_be_sent_is_refused() -> None:
    with server() as peer:
        bus = make_bus(f"modbus:tcp://{LOCAL}:{peer.port}", payload_size=600)
        with pytest.raises(BusSendError, match="not open"):
            bus.send(1, b"\x03\0\0\0\1")
        bus.open()
        for unit, message in ((1, b"\x2b\x0e\1\0"), (1, b""), (300, b"\x03\0\0\0\1")):
            with pytest.raises(BusSendError, match="cannot be sent"):
                bus.send(unit, message)
        bus.close()
        assert bus.fileno() == -1


# Commands


@pytest.mark.thorough
def test_the_commands() -> None:
    name, file = f"modbus:tcp://{LOCAL}:{free_port()}", str(Path(__file__).parent / "array_file.py")
    with running("skin-emulate", "--driver", file, "--bus", name) as devices:
        devices.wait_for("ready")
        with running("skin-driver", "--driver", file, "--bus", name) as driver:
            driver.wait_for("status", lambda event: event["buses"][0]["state"] == "live")
