"""Wires of every kind, captured and decoded again: to the last value the same. Those of CAN: tests/can."""

from __future__ import annotations

import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from skinware_drivers.proving.captures import check_capture
from skinware_drivers.registry import load_driver, make_bus
from skinware_drivers.streams.tcp import TcpBus
from skinware_drivers.testing.driving import emulated_on, emulated_on_a_pty
from skinware_drivers.virtual.hardware import load_emulator
from tests.recording.test_wire_replay import record, require_equal
from tests.streams.peers import LOCAL, free_port

FRAMES = 20


@contextmanager
def devices(emulator: str, wire: str) -> Iterator[str]:
    """Emulated devices at the other end of a wire; the name of the bus for their driver."""
    if wire in ("serial", "modbus"):
        with emulated_on_a_pty(emulator) as path:
            yield f"{wire}:{path}"
        return
    port = free_port(socket.SOCK_DGRAM if wire == "udp" else socket.SOCK_STREAM)
    where = {"websocket": "websocket:ws"}.get(wire, wire)
    end = make_bus(f"{where}://{LOCAL}:{port}", payload_size=4096, for_devices=True)
    with emulated_on(end, load_emulator(emulator)):
        yield f"udp://:{port}" if wire == "udp" else f"{where}://{LOCAL}:{port}"


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("wire", "driver", "emulator", "options"),
    [
        ("serial", "weiss_wts", "", {}),
        ("serial", "tactile_glove", "", {}),
        ("tcp", "tesollo", "", {}),
        ("tcp", "weiss_dsa", "", {}),
        ("udp", "allegro_v5", "allegro_v5_udp", {"side": "right"}),
        ("udp", "icub_eth", "", {}),
        ("websocket", "xela_server", "", {}),
        ("modbus", "dfrobot", "", {}),
        ("modbus", "revo2", "", {}),
        ("modbus:tcp", "inspire", "", {}),
    ],
)
def test_a_wire_that_was_captured_is_decoded_to_the_same_values(
    wire: str, driver: str, emulator: str, options: dict[str, Any], tmp_path: Path
) -> None:
    kind = load_driver(driver)
    kind = next(one for one in (kind, *kind.elsewhere) if one.medium != "can")

    def capture(file: Path) -> None:
        with devices(emulator or driver, wire) as name:
            adapter = kind(kind.Options(**options))
            record(file, adapter, make_bus(name, payload_size=adapter.payload_size), FRAMES)

    require_equal(tmp_path, capture, kind, options)


class HeldUp(TcpBus):
    """Of a machine that is too busy: now and then it goes on when the answer to its question is long there."""

    asked = 0

    def send(self, identifier: int, payload: bytes) -> None:
        super().send(identifier, payload)
        self.asked += 1
        if self.asked % 10 == 0:
            time.sleep((0.06, 0.15, 0.4)[self.asked // 10 % 3])


@pytest.mark.thorough
def test_a_driver_that_is_held_up_captures_what_is_decoded_to_the_same_values(tmp_path: Path) -> None:
    """It reads answers when it would have given them up; a replay that gave them as late would lose them."""
    kind, file = load_driver("tesollo"), tmp_path / "held.mcap"
    with devices("tesollo", "tcp") as name:
        adapter = kind(kind.Options())
        bus = HeldUp(name.removeprefix("tcp://"), payload_size=adapter.payload_size)
        record(file, adapter, bus, 80)
    assert bus.asked > 60
    compared, _ = check_capture(file, kind)
    assert compared.difference is None
    assert compared.compared >= 5 * 60
