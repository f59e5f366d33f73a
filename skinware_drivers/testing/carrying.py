"""Emulated devices on a bus, in a thread: what a driver opens at the other end is a bus like any other."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import msgspec

from skinware_drivers.bus import Bus
from skinware_drivers.cli.emulation import Emulation
from skinware_drivers.serial.bus import PtyBus
from skinware_drivers.streams.tcp import TcpServerBus
from skinware_drivers.testing.defect import require
from skinware_drivers.virtual.hardware import load_emulator

_LONGEST_S = 30.0
_LONGEST_WRITE = 4096


class _Control:
    """Tells the path once the port is there, and ends the emulation."""

    def __init__(self) -> None:
        self.stopped = False
        self.ready = threading.Event()
        self.failure: BaseException | None = None
        self._event = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)

    def fileno(self) -> int:
        return self._event

    def event(self, name: str, **facts: Any) -> None:
        del facts
        if name == "ready":
            self.ready.set()

    def stop(self) -> None:
        self.stopped = True
        os.eventfd_write(self._event, 1)

    def close(self) -> None:
        os.close(self._event)


@contextmanager
def emulated_on_a_pty(emulator: Any, **options: Any) -> Iterator[str]:
    """Run emulated devices as long as the ``with`` lasts; yields the path of their serial port.

    Args:
        emulator: class or registered name of an emulator of serial devices.
        options: of the emulator.
    """
    factory = load_emulator(emulator) if isinstance(emulator, str) else emulator
    bus = PtyBus("", payload_size=_LONGEST_WRITE)
    with emulated_on(bus, factory, **options):
        yield bus.note.removeprefix("serial port ")


@contextmanager
def emulated_over_tcp(emulator: Any, **options: Any) -> Iterator[str]:
    """Run emulated devices as long as the ``with`` lasts; yields ``HOST:PORT``, where they can be called.

    Args:
        emulator: class or registered name of an emulator of serial or Modbus devices.
        options: of the emulator.
    """
    factory = load_emulator(emulator) if isinstance(emulator, str) else emulator
    bus = TcpServerBus("127.0.0.1:0", payload_size=_LONGEST_WRITE)
    with emulated_on(bus, factory, **options):
        yield bus.note.removeprefix("listens on ")


@contextmanager
def emulated_on(bus: Bus, emulator: Any, **options: Any) -> Iterator[None]:
    """Run emulated devices on a bus as long as the ``with`` lasts.

    Args:
        bus: not open yet.
        emulator: class of an emulator.
        options: of the emulator.
    """
    given = msgspec.convert(options, emulator.Options, strict=False)
    hardware, control = emulator(given), _Control()

    def run() -> None:
        try:
            Emulation(bus, hardware, control).run(control, bus_name=bus.name, driver=str(emulator), options=given)
        except BaseException as error:  # noqa: BLE001  (raised in the test)
            control.failure = error
            control.ready.set()

    thread = threading.Thread(target=run, name="emulated patch", daemon=True)
    thread.start()
    try:
        require(control.ready.wait(_LONGEST_S), "the emulated patch did not start")
        if control.failure is not None:
            raise control.failure
        yield
    finally:
        control.stop()
        thread.join(_LONGEST_S)
        control.close()
    require(not thread.is_alive(), "the emulated patch did not stop")
    if control.failure is not None:
        raise control.failure
