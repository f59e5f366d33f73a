"""Wires of every kind, captured and decoded again: to the last value the same. Those of CAN: tests/can."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from skinware_drivers.registry import load_driver, make_bus
from skinware_drivers.testing.carrying import emulated_on, emulated_on_a_pty
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
