"""Drivers of Modbus devices pass what all drivers must."""

from __future__ import annotations

from tests.modbus.hands import Array, EmulatedArray, EmulatedHand, Hand
from tests.specification.path_tests import DriverConformance


class TestArray(DriverConformance):
    driver = Array
    emulator = EmulatedArray


class TestHandOfTwoUnits(DriverConformance):
    driver = Hand
    emulator = EmulatedHand
