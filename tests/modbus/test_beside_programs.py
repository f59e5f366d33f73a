"""Hands of makers, on a line on which another program (pymodbus) moves them: through the gateway, or overheard."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pymodbus.client import ModbusSerialClient, ModbusTcpClient

from skinware import DriverReader, DriverSnapshot, Status
from skinware_drivers.modbus.adapter import ModbusAdapter
from skinware_drivers.modbus.dfrobot import DfrobotDriver, DfrobotOptions
from skinware_drivers.modbus.inspire import InspireDriver, InspireOptions
from skinware_drivers.modbus.revo2 import Revo2Driver, Revo2Options
from skinware_drivers.modbus.revo3 import Revo3Driver, Revo3Options
from skinware_drivers.modbus.wire import READ_INPUT
from skinware_drivers.testing.waiting import read_until
from tests.modbus import test_dfrobot as dfrobot
from tests.modbus import test_inspire as inspire
from tests.modbus import test_revo2 as revo2
from tests.modbus import test_revo3 as revo3
from tests.modbus.peers import device, line, rtu_server, rtu_server_on, tcp_server
from tests.modbus.rig import PATIENTLY, PYMODBUS, counted, driven, with_options
from tests.streams.peers import LOCAL

pytestmark = PYMODBUS
BAUDRATE = 460_800
MOVES, ANGLE = 5, 1234


@dataclass(frozen=True)
class Hand:
    """One kind of hand.

    Attributes:
        adapter: makes a driver of it.
        server: makes a hand.
        unit: its number.
        right: what the sensors show of it.
        asks: function, address and count of the reads by which another program gets all of its touch.
        moves: a register that is not of its touch.
    """

    adapter: Callable[[], ModbusAdapter[Any]]
    server: Callable[[], Any]
    unit: int
    right: Sequence[float]
    asks: Sequence[tuple[int, int, int]]
    moves: int


HANDS = {
    "inspire": Hand(
        lambda: InspireDriver(InspireOptions(period_ms=20)),
        lambda: device(1, 3000, [0] * 3000, inspire.count_bytes),
        1,
        inspire.right().tolist(),
        [(3, 3000 + 250 * number, min(125, inspire.N - 125 * number)) for number in range(9)],
        5500,
    ),
    "revo2": Hand(
        lambda: Revo2Driver(Revo2Options(side="left")),
        lambda: revo2.hand_of(revo2.WORDS),
        126,
        [*revo2.FORCES, *revo2.PROXIMITIES],
        [(READ_INPUT, 4200, 30)],
        4100,
    ),
    "revo3": Hand(
        lambda: Revo3Driver(Revo3Options(period_ms=20, mapping="pressure")),
        lambda: device(1, 101, revo3.registers().tolist()),
        1,
        list(range(1, 417)),
        [(READ_INPUT, begin, n) for begin, n in zip(revo3.BEGINS, revo3.POINTS, strict=True)],
        5100,
    ),
    "dfrobot": Hand(
        lambda: DfrobotDriver(DfrobotOptions(shapes=("6x6",))),
        lambda: dfrobot.array(1, range(101, 137), model=1),
        1,
        np.arange(101, 137).reshape(6, 6)[::-1].ravel().tolist(),
        [(READ_INPUT, 7, 36)],
        2,
    ),
}


@pytest.fixture(params=HANDS)
def hand(request: pytest.FixtureRequest) -> Hand:
    return HANDS[request.param]


def until_right(reader: DriverReader, hand: Hand) -> None:
    """A frame that was read from now on, however long another program took for all of it."""
    now_ns = time.monotonic_ns()
    read_until(
        reader,
        lambda frame: (
            bool((frame.module_time_ns > now_ns).all())
            and not (frame.status & ~np.uint8(Status.STALE)).any()
            and np.array_equal(frame.values, hand.right)
        ),
    )


def test_a_program_moves_the_hand_through_the_gateway(hand: Hand, tmp_path: Path) -> None:
    port = tmp_path / "hand"
    with rtu_server(hand.server(), baudrate=BAUDRATE) as name:
        gateway = with_options(with_options(name, PATIENTLY), f"gateway={port}")
        with driven(gateway, hand.adapter()) as (_, reader):
            until_right(reader, hand)
            with ModbusSerialClient(str(port), baudrate=BAUDRATE, timeout=30, retries=0) as program:
                for angle in range(ANGLE, ANGLE + MOVES):
                    program.write_register(hand.moves, angle, device_id=hand.unit)
                    told = program.read_holding_registers(hand.moves, count=1, device_id=hand.unit)
                    assert told.registers == [angle]
            until_right(reader, hand)


def test_nothing_wrong_is_shown_from_a_line_that_loses_damages_and_repeats(hand: Hand) -> None:
    """Of thirteen replies one is lost, one damaged, and one comes behind the reply before, if they have one length."""
    replies = list[bytes]()

    def disturb(reply: bytes) -> bytes:
        replies.append(reply)
        before, turn = replies[max(0, len(replies) - 2)], len(replies) % 13
        if turn == 4 and len(before) == len(reply) > 30:
            return before + reply
        return b"" if turn == 8 else reply[:-1] + bytes([reply[-1] ^ 1]) if turn == 0 else reply

    def has_seen_enough(frame: DriverSnapshot) -> bool:
        assert np.array_equal(frame.values, hand.right)
        counts = counted(driving)
        return bool(counts["refused"]) and min(counts["polls_unanswered"], counts["checksum_errors"]) >= 3

    with line() as between, rtu_server_on(between.other, hand.server(), baudrate=BAUDRATE):
        name = f"modbus:{between.one}?baudrate={BAUDRATE}&timeout_ms=100"
        with driven(name, hand.adapter()) as (driving, reader):
            until_right(reader, hand)
            between.disturb = disturb
            read_until(reader, has_seen_enough)


def test_a_program_moves_the_hand_over_a_connection_of_its_own() -> None:
    hand = HANDS["inspire"]
    with tcp_server(hand.server()) as name, driven(with_options(name, PATIENTLY), hand.adapter()) as (driving, reader):
        until_right(reader, hand)
        with ModbusTcpClient(LOCAL, port=int(name.rpartition(":")[2]), timeout=30, retries=0) as program:
            for angle in range(ANGLE, ANGLE + MOVES):
                program.write_register(hand.moves, angle, device_id=hand.unit)
                until_right(reader, hand)
        assert counted(driving)["refused"] == 0


def test_what_a_program_reads_is_overheard(hand: Hand) -> None:
    stop = threading.Event()
    with line() as between, rtu_server_on(between.other, hand.server(), baudrate=BAUDRATE):

        def move() -> None:
            with ModbusSerialClient(between.one, baudrate=BAUDRATE, timeout=5) as program:
                ask = {3: program.read_holding_registers, READ_INPUT: program.read_input_registers}
                while not stop.is_set():
                    program.write_register(hand.moves, ANGLE, device_id=hand.unit)
                    for function, address, count in hand.asks:
                        ask[function](address, count=count, device_id=hand.unit)
                    time.sleep(0.005)

        program = threading.Thread(target=move)
        program.start()
        try:
            name = f"modbus:{between.tap}?baudrate={BAUDRATE}&listen=yes"
            with driven(name, hand.adapter(), wait=False) as (driving, reader):
                until_right(reader, hand)
                assert counted(driving)["sent"] == 0
        finally:
            stop.set()
            program.join(30)
        assert between.from_tap == b""
