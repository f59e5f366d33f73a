"""Test what every driver must do: show right values in order, and show faults as faults.

::

    from skinware_drivers.testing.conformance import DriverConformance

    class TestMyDriver(DriverConformance):
        driver = MyDriver
        emulator = EmulatedMyDevice

Everything runs in this process, on an emulated bus, in time that passes only when nothing is left to do
(:mod:`.waiting`): a minute of data takes a moment, and a slow machine changes nothing.

The emulator is made with ``emulator(options, log=None, source=source)``, as :class:`skinware_drivers.virtual.emulator.
Emulator` is, and has ``Options``, ``numbers``, ``places()``, ``full_scale`` (and ``lowest``, if that is not 0) and
``restart(number, now_ns)``. It calls ``source(number, cycle)`` for the values of each burst of each device: the n-th
value is for the n-th sensor of the patch, and patches come in the order of ``numbers``.

The payloads of an emulator for a serial line are the bytes on the line, or the messages if it has a ``framing``.
"""

from __future__ import annotations

import numpy as np
import pytest

from skinware.status import Status
from skinware_drivers.testing.comparison import ShownUpdates, until_fresh
from skinware_drivers.testing.fault_tests import FaultTests, SilenceTests
from skinware_drivers.testing.life_tests import LifeTests
from skinware_drivers.testing.rig import Suite, extreme, in_its_time
from skinware_drivers.testing.torn_tests import TornTests
from skinware_drivers.testing.waiting import require
from skinware_drivers.virtual.hand_clock import HandClock

_BURSTS = 24
_SILENCE_S = 1.5
_RATE_TOLERANCE = 0.3
_NOTHING_OF_THESE = ("dropped", "errors", "refused", "unknown", "bad_length", "bad_content", "orphans", "late")


class ValueTests(Suite):
    """Every value that the devices send is shown, and no other."""

    @in_its_time
    async def test_every_value_is_right_and_in_order(self, clock: HandClock) -> None:
        """Each sensor shows its values, every burst is shown once, and no counter of faults grows."""
        async with self.running(clock) as rig:
            await until_fresh(rig)
            await rig.sleep(_BURSTS * rig.adapter.period_s)
            comparison = ShownUpdates(rig)
            comparison.require_right()
            comparison.require_complete()
            wrong = {name: n for name, n in rig.counters().items() if n and name in _NOTHING_OF_THESE}
            require(
                not wrong,
                f"good data was counted as faulty: {wrong}{rig.samples_in_words()}: does the layout"
                " know every frame and every length that the devices send?",
            )
            self.require_all_counted(rig)

    @in_its_time
    async def test_extreme_values(self, clock: HandClock) -> None:
        """Least and greatest values, alternating bits, and the sign bit alone are shown as they were sent."""
        async with self.running(clock, pattern=extreme) as rig:
            await until_fresh(rig)
            await rig.sleep(24 * rig.adapter.period_s)
            ShownUpdates(rig).require_right()

    @in_its_time
    async def test_nothing_is_valid_before_the_first_data(self, clock: HandClock) -> None:
        """Every sensor is NEVER_SEEN before data comes, and data makes only its own sensors valid."""
        rig = self.running(clock)
        bursts = rig.truth.bursts  # before the first of them, all frames are answers
        rig.wire.keep = lambda _identifier, _payload: not bursts
        async with rig:
            await rig.sleep(_SILENCE_S)
            for frame in rig.record.frames:
                seen = np.flatnonzero((frame.status & Status.NEVER_SEEN) == 0)
                require(
                    not len(seen),
                    f"{len(seen)} sensors are shown as seen before any data came, with values"
                    f" {frame.values[seen[:4]].tolist()}: nothing may be filled in beforehand",
                )
            passed: set[tuple[int, bytes]] = set()

            def first_of_each_burst(identifier: int, payload: bytes) -> bool:
                if not bursts:
                    return True
                passed.add((identifier, payload[:1]))
                return (identifier, payload[:1]) == min(passed)

            rig.wire.keep = first_of_each_burst
            await rig.sleep(_SILENCE_S)
            rig.wire.keep = lambda _identifier, _payload: True
            await until_fresh(rig)
            ShownUpdates(rig).require_right(
                "with most frames missing on the wire, sensors without a frame of theirs were filled in"
            )

    @in_its_time
    async def test_the_rate_is_the_declared_one(self, clock: HandClock) -> None:
        """Updates come every ``period_s``: readers, staleness and pairing depend on it."""
        async with self.running(clock) as rig:
            await until_fresh(rig)
            await rig.sleep(2 * _BURSTS * rig.adapter.period_s)
            for number in rig.numbers:
                intervals_ns = np.diff([burst.time_ns for burst in rig.truth.bursts[number]][-_BURSTS:])
                # without pauses; single intervals say less: a bus delivers the frames of some milliseconds together
                real_s = float(np.mean(intervals_ns[intervals_ns < 2 * np.median(intervals_ns)])) / 1e9
                require(
                    abs(real_s / rig.adapter.period_s - 1) < _RATE_TOLERANCE,
                    f"`period_s` is {rig.adapter.period_s:g} s, but device {number} sends every {real_s:.3g} s",
                )


@pytest.mark.usefixtures("namespace")
class DriverConformance(SilenceTests, TornTests, FaultTests, LifeTests, ValueTests):
    """Test a driver: make a subclass that names the driver and the emulator.

    pytest begins with the tests of the last base class.

    Attributes:
        emulator: emulated hardware for it; see this module's docstring.
        driver_options: options of the driver, as in a configuration file.
        emulator_options: options of the emulator, beside those that the tests set.
    """
