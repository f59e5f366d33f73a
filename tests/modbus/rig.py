"""Drivers of Modbus devices that run in a thread, of which a busy machine makes no silent devices."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
from pymodbus.simulator import SimDevice

from skinware import DriverReader
from skinware.sensor_types import PRESSURE
from skinware_drivers import Module, NoOptions, Patch, taxels
from skinware_drivers.link import Link
from skinware_drivers.modbus import ModbusAdapter, Registers
from skinware_drivers.operations import operation
from skinware_drivers.registry import make_bus
from skinware_drivers.testing.driving import Driving, EmulatedSkin, driving_lines, emulated_on_a_pty, emulated_skin
from skinware_drivers.testing.waiting import read_until
from tests.modbus.hands import FINGER_AT
from tests.modbus.peers import Action, device

N = 300
PATIENTLY = "timeout_ms=5000"
"""Option of a bus."""
PYMODBUS = [
    pytest.mark.usefixtures("namespace"),
    # pymodbus 3.16 leaves a question that came last unanswered, and its coroutine never awaited, when it is shut down
    pytest.mark.filterwarnings("ignore:.*ServerRequestHandler:pytest.PytestUnraisableExceptionWarning"),
    pytest.mark.filterwarnings("ignore:.*ServerRequestHandler:RuntimeWarning"),
]
"""Marks of modules that use its servers."""


class Palm(ModbusAdapter[NoOptions]):
    """300 taxels in one block: three reads."""

    types = (PRESSURE.measured(unit="counts"),)
    dtype = np.uint16
    patches = (Patch("palm", [Module(taxels(N))]),)
    registers = (Registers(FINGER_AT, N),)
    period_s = 0.01
    timeout_s = 5  # a busy machine is not a silent device

    @operation()
    async def set(self, link: Link, patches: object, address: int, value: int) -> int:
        """Write a register and read it again."""
        await self.write(link, address, [value])
        return int((await self.read(link, address))[0])


def palm(action: Action | None = None, unit: int = 1) -> SimDevice:
    return device(unit, FINGER_AT, range(1000, 1000 + N), action)


@contextmanager
def driven(name: str, adapter: ModbusAdapter[Any] | None = None, **more: Any) -> Iterator[tuple[Driving, DriverReader]]:
    """A driver on a bus, and a reader; it is called ``palm``."""
    adapter = adapter or Palm(NoOptions())
    bus = make_bus(name, payload_size=adapter.payload_size)
    with driving_lines([(adapter, bus)], "palm", **more) as driving, DriverReader("palm", timeout_s=30) as reader:
        yield driving, reader


@contextmanager
def patient(driver: str, emulator: Any = None, **options: Any) -> Iterator[EmulatedSkin]:
    """A driver on an emulated hand, which takes no busy machine for a hand that does not answer.

    Args:
        driver: its registered name.
        emulator: class of the hand; default: the one of that name.
        options: of the hand.
    """
    with emulated_on_a_pty(emulator or driver, **options) as port:
        with emulated_skin(driver, bus=with_options(f"modbus:{port}", PATIENTLY)) as skin:
            yield skin


def with_options(name: str, options: str) -> str:
    """The name of a bus with more options."""
    return f"{name}{'&' if '?' in name else '?'}{options}"


def until_right(reader: DriverReader) -> None:
    right = np.arange(1000, 1000 + N)
    read_until(reader, lambda frame: not frame.status.any() and (frame.values == right).all())


def counted(driving: Driving) -> dict[str, Any]:
    [bus] = driving.status()["buses"]
    return dict(bus)
