"""Mistakes that are usual in a driver of a Modbus device, and in the name of its bus: each is said in words."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from skinware.errors import ConfigurationError
from skinware.sensor_types import PRESSURE
from skinware_drivers import Module, NoOptions, Patch, taxels
from skinware_drivers.modbus import ModbusAdapter, Registers
from skinware_drivers.registry import make_bus


class Fingertip(ModbusAdapter[NoOptions]):
    """Twelve taxels."""

    types = (PRESSURE.measured(unit="counts"),)
    dtype = np.uint16
    patches = (Patch("finger", [Module(taxels(12))]),)
    registers = (Registers(7, 12),)


def mistaken(**declared: Any) -> Callable[[], None]:
    """Makes and checks a driver with other declarations."""
    driver: Callable[[NoOptions], ModbusAdapter[NoOptions]] = type("Fingertip", (Fingertip,), declared)
    return lambda: driver(NoOptions()).check()


def block(*numbers: Any, **more: Any) -> Callable[[], None]:
    """Likewise, with another block of registers."""
    return mistaken(registers=[Registers(*numbers, **more)])


def test_without_mistakes_nothing_is_said() -> None:
    mistaken()()
    block(0xFFFF - 11, 12)()
    block(np.int64(7), np.int64(12), unit=255)()


@pytest.mark.parametrize(
    ("check", "told"),
    [
        (block(7, 13), r"channel 12, and a module of 'finger' has 12 channels"),
        (block(7, 12, unit=256), r"registers 7 of unit 256: units have numbers from 1 to 247"),
        (block(7, 12, unit=-1), r"units have numbers from 1 to 247"),
        (block(7, 12, function=6), r"function 6: registers are read with 3 or 4"),
        (block(-1, 12), r"registers -1 of unit 1: the last of 12 is 10, and addresses go from 0 to 65535"),
        (block(65530, 12), r"the last of 12 is 65541, and addresses go from 0 to 65535; a manual's 40001"),
        (block(400001, 12), r"a manual's 40001, or 400001, is 0"),
        (mistaken(registers=[Registers(65520, 12)], address_step=2), r"the last of 12 is 65542"),
        (block(7, 0), r"count = 0: how many registers are there\?"),
        (block(7, 11, dtype="f4"), r"count = 11: how many registers are there, 2 for each f4\?"),
        (block(7, 12, every=0), r"every = 0: 1 is in each cycle"),
        (block(7, "12"), r"registers 7 of unit 1: count = '12' is no whole number"),
        (block(7.5, 12), r"address = 7.5 is no whole number"),
        (block(7, 12, patch=3), r"registers 7 of unit 1: no patch has the key 3; there are: \[0\]"),
        (block(7, 12, module=2), r"no module has the key 2; there are: \[0\]"),
        (
            mistaken(registers=[Registers(7, 8), Registers(40, 8, to=range(4, 12))]),
            r"registers 7 of unit 1 and registers 40 of unit 1 both have the value of channel 4: say which patch",
        ),
        (mistaken(registers=Registers(7, 12)), r"Fingertip: `registers` is a list of Registers\(address, count"),
        (mistaken(registers=[(7, 12)]), r"Fingertip: `registers` is a list"),
        (mistaken(most_registers=126), r"Fingertip: most_registers = 126: give 1 to 125"),
        (mistaken(address_step=0), r"Fingertip: address_step = 0: give 1 to 65535"),
        (mistaken(largest_gap="x"), r"Fingertip: largest_gap = 'x': give 0 to 65535"),
        (mistaken(timeout_s=-1), r"Fingertip: timeout_s = -1: give 1e-06 to 3600"),
        (mistaken(period_s=0), r"Fingertip: period_s = 0: give"),
        (mistaken(byte_order="<"), r"Fingertip: byte_order = '<': give big or little"),
        (mistaken(word_order="middle"), r"Fingertip: word_order = 'middle': give big or little"),
    ],
)
def test_a_mistake_in_a_driver_is_said_in_words(check: Callable[[], None], told: str) -> None:
    with pytest.raises(ConfigurationError, match=told):
        check()


def test_blocks_of_several_patches_may_have_the_same_channels() -> None:
    patches = [Patch(f"finger {key}", [Module(taxels(12, first_uid=100 * key))], key=key) for key in (1, 2)]
    mistaken(patches=patches, registers=[Registers(7, 12, unit=key, patch=key) for key in (1, 2)])()


@pytest.mark.parametrize(
    ("name", "told"),
    [
        (
            "modbus:10.0.0.2:502",
            r"over TCP that is modbus:tcp://10\.0\.0\.2:502, and a serial port modbus:/dev/ttyUSB0",
        ),
        ("modbus:tcp:/10.0.0.2", r"over TCP that is modbus:tcp://10\.0\.0\.2,"),
        ("modbus:", r"over TCP that is modbus:tcp://HOST, and a serial port modbus:/dev/ttyUSB0"),
        ("modbus:ttyUSB0", r"or modbus:\./ttyUSB0"),
        ("modbus:tcp://::1:502", r"an IPv6 address stands in brackets; write modbus:tcp://HOST:PORT"),
        ("modbus:tcp://host:abc", r"'abc' is no port number"),
        ("modbus:tcp://host:99999", r"ports have numbers up to 65535"),
        ("modbus:tcp://host:502&byte_order=little", r"options begin with a question mark"),
        ("modbus:tcp://host?byte_order=middle", r"option byte_order=middle: give one of big, little$"),
        ("modbus:tcp://host?byte_ordr=little", r"did you mean 'byte_order'\?"),
        ("modbus:/dev/ttyUSB0?baudrate=fast", r"option baudrate=fast: give a whole number$"),
        ("modbus:/dev/ttyUSB0?baud=9600", r"did you mean 'baudrate'\? There are: baudrate, byte_order"),
        ("modbus:tcp://host?gateway=abc", r"gateway=abc: which port\? Give PORT, HOST:PORT, or a path"),
    ],
)
def test_a_mistake_in_a_name_is_said_in_words(name: str, told: str) -> None:
    with pytest.raises(ConfigurationError, match=told):
        make_bus(name)


def test_a_line_has_no_unit_0_and_a_connection_may_have_one() -> None:
    driver = type("Fingertip", (Fingertip,), {"registers": [Registers(7, 12, unit=0)]})(NoOptions())
    driver.fit(make_bus("modbus:tcp://10.0.0.2"))
    with pytest.raises(ConfigurationError, match="unit 0 means all units of a line, and none answers"):
        driver.fit(make_bus("modbus:/dev/ttyUSB0"))
