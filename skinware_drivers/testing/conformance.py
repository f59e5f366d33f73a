"""What every driver must do with its devices, whatever they are: right values in order, and honesty about faults.

::

    from skinware_drivers.testing.conformance import DriverConformance

    class TestMyDriver(DriverConformance):
        driver = MyDriver
        emulator = EmulatedMyDevice

Everything runs in this process, on an emulated bus, and in time that passes only when nothing is left to be done
(:mod:`.clock`): a minute of data takes a moment, and a slow machine changes nothing.

The emulator is made with ``emulator(options, log=None, source=source)``, as :class:`skinware_drivers.virtual.emulator.
Emulator` is, and has ``Options``, ``numbers``, ``places()``, ``full_scale`` (and ``lowest``, if that is not 0) and
``restart(number, now_ns)``. It calls ``source(number, cycle)`` for the values of each burst of each device: the n-th
value is that of the n-th sensor of the patch, and patches come in the order of ``numbers``.

The payloads of an emulator for a serial line are the bytes on the line; or, if it has a ``framing``, the messages.
"""

from __future__ import annotations

import pytest

from skinware_drivers.testing.fault_tests import FaultTests, SilenceTests
from skinware_drivers.testing.life_tests import LifeTests
from skinware_drivers.testing.torn_tests import TornTests
from skinware_drivers.testing.value_tests import ValueTests


@pytest.mark.usefixtures("namespace")
class DriverConformance(SilenceTests, TornTests, FaultTests, LifeTests, ValueTests):
    """Tests for a driver. Subclass it, say which driver and which emulator, and nothing else.

    pytest begins with those of the last base class.

    Attributes:
        driver: the adapter class.
        emulator: emulated hardware for it; see this module's docstring.
        driver_options: options of the driver, as in a configuration file.
        emulator_options: options of the emulator, beside what the tests need.
    """
