"""Every driver over its real bus, whose devices turn bad: counted, bounded, recovered, and ended at once."""

from __future__ import annotations

import resource
import signal
import socket
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import pytest

from skinware.driver_service import DriverReader
from skinware.driver_snapshot import DriverSnapshot
from skinware.status import Status
from skinware_drivers.loading import registered
from skinware_drivers.registry import DRIVERS
from skinware_drivers.testing.waiting import SLOWER, read_until
from tests.commands import running
from tests.drivers.hostile_wire import hostile_devices, processor_s, resident_bytes
from tests.streams.peers import free_port

_NOT_FRESH = np.uint8(Status.STALE | Status.NEVER_SEEN)
_PATIENCE_S = 30 * SLOWER
_FLOOD_FRAMES, _FLOOD_BYTES = 2_000, 1 << 20
_MOST_MEMORY = 48 << 20
_MOST_PROCESSOR_S = 1.0  # from SIGTERM to the end


class Place(NamedTuple):
    """Where a driver meets its devices."""

    devices_bus: str
    driver_bus: str


def _pty(folder: Path) -> Place:
    return Place(f"pty:{folder}/port", f"serial:{folder}/port")


def _modbus_line(folder: Path) -> Place:
    return Place(f"pty:{folder}/port", f"modbus:{folder}/port")


def _modbus_tcp(_folder: Path) -> Place:
    port = free_port()
    return Place(f"modbus:tcp://127.0.0.1:{port}", f"modbus:tcp://127.0.0.1:{port}")


def _tcp(_folder: Path) -> Place:
    port = free_port()
    return Place(f"tcp://127.0.0.1:{port}", f"tcp://127.0.0.1:{port}")


def _udp(_folder: Path) -> Place:
    device, host = free_port(socket.SOCK_DGRAM), free_port(socket.SOCK_DGRAM)
    return Place(f"udp://127.0.0.1:{host}?local={device}", f"udp://127.0.0.1:{device}?local={host}")


def _websocket(_folder: Path) -> Place:
    port = free_port()
    return Place(f"websocket:ws://127.0.0.1:{port}", f"websocket:ws://127.0.0.1:{port}")


def _yarp(_folder: Path) -> Place:
    port = free_port()
    return Place(f"yarp://127.0.0.1:{port}/hostile/skin", f"yarp://127.0.0.1:{port}/hostile/skin")


class Case(NamedTuple):
    """A driver, the bus that it is on, and options of its emulator and its own."""

    place: Any
    emulator: Mapping[str, Any] = MappingProxyType({})
    driver: tuple[str, ...] = ()


_LINE = Case(_pty)
CASES = {
    **dict.fromkeys(
        ("ability_hand", "agni", "anyskin", "flexitac", "openpatch", "paxini", "skintalk", "tactile_glove"),
        _LINE,
    ),
    **dict.fromkeys(("dex3", "robotiq_tsf", "ros2", "weiss_dsa", "weiss_wts", "wuji_glove"), _LINE),
    "papillarray": Case(_pty, {"period_ms": 10}, ("--rate-hz", "100")),
    "dev001": Case(_pty, driver=("--rate-hz", "100")),
    "dfrobot": Case(_modbus_line),
    "inspire": Case(_modbus_tcp),
    "revo2": Case(_modbus_line),
    "revo3": Case(_modbus_line),
    "icub_eth": Case(_udp),
    "tesollo": Case(_tcp),
    "xela_server": Case(_websocket),
    "yarp": Case(_yarp),
}
CAN_CASES = {
    **dict.fromkeys(("allegro_v5", "barrett", "canopen", "cyskin_cpm", "linkerhand", "xela"), Case(None)),
    "roboskin": Case(None, {"boards": (7,)}),
}


def test_every_driver_has_its_case() -> None:
    assert sorted({*CASES, *CAN_CASES}) == sorted(registered(DRIVERS))


@pytest.mark.thorough
@pytest.mark.parametrize("driver", sorted(CASES))
def test_bad_devices(driver: str, tmp_path: Path) -> None:
    case = CASES[driver]
    _meet(driver, case, case.place(tmp_path), _FLOOD_BYTES)


@pytest.mark.thorough
@pytest.mark.parametrize("driver", sorted(CAN_CASES))
def test_bad_devices_on_can_over_multicast(driver: str) -> None:
    name = f"udp_multicast:239.74.163.2?port={free_port(socket.SOCK_DGRAM)}"
    _meet(driver, CAN_CASES[driver], Place(name, name), _FLOOD_FRAMES)


def _meet(driver: str, case: Case, place: Place, amount: int) -> None:
    with hostile_devices(driver, place.devices_bus, **case.emulator) as devices:
        with running("skin-driver", "--driver", driver, "--bus", place.driver_bus, *case.driver) as run:
            run.wait_for("ready")
            pid = run.process.pid
            with DriverReader(driver) as reader:
                read_until(reader, _is_fresh, _PATIENCE_S)
                memory, before = resident_bytes(pid), _refusals(reader)
                devices.flood(amount)
                after = read_until(reader, lambda frame: _refusals(reader, frame) > before, _PATIENCE_S)
                assert run.process.poll() is None, run.errors
                read_until(reader, lambda frame: frame.sequence > after.sequence and _is_fresh(frame), _PATIENCE_S)
                devices.flood(amount)
                assert resident_bytes(pid) - memory < _MOST_MEMORY

                devices.turn("doubled")
                doubled = reader.read()
                read_until(reader, lambda frame: frame.sequence > doubled.sequence + 20, _PATIENCE_S)
                devices.turn("sound")
                read_until(reader, _is_fresh, _PATIENCE_S)

                devices.vanish()
                read_until(reader, lambda frame: bool((frame.status & _NOT_FRESH).all()), _PATIENCE_S)
                devices.appear()
                read_until(reader, _is_fresh, _PATIENCE_S)
            devices.turn("flood")
            children = _children_s()
            used = processor_s(pid)
            last = run.stop(signal.SIGTERM)
            devices.turn("sound")
            assert run.process.returncode == 0, run.errors
            assert last["event"] == "stopped"
            assert _children_s() - children - used < _MOST_PROCESSOR_S * SLOWER
            assert "Traceback" not in run.errors


def _is_fresh(frame: DriverSnapshot) -> bool:
    return not (frame.status & _NOT_FRESH).any()


def _refusals(reader: DriverReader, frame: DriverSnapshot | None = None) -> int:
    """Everything that came and was not used."""
    shown = reader.read() if frame is None else frame
    names = ("unknown", "bad_length", "bad_content", "refused", "bad_form", "checksum_errors", "skipped_bytes")
    return sum(int(counters.get(name, 0)) for counters in reader.bus_counters(shown) for name in names)


def _children_s() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime
