"""Every driver with its emulator on a real (virtual) CAN bus."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from skinware import DriverReader
from skinware_drivers.registry import load_driver, make_bus
from skinware_drivers.virtual.emulation import Emulation
from skinware_drivers.virtual.hardware import load_emulator
from tests.sdk.driving import driving_lines, read_until

pytestmark = [pytest.mark.can, pytest.mark.timeout(200)]

FRAMES = 10


class Stop:
    """Ends an emulation."""

    def __init__(self) -> None:
        self.stopped = False
        self._fd = os.eventfd(0)

    def fileno(self) -> int:
        return self._fd

    def stop(self) -> None:
        self.stopped = True
        os.eventfd_write(self._fd, 1)

    def close(self) -> None:
        os.close(self._fd)


class Events:
    """Notes what an emulation reports."""

    def __init__(self) -> None:
        self.ready = threading.Event()
        self.last: dict[str, Any] = {}

    def event(self, name: str, **facts: Any) -> None:
        self.last = facts
        if name == "ready":
            self.ready.set()


@contextmanager
def emulating(driver: str, bus: str, **options: Any) -> Iterator[Events]:
    emulator = load_emulator(driver)
    chosen = emulator.Options(**options)
    emulation, stop, events = Emulation(make_bus(bus), emulator(chosen), (report := Events()).event), Stop(), report
    keywords = {"bus_name": bus, "driver": driver, "options": chosen}
    thread = threading.Thread(target=emulation.run, args=(stop,), kwargs=keywords, daemon=True)
    thread.start()
    try:
        assert events.ready.wait(60)
        yield events
    finally:
        stop.stop()
        thread.join(60)
        stop.close()


@pytest.mark.parametrize(
    ("driver", "n_sensors", "options", "emulated"),
    [
        ("barrett", 96, {"period_ms": 200}, {}),
        ("canopen", 32, {"nodes": (5, 6), "period_ms": 100, "heartbeat_ms": 1000}, {}),
        ("cyskin_cpm", 16, {"period_ms": 100}, {"period_ms": 100}),
        ("linkerhand", 360, {"ask": True, "period_ms": 200}, {"program_ms": 0}),
        ("xela", 48, {"period_ms": 100}, {"period_ms": 100}),
    ],
)
def test_a_driver_and_its_emulator(
    vcan: Callable[[], str],
    driver: str,
    n_sensors: int,
    options: dict[str, Any],
    emulated: dict[str, Any],
) -> None:
    bus, adapter = vcan(), load_driver(driver)
    with emulating(driver, bus, pattern="idle", **emulated) as emulator:
        with driving_lines([(adapter(adapter.Options(**options)), make_bus(bus))], driver, wait=False) as running:
            assert running.ready.wait(120)
            with DriverReader(driver) as reader:
                frame = read_until(reader, lambda f: not f.status.any())
                assert len(frame.values) == n_sensors
                again = read_until(reader, lambda f: not f.status.any() and f.sequence > frame.sequence + FRAMES)
                assert (again.values == frame.values).all()  # nobody touches it
            (shown,) = running.status()["buses"]
    # on a starved machine answers come after the question was given up; nobody knows them then, but nothing is damaged
    assert shown["dropped"] == shown["bad_length"] == shown["bad_content"] == shown["errors"] == 0
    assert emulator.last["send_failures"] == 0
