"""The gateway with clients of somebody else's making (pymodbus), some of which behave badly."""

from __future__ import annotations

import asyncio
import socket
import struct
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from pymodbus.client import ModbusSerialClient, ModbusTcpClient

from skinware import DriverReader
from skinware.errors import BusNotAvailable, ConfigurationError
from skinware_drivers.registry import make_bus
from skinware_drivers.testing.waiting import read_until
from tests.modbus.hands import FINGER_AT
from tests.modbus.peers import Action, device, tcp_server
from tests.modbus.rig import PYMODBUS, N, counted, driven, until_right, with_options
from tests.streams.peers import LOCAL, free_port, server

PLACE = FINGER_AT + N
"""Of registers that are the hand's, and not of its skin."""
N_MORE = 8
pytestmark = PYMODBUS


@contextmanager
def shared(over: Any, options: str = "", action: Action | None = None) -> Iterator[tuple[int, Any, DriverReader]]:
    """A hand whose skin is read, and the port of the gateway to it."""
    port = free_port()
    hand = device(1, FINGER_AT, [*range(1000, 1000 + N), *range(N_MORE)], action)
    with over(hand) as name, driven(with_options(name, f"gateway={port}{options}")) as (driving, reader):
        until_right(reader)
        yield port, driving, reader


def client(port: int) -> ModbusTcpClient:
    return ModbusTcpClient(LOCAL, port=port, timeout=30, retries=0)


def until_newer(reader: DriverReader, frames: int) -> None:
    """So many more frames, all of them right."""
    for _ in range(frames):
        newest = int(read_until(reader, lambda frame: True).module_time_ns[0])
        frame = read_until(reader, lambda frame, newest=newest: frame.module_time_ns[0] > newest)  # type: ignore[misc]
        assert (frame.values == range(1000, 1000 + N)).all()


@pytest.mark.thorough
def test_programs_move_the_hand_while_its_skin_is_read(over: Any) -> None:
    failures: list[str] = []

    def work(port: int, place: int) -> None:
        with client(port) as program:
            for value in range(20):
                program.write_register(place, value, device_id=1)
                answer = program.read_holding_registers(place, count=1, device_id=1)
                if answer.isError() or answer.registers != [value]:
                    failures.append(f"{place}: {answer}, not {value}")

    with shared(over) as (port, driving, reader):
        programs = [threading.Thread(target=work, args=(port, PLACE + number)) for number in range(3)]
        for program in programs:
            program.start()
        until_newer(reader, 5)
        for program in programs:
            program.join(60)
        assert not any(program.is_alive() for program in programs)
        assert failures == []
        until_newer(reader, 3)
        counters = counted(driving)
        assert counters["refused"] == counters["polls_unanswered"] == counters["errors"] == 0


def test_a_serial_port_for_programs_that_know_no_other(over: Any, tmp_path: Path) -> None:
    port = tmp_path / "hand"
    with shared(over, f",{port}") as (_, _, reader):
        with ModbusSerialClient(str(port), baudrate=115_200, timeout=30, retries=0) as program:
            for value in range(10):
                program.write_registers(PLACE, [value, value + 1], device_id=1)
                assert program.read_holding_registers(PLACE, count=2, device_id=1).registers == [value, value + 1]
        until_newer(reader, 2)
    assert not port.is_symlink()


def test_a_gateway_that_only_reads(way: str) -> None:
    with shared(tcp_server, "&gateway_writes=no") as (port, _, reader), client(port) as program:
        assert program.write_register(PLACE, 7, device_id=1).exception_code == 1
        assert program.write_registers(PLACE, [7, 8], device_id=1).exception_code == 1
        assert program.read_holding_registers(PLACE, count=2, device_id=1).registers == [0, 1]
        until_newer(reader, 2)


def test_exceptions_come_through_and_silence_is_one(way: str) -> None:
    async def act(function: int, start: int, address: int, count: int, registers: list[int], values: object) -> None:
        if address == PLACE + 1:
            await asyncio.sleep(1.4 * timeout_s)

    timeout_s = 2.0
    with shared(tcp_server, f"&timeout_ms={1e3 * timeout_s}", act) as (port, _, reader), client(port) as program:
        assert program.read_holding_registers(7, count=1, device_id=1).exception_code == 2
        assert program.read_holding_registers(PLACE + 1, count=1, device_id=1).exception_code == 11
        until_newer(reader, 3)
        assert program.read_holding_registers(PLACE, count=1, device_id=1).registers == [0]


def question(number: int, place: int = PLACE) -> bytes:
    return struct.pack(">HHHBBHH", number, 0, 6, 1, 3, place, 1)


@pytest.mark.thorough
def test_who_hangs_up_in_the_middle_disturbs_nobody(over: Any) -> None:
    with shared(over) as (port, driving, reader):
        for number in range(30):
            with socket.create_connection((LOCAL, port), 30) as program:
                program.sendall((question(1) * 3)[: 6 + 3 * number % 37])
        with client(port) as program:
            assert program.read_holding_registers(PLACE + 3, count=1, device_id=1).registers == [3]
        until_newer(reader, 5)
        assert counted(driving)["refused"] == 0


def test_who_sends_no_modbus_is_hung_up_on(way: str) -> None:
    with shared(tcp_server) as (port, _, reader), socket.create_connection((LOCAL, port), 30) as program:
        program.sendall(b"GET / HTTP/1.1\r\n\r\n")
        assert program.recv(1) == b""
        until_newer(reader, 2)


@pytest.mark.thorough
def test_floods_and_programs_that_take_no_replies_starve_neither_skin_nor_others(over: Any) -> None:
    stop = threading.Event()

    def flood(port: int) -> None:
        with socket.create_connection((LOCAL, port), 30) as program:
            program.settimeout(0.05)
            while not stop.is_set():
                try:
                    program.send(question(1) * 50)  # and takes no reply
                except TimeoutError:
                    continue

    with shared(over) as (port, _, reader):
        floods = [threading.Thread(target=flood, args=(port,)) for _ in range(2)]
        for thread in floods:
            thread.start()
        try:
            until_newer(reader, 5)
            with client(port) as program:
                for value in range(5):
                    program.write_register(PLACE, value, device_id=1)
                    assert program.read_holding_registers(PLACE, count=1, device_id=1).registers == [value]
            until_newer(reader, 5)
        finally:
            stop.set()
            for thread in floods:
                thread.join(30)
        until_newer(reader, 3)


def test_more_programs_than_it_takes(way: str) -> None:
    with shared(tcp_server) as (port, _, reader):
        programs = [socket.create_connection((LOCAL, port), 30) for _ in range(20)]
        try:
            until_newer(reader, 2)
            told = []
            for program in programs:
                program.sendall(question(1))
                try:
                    told.append(len(program.recv(100)))
                except ConnectionError:
                    told.append(0)
            assert told == [11] * 16 + [0] * 4
        finally:
            for program in programs:
                program.close()
        until_newer(reader, 2)


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ("gateway=0.0.0.0:5020", "gateway_public=yes"),
        ("gateway=:5020", "which host"),
        ("gateway=192.168.1.5:5020", "gateway_public=yes"),
        ("gateway=nothing", "which port"),
        ("gateway=5020&listen=yes", "no gateway"),
    ],
)
def test_gateways_that_cannot_be(options: str, told: str) -> None:
    with pytest.raises(ConfigurationError, match=told):
        make_bus(f"modbus:/dev/ttyUSB0?{options}")


@pytest.mark.parametrize(
    "options",
    ["gateway=5020", "gateway=[::1]:5020", "gateway=localhost:5020", "gateway=0.0.0.0:5020&gateway_public=yes"],
)
def test_gateways_that_can_be(options: str) -> None:
    make_bus(f"modbus:/dev/ttyUSB0?{options}")


def test_a_port_that_is_taken_and_one_that_is_told() -> None:
    with server() as hand, socket.create_server((LOCAL, 0)) as taken:
        port = taken.getsockname()[1]
        bus = make_bus(f"modbus:tcp://{LOCAL}:{hand.port}?gateway={port}", payload_size=600)
        with pytest.raises(BusNotAvailable, match=f"gateway: cannot listen on {LOCAL}:{port}"):
            bus.open()
        assert bus.fileno() == -1
        taken.close()
        bus.open()
        assert bus.note == f"gateway at {LOCAL}:{port}"
        bus.close()
