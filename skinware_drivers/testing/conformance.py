"""Test what every driver must do: show right values in order, and show faults as faults.

::

    from skinware_drivers.testing.conformance import DriverConformance

    class TestMyDriver(DriverConformance):
        driver = MyDriver
        emulator = EmulatedMyDevice

Everything runs in this process, on an emulated bus, in time that passes only when nothing is left to do
(:mod:`.clock`): a minute of data takes a moment, and a slow machine changes nothing.

The emulator is made with ``emulator(options, log=None, source=source)``, as :class:`skinware_drivers.virtual.emulator.
Emulator` is, and has ``Options``, ``numbers``, ``places()``, ``full_scale`` (and ``lowest``, if that is not 0) and
``restart(number, now_ns)``. It calls ``source(number, cycle)`` for the values of each burst of each device: the n-th
value is for the n-th sensor of the patch, and patches come in the order of ``numbers``.

The payloads of an emulator for a serial line are the bytes on the line, or the messages if it has a ``framing``.
"""

from __future__ import annotations

import pytest

from skinware_drivers.testing.fault_tests import FaultTests, SilenceTests
from skinware_drivers.testing.life_tests import LifeTests
from skinware_drivers.testing.torn_tests import TornTests
from skinware_drivers.testing.value_tests import ValueTests


@pytest.mark.usefixtures("namespace")
class DriverConformance(SilenceTests, TornTests, FaultTests, LifeTests, ValueTests):
    """Test a driver: make a subclass that names the driver and the emulator.

    pytest begins with the tests of the last base class.

    Attributes:
        emulator: emulated hardware for it; see this module's docstring.
        driver_options: options of the driver, as in a configuration file.
        emulator_options: options of the emulator, beside those that the tests set.
    """
