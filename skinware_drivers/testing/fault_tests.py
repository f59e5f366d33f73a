"""Test that damage costs only its own bursts and is never shown as data, and that silence shows and ends."""

from __future__ import annotations

from collections.abc import Collection
from contextlib import closing

import numpy as np
import numpy.typing as npt
import pytest

from skinware.driver_snapshot import DriverSnapshot
from skinware.realtime import NS_PER_S
from skinware.status import BusState, PatchState, Status
from skinware_drivers.decoding.decoder import Updates
from skinware_drivers.description import SkinTables
from skinware_drivers.polling import Watch
from skinware_drivers.testing.comparison import ShownUpdates, until_fresh
from skinware_drivers.testing.rig import Running, Suite, in_its_time, is_fresh, play
from skinware_drivers.testing.torn_tests import FrameLog
from skinware_drivers.testing.vectors import DirectPath
from skinware_drivers.testing.waiting import require
from skinware_drivers.testing.wire import Fault, foreign_identifiers
from skinware_drivers.virtual.hand_clock import HandClock

_BURSTS = 24
_DAMAGES = 8
_BETWEEN_DAMAGES = 5


class FaultTests(Suite):
    """Lost, damaged, repeated and foreign frames."""

    @pytest.mark.parametrize("fault", ["lost", "truncated", "repeated"])
    @in_its_time
    async def test_a_damaged_frame_costs_its_own_burst_only(self, clock: HandClock, fault: Fault) -> None:
        """Frames that are lost, cut short, or come twice: nothing torn is shown, every whole burst is."""
        async with self.running(clock) as rig:
            await self._damage(rig, fault)
            comparison = ShownUpdates(rig)
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

    @in_its_time
    async def test_garbage_raises_nothing(self, clock: HandClock) -> None:
        """Random bytes under the devices' own identifiers: no exception, and all other bursts are right."""
        async with self.running(clock) as rig:
            await self._damage(rig, "garbage")
            comparison = ShownUpdates(rig)
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

    @in_its_time
    async def test_foreign_frames_disturb_nothing(self, clock: HandClock) -> None:
        """Other devices on the bus (on a serial line: noise between frames) are counted and change nothing."""
        if self.driver.medium == "virtual":
            return  # there are no other devices
        rig = self.running(clock)
        if rig.adapter.medium in ("serial", "modbus"):
            async with rig:
                await self._damage(rig, "noise")
                comparison = ShownUpdates(rig)
                comparison.require_right("there was noise on the line")
                comparison.require_complete(comparison.spoilt(), " (before others there was noise)")
            return
        async with rig:
            await until_fresh(rig)
            before = rig.counters()["unknown"]
            declared: Collection[int] = getattr(rig.devices, "identifiers", ())
            own = declared or {*rig.wire.identifiers, *(i for i, _ in rig.wire.sent)}
            rig.wire.foreign = foreign_identifiers(own)
            await rig.sleep(_BURSTS * rig.adapter.period_s)
            foreign, rig.wire.foreign = rig.wire.foreign_sent, ()
            await rig.sleep(4 * rig.adapter.period_s)
            counted = rig.counters()["unknown"] - before
            require(
                counted == foreign,
                f"{foreign} frames of other devices came, {counted} were counted as unknown: the layout takes"
                " identifiers that are not its devices'",
            )
            comparison = ShownUpdates(rig)
            comparison.require_right("among frames of other devices")
            comparison.require_complete(because=" (among frames of other devices)")

    async def _damage(self, rig: Running, fault: Fault) -> None:
        """Run, damage some frames, and let the last burst come through."""
        await until_fresh(rig)
        rig.wire.every_ns = _BETWEEN_DAMAGES * rig.period_ns
        rig.wire.fault = fault
        await rig.sleep(_DAMAGES * _BETWEEN_DAMAGES * rig.adapter.period_s)
        rig.wire.fault = None
        await rig.sleep(4 * rig.adapter.period_s)
        require(len(rig.wire.damages) >= _DAMAGES // 2, "the emulated devices send too little to test faults with")


_SILENCE_S = 1.5
_RESTART_S = 12.0
_STALE = np.uint8(Status.STALE | Status.NEVER_SEEN)


class SilenceTests(Suite):
    """Cut cables, lost buses, devices that restart or die."""

    @in_its_time
    async def test_silence_is_shown_and_ends(self, clock: HandClock) -> None:
        """A cable that is cut: every value goes stale, and is fresh again when the cable is back."""
        async with self.running(clock) as rig:
            await until_fresh(rig)
            rig.wire.silent = True
            slowest_ns = int(rig.record.frames[-1].structure.group_period_ns.max())
            await rig.sleep(max(_SILENCE_S, 20 * rig.adapter.period_s, 4 * slowest_ns / NS_PER_S))
            require(
                (rig.record.frames[-1].status & _STALE).all(),
                "no data has come for seconds, but values are still shown as fresh: is `period_s` far too long?",
            )
            rig.wire.silent = False
            await self._comes_back(rig, "the cable was cut and mended")

    def test_a_silent_kind_of_frame_is_not_shown_as_fresh(self) -> None:
        """One kind of frame falls silent while all others continue: sensors that only it carries become stale."""

        async def scenario(clock: HandClock) -> tuple[FrameLog, Running]:
            async with self.running(clock) as rig:
                await until_fresh(rig)
                heard = FrameLog(rig)
                await rig.sleep(_BURSTS * rig.adapter.period_s)
                return heard, rig

        heard, rig = play(scenario)
        wire, time_ns = np.concatenate([t.wire for t in heard.takes]), np.concatenate([t.time_ns for t in heard.takes])
        layout, half = rig.adapter.layout, len(wire) // 2
        with closing(_path(rig, wire, Watch(heard.tables))) as path:
            kind = path.feed_rows(wire, time_ns).kind
        for number, frame in enumerate(layout.frames):
            log = _SensorLog(heard.tables)
            with closing(_path(rig, wire, log)) as path:
                path.feed_rows(wire[:half], time_ns[:half])
                state, seen = path.decoder.state, log.has_values.copy()
                before = np.maximum(state.group_time_ns, time_ns[:half].max())
                log.has_values[:] = False
                others = half + np.flatnonzero(kind[half:] != number)
                path.feed_rows(wire[others], time_ns[others])
                seen &= ~log.has_values
                groups = np.unique(path.decoder.tables.structure.sensor_group[seen[:-1]])
                renewed = groups[state.group_time_ns[groups] > before[groups]]
            require(
                not len(renewed),
                f"frames {frame.name!r} fell silent, but sensors that only they carry stay fresh: other frames fill the"
                " same module. If an Expand is among them, say with `to` which channels it has",
            )

    @in_its_time
    async def test_a_lost_bus_comes_back(self, clock: HandClock) -> None:
        """The interface is unplugged and plugged in again: the driver continues by itself."""
        async with self.running(clock) as rig:
            await until_fresh(rig)
            rig.bus.vanish()
            await rig.until(
                lambda frame: frame.bus_state[0] in (BusState.GONE, BusState.DOWN),
                "the interface went away, but the state of the bus does not show it",
            )
            await rig.sleep(max(_SILENCE_S, 20 * rig.adapter.period_s))
            require(
                (rig.record.frames[-1].status & _STALE).all(),
                "the interface is away, but values are shown as fresh",
            )
            rig.bus.come_back()
            await self._comes_back(rig, "the interface was unplugged and plugged in again")

    @in_its_time
    async def test_restarted_devices_come_back(self, clock: HandClock) -> None:
        async with self.running(clock, boot_s=0.5) as rig:
            await until_fresh(rig)
            number = rig.numbers[0]
            rig.devices.restart(number, clock.now_ns)
            patch = rig.first_patch_of(number)
            states = await rig.until(
                lambda frame: frame.patch_state[patch] != PatchState.LIVE,
                "a device lost its power, but it is shown as live",
                within_s=20 * rig.adapter.period_s + 3,
            )
            disturbed = np.flatnonzero(states.patch_state != PatchState.LIVE)
            require(
                set(disturbed.tolist()) <= {patch},
                f"a device lost its power, and patches {disturbed.tolist()} are not live: one holds up the others",
            )
            await self._comes_back(rig, "a device lost its power for half a second", within_s=_RESTART_S)

    async def _comes_back(self, rig: Running, after: str, within_s: float = 10.0) -> None:
        end_ns = rig.clock.now_ns

        def is_back(frame: DriverSnapshot) -> bool:
            is_live = (frame.patch_state == PatchState.LIVE).all() and (frame.bus_state == BusState.LIVE).all()
            return frame.acquired_ns > end_ns and is_fresh(frame) and bool(is_live)

        await rig.until(
            is_back,
            f"{after}, and {within_s:g} s later not every sensor is fresh again: look at `probe` and `revive`; what the"
            f" driver sent: {rig.sent_in_words()}",
            within_s=within_s,
        )
        await rig.sleep(4 * rig.adapter.period_s)
        ShownUpdates(rig).require_right(f"{after}, and afterwards")

    @in_its_time
    async def test_a_dead_device_holds_up_no_other(self, clock: HandClock) -> None:
        """One device dies: the others continue at their rate."""
        async with self.running(clock, boot_s=1e6) as rig:
            await until_fresh(rig)
            if len(rig.numbers) < 2:
                return
            rig.devices.restart(rig.numbers[0], clock.now_ns)
            await rig.sleep(1.0 + 8 * rig.adapter.period_s)
            first = len(rig.record.frames)
            await rig.sleep(_BURSTS * rig.adapter.period_s)
            comparison = ShownUpdates(rig)
            comparison.require_right("one device had died")
            for module in range(comparison.structure.n_modules):
                if comparison.structure.module_patch[module] == rig.first_patch_of(rig.numbers[0]):
                    continue
                shown = [u for u in comparison.updates if u.module == module and u.frame >= first]
                require(
                    len(shown) >= _BURSTS - 3,
                    f"one device is dead, and of another one {len(shown)} of {_BURSTS} bursts were shown",
                )


def _path(rig: Running, wire: npt.NDArray[np.void], watch: Watch) -> DirectPath:
    adapter, size = rig.adapter, wire.dtype["payload"].shape[0]
    return DirectPath(adapter.layout, watch.tables, size, period_s=adapter.period_s, rows=len(wire), watch=watch)


class _SensorLog(Watch):
    """Note which sensors whole updates have values of; the last one stands for values without a sensor."""

    sees_all = True

    def __init__(self, tables: SkinTables) -> None:
        super().__init__(tables)
        self.has_values: npt.NDArray[np.bool_] = np.zeros(tables.structure.n_sensors + 1, bool)

    def look(self, updates: Updates) -> None:
        self.has_values[updates.sensors[updates.whole]] = True
