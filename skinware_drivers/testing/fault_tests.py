"""That damage on the wire costs no more than it must, and is never shown as data."""

from __future__ import annotations

from collections.abc import Collection

import pytest

from skinware_drivers.testing.comparison import Comparison
from skinware_drivers.testing.defect import require
from skinware_drivers.testing.rig import Running, play
from skinware_drivers.testing.suite import Suite
from skinware_drivers.testing.wire import Fault, foreign_identifiers
from skinware_drivers.virtual.hand_clock import HandClock

_BURSTS = 24
_DAMAGES = 8
_BETWEEN_DAMAGES = 5


class FaultTests(Suite):
    """Lost, damaged, repeated and foreign frames."""

    @pytest.mark.parametrize("fault", ["lost", "truncated", "repeated"])
    def test_a_damaged_frame_costs_its_own_burst_only(self, fault: Fault) -> None:
        """Frames that are lost, cut short, or come twice: nothing torn is shown, every whole burst is."""

        async def scenario(clock: HandClock) -> None:
            async with self.running(clock) as rig:
                await self._damage(rig, fault)
                comparison = Comparison(rig)
                comparison.require_right(f"frames were {fault} on the wire")
                comparison.require_complete(comparison.spoilt(), f" (others were {fault})")
                if fault == "truncated" and rig.adapter.medium == "can":
                    right = {length for frame in rig.adapter.layout.frames for length in frame.length}
                    least = sum(len(damage.payload) not in right for damage in rig.wire.damages)
                    counted = rig.counters()["bad_length"]
                    require(
                        least <= counted <= len(rig.wire.damages),
                        f"{least} frames were cut to lengths that the layout does not know, and {counted} were counted"
                        " as of wrong length",
                    )
                self.require_all_counted(rig)

        play(scenario)

    def test_garbage_raises_nothing(self) -> None:
        """Random bytes under the devices' own identifiers: no exception, and all other bursts are right."""

        async def scenario(clock: HandClock) -> None:
            async with self.running(clock) as rig:
                await self._damage(rig, "garbage")
                comparison = Comparison(rig)
                spoilt = comparison.spoilt()
                for update in comparison.wrong:
                    shown_ns = int(rig.record.frames[update.frame].module_time_ns[update.module])
                    require(
                        spoilt(shown_ns - rig.period_ns) or spoilt(shown_ns),
                        "values that were never sent are shown, long after the last garbage: does the driver keep state"
                        " that one bad frame spoils for good?",
                    )
                comparison.require_complete(spoilt, " (others were garbage)")
                self.require_all_counted(rig)

        play(scenario)

    def test_foreign_frames_disturb_nothing(self) -> None:
        """Other devices on the bus (on a serial line: noise between frames) are counted and change nothing."""
        if self.driver.medium == "virtual":
            return  # nobody else is there

        async def scenario(clock: HandClock) -> None:
            rig = self.running(clock)
            if rig.adapter.medium in ("serial", "modbus"):
                async with rig:
                    await self._damage(rig, "noise")
                    comparison = Comparison(rig)
                    comparison.require_right("there was noise on the line")
                    comparison.require_complete(comparison.spoilt(), " (before others there was noise)")
                return
            async with rig:
                await rig.until_fresh()
                before = rig.counters()["unknown"]
                rig.wire.foreign = foreign_identifiers(await self._own_identifiers(rig))
                await rig.sleep(_BURSTS * rig.adapter.period_s)
                foreign, rig.wire.foreign = rig.wire.foreign_sent, ()
                await rig.sleep(4 * rig.adapter.period_s)
                counted = rig.counters()["unknown"] - before
                require(
                    counted == foreign,
                    f"{foreign} frames of other devices came, {counted} were counted as unknown: the layout takes"
                    " identifiers that are not its devices'",
                )
                comparison = Comparison(rig)
                comparison.require_right("among frames of other devices")
                comparison.require_complete(because=" (among frames of other devices)")

        play(scenario)

    async def _own_identifiers(self, rig: Running) -> Collection[int]:
        told: Collection[int] = getattr(rig.devices, "identifiers", ())
        return told or {*rig.wire.identifiers, *(i for i, _ in rig.wire.sent)}

    async def _damage(self, rig: Running, fault: Fault) -> None:
        """Run, damage some frames, and let the last burst come through."""
        await rig.until_fresh()
        rig.wire.every_ns = _BETWEEN_DAMAGES * rig.period_ns
        rig.wire.fault = fault
        await rig.sleep(_DAMAGES * _BETWEEN_DAMAGES * rig.adapter.period_s)
        rig.wire.fault = None
        await rig.sleep(4 * rig.adapter.period_s)
        require(len(rig.wire.damages) >= _DAMAGES // 2, "the emulated devices send too little to test faults with")
