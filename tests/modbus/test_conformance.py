"""Drivers of Modbus devices pass what all drivers must."""

from __future__ import annotations

from skinware_drivers.testing.conformance import DriverConformance
from tests.modbus.hands import Array, EmulatedArray, EmulatedHand, Hand


class TestArray(DriverConformance):
    driver = Array
    emulator = EmulatedArray


class TestHandOfTwoUnits(DriverConformance):
    driver = Hand
    emulator = EmulatedHand
