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
"""

from __future__ import annotations

import gc
import sys
import tracemalloc
from collections.abc import Collection, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
import pytest

from skinware.driver_service import DriverFrame
from skinware.errors import BusError, StructureError
from skinware.memory.namespace import Namespace
from skinware.status import BusState, PatchState, Status
from skinware_drivers.adapter import AnyAdapter
from skinware_drivers.description import SkinTables, assemble
from skinware_drivers.testing.clock import HandClock
from skinware_drivers.testing.comparison import Comparison
from skinware_drivers.testing.defect import defect, require
from skinware_drivers.testing.leaks import Belongings, files_left
from skinware_drivers.testing.patterns import extreme, lively
from skinware_drivers.testing.rig import Case, Handshakes, Running, is_fresh, is_live, play
from skinware_drivers.testing.wire import Fault, foreign_identifiers
from skinware_drivers.virtual.hardware import WireFrame

_BURSTS = 24
_DAMAGES = 8
_BETWEEN_DAMAGES = 5
_RATE_TOLERANCE = 0.3
_SILENCE_S = 3.0
_RESTART_S = 20.0
_MANY_BURSTS = 200
_MOST_GROWN = 1.5
_STALE = np.uint8(Status.STALE | Status.NEVER_SEEN)


@pytest.mark.usefixtures("namespace")
class DriverConformance:
    """Tests for a driver. Subclass it, say which driver and which emulator, and nothing else.

    Attributes:
        driver: the adapter class.
        emulator: emulated hardware for it; see this module's docstring.
        driver_options: options of the driver, as in a configuration file.
        emulator_options: options of the emulator, beside what the tests need.
    """

    driver: ClassVar[type[AnyAdapter]]
    emulator: ClassVar[Any]
    driver_options: ClassVar[Mapping[str, Any]] = {}
    emulator_options: ClassVar[Mapping[str, Any]] = {}

    def shown(self, felt: Sequence[int]) -> Sequence[int]:
        """Of the values that a device felt, what its protocol can tell: to be overridden where that is less."""
        return felt

    @property
    def case(self) -> Case:
        """What is tested."""
        return Case(self.driver, self.emulator, self.driver_options, self.emulator_options, self.shown)

    def running(self, clock: HandClock, **more: Any) -> Running:
        """The driver on its devices, which feel other values all the time."""
        return Running(self.case, clock, more.pop("pattern", lively)(self.emulator), **more)

    def handshakes(self, clock: HandClock, **more: Any) -> Handshakes:
        """The driver's handshakes alone."""
        return Handshakes(self.case, clock, lively(self.emulator), **more)

    # -- what it says of itself ---------------------------------------------------------------------------------

    def test_the_description_is_valid_complete_and_stable(self) -> None:
        """The structure holds every sensor of the devices once, and is the same at every `describe`."""

        async def scenario(clock: HandClock) -> None:
            async with self.handshakes(clock) as rig:
                first = self._tables(rig.adapter, await rig.adapter.describe(rig.link))
                require(
                    first.structure.n_sensors == rig.n_values,
                    f"the driver declares {first.structure.n_sensors} sensors, the devices have {rig.n_values}: is a"
                    " module missing in `describe` or `patches`, or a channel that is no sensor?",
                )
                second = self._tables(rig.adapter, await rig.adapter.describe(rig.link))
                require(
                    first.structure == second.structure,
                    "`describe` says something else when it is asked again, of the same devices: readers would have to"
                    " follow a new structure each time",
                )
                other = self.case.adapter()
                third = self._tables(other, await other.describe(rig.link))
                require(
                    first.structure == third.structure,
                    "another object of the driver describes the same devices in another way: what is kept in the class"
                    " that belongs to the object?",
                )

        play(scenario)

    @staticmethod
    def _tables(adapter: AnyAdapter, patches: Sequence[Any]) -> SkinTables:
        require(patches, "`describe` found no patch, though the emulated devices have power")
        names = [patch.name for patch in patches]
        require(len(set(names)) == len(names), f"two patches of one bus have the same name: {names}")
        try:
            return assemble([("bus", patches)], adapter.types, adapter.dtype)
        except StructureError as error:
            return defect(f"the description is not valid: {error}")

    # -- life ---------------------------------------------------------------------------------------------------

    def test_handshakes_in_any_order(self) -> None:
        """Stop without start, twice, start again, close twice, use after close: only bus errors may come of it."""

        async def scenario(clock: HandClock) -> None:
            async with self.handshakes(clock) as rig:
                adapter, link = rig.adapter, rig.link

                async def step(name: str, *arguments: Any) -> Any:
                    try:
                        return await getattr(adapter, name)(link, *arguments)
                    except BusError as error:
                        return defect(f"`{name}` failed ({story}) though the devices are there: {error}")

                for story in (
                    "describe stop stop",
                    "configure start stop",
                    "stop configure configure start start stop",
                    "describe configure start stop",
                ):
                    for name in story.split():
                        result = await step(name)
                        if name == "describe":
                            patches = result
                for patch in patches:
                    story = "revive without start, then probe"
                    await step("revive", patch)
                    await step("probe", patch)
                await step("stop")
                rig.close()
                rig.close()
                for name in ("describe", "configure", "start", "stop"):
                    try:
                        await getattr(adapter, name)(link)
                    except BusError:
                        continue
                rig.open()
                story = "after the bus was closed and opened again"
                for name in ("describe", "configure", "start", "stop"):
                    await step(name)

        play(scenario)

    def test_it_can_be_stopped_at_any_moment(self) -> None:
        """Between any two steps of its start, also while it waits for devices that are not there."""
        before = Belongings()

        async def scenario(clock: HandClock, after_s: float, silent: bool) -> None:
            rig = self.running(clock)
            rig.wire.silent = silent
            async with rig:
                await rig.sleep(after_s)

        for silent in (False, True):
            for after_s in (0.0, 0.0003, 0.002, 0.03, 0.15, 0.6, 1.3):
                play(lambda clock, after_s=after_s, silent=silent: scenario(clock, after_s, silent))  # type: ignore[misc]
        self._require_nothing_left(before, "after it was stopped in the middle of its start")

    def test_devices_are_silent_again_after_stop(self) -> None:
        """Devices that were silent before a driver started them are silent after it has stopped."""

        async def scenario(clock: HandClock) -> None:
            rig = self.running(clock)
            async with rig:
                rig.wire.skip(clock.now_ns)
                if self._frames_alone(clock):
                    return  # they send by themselves: nothing stops them
                await rig.until_fresh()
            self._let_pass(rig, 0.1)
            sent = len(self._let_pass(rig, 1.0))
            require(
                not sent,
                f"the devices go on sending after the driver was stopped ({sent} frames in a second): `stop` does not"
                " make them silent",
            )

        play(scenario)

    def _frames_alone(self, clock: HandClock) -> int:
        """How much devices send in a second, to which nobody has said anything."""
        devices = self.emulator(self.case.options(), log=None, source=self.handshakes(clock).truth)
        devices.skip(clock.now_ns)
        return len(devices.emit(clock.now_ns + 1_000_000_000))

    @staticmethod
    def _let_pass(rig: Running, duration_s: float) -> list[WireFrame]:
        """What devices send while nobody listens."""
        rig.clock.now_ns += round(duration_s * 1e9)
        return rig.devices.emit(rig.clock.now_ns)  # type: ignore[no-any-return]

    def test_nothing_leaks(self) -> None:
        """Started and stopped again and again, with its bus lost in between, it leaves nothing behind."""

        async def scenario(clock: HandClock) -> None:
            async with self.running(clock) as rig:
                await rig.until_fresh()
                rig.bus.vanish()
                await rig.sleep(0.5)
                rig.bus.come_back()
                await rig.sleep(1.0)

        play(scenario)  # what is made once and kept
        before = Belongings()
        for _ in range(2):
            play(scenario)
        self._require_nothing_left(before, "after it was started and stopped twice")

    @staticmethod
    def _require_nothing_left(before: Belongings, when: str) -> None:
        left = before.left_since() + files_left(Namespace().path)
        require(not left, f"left behind {when}: {', '.join(left)}: what `start` opens, `stop` must close")

    def test_memory_does_not_grow(self) -> None:
        """Data for ever, in the same memory."""

        async def scenario(clock: HandClock) -> None:
            rig = self.running(clock)
            rig.record.keep = False
            async with rig:
                await rig.until_fresh()
                await rig.sleep(10 * rig.adapter.period_s)
                rig.truth.remember = rig.wire.remember = False  # what grows is then the driver's
                await rig.sleep(20 * rig.adapter.period_s)  # what is made once and kept
                before = _pieces()
                await rig.sleep(_MANY_BURSTS * rig.adapter.period_s)
                grown = _pieces() - before
                if grown > _MANY_BURSTS * _MOST_GROWN:
                    where = await _where_it_grows(rig)
                    defect(
                        f"memory grows with the data: {grown} pieces more after {_MANY_BURSTS} bursts; most of them"
                        f" seem to be made at {where}"
                    )

        play(scenario)

    # -- values -------------------------------------------------------------------------------------------------

    def test_nothing_is_valid_before_the_first_data(self) -> None:
        """As long as no data came, every sensor is NEVER_SEEN; and what has come makes only itself valid."""

        async def scenario(clock: HandClock) -> None:
            rig = self.running(clock)
            is_data = self._data_of(rig)
            rig.wire.keep = lambda identifier, payload: not is_data(identifier, payload)
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
                    if not is_data(identifier, payload):
                        return True
                    passed.add((identifier, payload[:1]))
                    return (identifier, payload[:1]) == min(passed)

                rig.wire.keep = first_of_each_burst
                await rig.sleep(_SILENCE_S)
                rig.wire.keep = lambda _identifier, _payload: True
                await rig.until_fresh()
                Comparison(rig).require_right(
                    "with most frames missing on the wire, sensors were filled in that no frame had told of"
                )

        play(scenario)

    def _data_of(self, rig: Running) -> Any:
        """Tells data from answers: a device that has sent data before it was asked for any does not exist."""
        bursts = rig.truth.bursts

        def is_data(_identifier: int, _payload: bytes) -> bool:
            return bool(bursts)

        return is_data

    def test_every_value_is_right_and_in_order(self) -> None:
        """Each sensor shows what it felt, every burst is shown once, and nothing is counted as wrong."""

        async def scenario(clock: HandClock) -> None:
            async with self.running(clock) as rig:
                await rig.until_fresh()
                await rig.sleep(_BURSTS * rig.adapter.period_s)
                comparison = Comparison(rig)
                comparison.require_right()
                comparison.require_complete()
                wrong = {name: n for name, n in rig.counters().items() if n and name in _NOTHING_OF_THESE}
                require(
                    not wrong,
                    f"of good data, something was counted as wrong: {wrong}: does the layout know every frame and every"
                    " length that the devices send?",
                )
                self._require_all_counted(rig)

        play(scenario)

    def test_extreme_values(self) -> None:
        """Least and greatest values, alternating bits, the sign bit alone: also these are shown as they were sent."""

        async def scenario(clock: HandClock) -> None:
            async with self.running(clock, pattern=extreme) as rig:
                await rig.until_fresh()
                await rig.sleep(24 * rig.adapter.period_s)
                Comparison(rig).require_right()

        play(scenario)

    # -- faults -------------------------------------------------------------------------------------------------

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
                self._require_all_counted(rig)

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
                self._require_all_counted(rig)

        play(scenario)

    def test_foreign_frames_disturb_nothing(self) -> None:
        """Other devices on the bus (on a serial line: noise between frames) are counted and change nothing."""

        async def scenario(clock: HandClock) -> None:
            rig = self.running(clock)
            if rig.adapter.medium == "serial":
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
        own: Collection[int] | None = getattr(rig.devices, "identifiers", None)
        return {*rig.wire.identifiers, *(i for i, _ in rig.wire.sent)} if own is None else own

    async def _damage(self, rig: Running, fault: Fault) -> None:
        """Run, damage some frames, and let the last burst come through."""
        await rig.until_fresh()
        rig.wire.every_ns = _BETWEEN_DAMAGES * rig.period_ns
        rig.wire.fault = fault
        await rig.sleep(_DAMAGES * _BETWEEN_DAMAGES * rig.adapter.period_s)
        rig.wire.fault = None
        await rig.sleep(4 * rig.adapter.period_s)
        require(len(rig.wire.damages) >= _DAMAGES // 2, "the emulated devices send too little to test faults with")

    @staticmethod
    def _require_all_counted(rig: Running) -> None:
        """Every frame that came in was shown, or counted as something."""
        counters = rig.counters()
        came = counters["frames"] + counters["refused"] + counters["lost"]
        if rig.adapter.medium == "can":
            require(came == rig.wire.frames, f"{rig.wire.frames} frames came, the bus counted {came}")
        layout = rig.adapter.layout
        if layout.cycle is not None and len(layout.cycle.members) < len(layout.frames):
            return  # how many frames an update had cannot be told from the counters
        used = counters["updates"] * layout.cycle_length + rig.answers
        used += sum(counters[name] for name in ("unknown", "bad_length", "bad_content", "orphans"))
        structure = rig.record.frames[-1].structure
        groups = structure.n_patches if layout.cycle and layout.cycle.within == "patch" else structure.n_modules
        require(
            0 <= counters["frames"] - used <= groups * (layout.cycle_length - 1),  # which may still wait for others
            f"{counters['frames']} frames came in, {used} were shown, counted, or answers to the driver: {counters}",
        )

    # -- silence ------------------------------------------------------------------------------------------------

    def test_silence_is_shown_and_ends(self) -> None:
        """A cable that is cut: every value goes stale, and is fresh again when the cable is back."""

        async def scenario(clock: HandClock) -> None:
            async with self.running(clock) as rig:
                await rig.until_fresh()
                rig.wire.silent = True
                await rig.sleep(max(_SILENCE_S, 20 * rig.adapter.period_s))
                require(
                    (rig.record.frames[-1].status & _STALE).all(),
                    "no data has come for seconds, but values are still shown as fresh: is `period_s` far too long?",
                )
                rig.wire.silent = False
                await self._comes_back(rig, "the cable was cut and mended")

        play(scenario)

    def test_a_lost_bus_comes_back(self) -> None:
        """The interface is unplugged and plugged in again: the driver goes on by itself."""

        async def scenario(clock: HandClock) -> None:
            async with self.running(clock) as rig:
                await rig.until_fresh()
                rig.bus.vanish()
                gone = await rig.until(
                    lambda frame: frame.bus_state[0] in (BusState.GONE, BusState.DOWN),
                    "the interface went away, but the state of the bus does not tell",
                )
                del gone
                await rig.sleep(max(_SILENCE_S, 20 * rig.adapter.period_s))
                require(
                    (rig.record.frames[-1].status & _STALE).all(),
                    "the interface is away, but values are shown as fresh",
                )
                rig.bus.come_back()
                await self._comes_back(rig, "the interface was unplugged and plugged in again")

        play(scenario)

    def test_restarted_devices_come_back(self) -> None:
        """A device that loses its power for a moment is set up and started anew, and disturbs no other."""

        async def scenario(clock: HandClock) -> None:
            async with self.running(clock, boot_s=0.5) as rig:
                await rig.until_fresh()
                number = rig.numbers[0]
                await self._restart(rig, number, clock.now_ns)
                patch = rig.first_patch_of(number)
                states = await self._until_stale(rig, patch, "a device lost its power, but it is shown as live")
                disturbed = np.flatnonzero(states.patch_state != PatchState.LIVE)
                require(
                    set(disturbed.tolist()) <= {patch},
                    f"a device lost its power, and patches {disturbed.tolist()} are not live: one holds up the others",
                )
                await self._comes_back(rig, "a device lost its power for half a second", within_s=_RESTART_S)

        play(scenario)

    @staticmethod
    async def _restart(rig: Running, number: int, now_ns: int) -> None:
        rig.devices.restart(number, now_ns)

    @staticmethod
    async def _until_stale(rig: Running, patch: int, why_not: str) -> DriverFrame:
        return await rig.until(
            lambda frame: frame.patch_state[patch] != PatchState.LIVE, why_not, within_s=20 * rig.adapter.period_s + 3
        )

    async def _comes_back(self, rig: Running, after: str, within_s: float = 10.0) -> None:
        """Everything is fresh again, and right."""
        end_ns = rig.clock.now_ns
        await rig.until(
            lambda frame: frame.published_ns > end_ns and is_fresh(frame) and is_live(frame),
            f"{after}, and {within_s:g} s later not every sensor is fresh again: look at `probe` and `revive`; what the"
            f" driver sent: {rig.sent_in_words()}",
            within_s=within_s,
        )
        await rig.sleep(4 * rig.adapter.period_s)
        Comparison(rig).require_right(f"{after}, and afterwards")

    def test_a_dead_device_holds_up_no_other(self) -> None:
        """One device dies: the others go on at their rate."""

        async def scenario(clock: HandClock) -> None:
            async with self.running(clock, boot_s=1e6) as rig:
                await rig.until_fresh()
                if len(rig.numbers) < 2:
                    return
                await self._restart(rig, rig.numbers[0], clock.now_ns)
                await rig.sleep(1.0 + 8 * rig.adapter.period_s)
                first = len(rig.record.frames)
                await rig.sleep(_BURSTS * rig.adapter.period_s)
                comparison = Comparison(rig)
                comparison.require_right("one device had died")
                for module in range(comparison.structure.n_modules):
                    if comparison.structure.module_patch[module] == rig.first_patch_of(rig.numbers[0]):
                        continue
                    shown = [u for u in comparison.updates if u.module == module and u.frame >= first]
                    require(
                        len(shown) >= _BURSTS - 3,
                        f"one device is dead, and of another one {len(shown)} of {_BURSTS} bursts were shown",
                    )

        play(scenario)

    # -- manners ------------------------------------------------------------------------------------------------

    def test_a_listener_sends_nothing(self) -> None:
        """With `--listen-only` nothing is sent, and nothing is even tried, whatever the devices do."""

        async def scenario(clock: HandClock, streaming: bool) -> None:
            async with self.running(clock, listen_only=True, streaming=streaming) as rig:
                await rig.sleep(3.0)
                tried = rig.bus.counters.send_failures
                require(
                    not tried and not rig.wire.sent,
                    f"it was told to listen only, and tried to send {tried} frames: ask `link.listen_only` before"
                    " sending in `describe`, `attend` and `join`",
                )

        for streaming in (True, False):
            play(lambda clock, streaming=streaming: scenario(clock, streaming))  # type: ignore[misc]

    def test_the_rate_is_the_one_it_tells(self) -> None:
        """Updates come every ``period_s``: readers, staleness and pairing depend on it."""

        async def scenario(clock: HandClock) -> None:
            async with self.running(clock) as rig:
                await rig.until_fresh()
                await rig.sleep(2 * _BURSTS * rig.adapter.period_s)
                for number in rig.numbers:
                    times_ns = np.array([burst.time_ns for burst in rig.truth.bursts[number]][-_BURSTS:])
                    real_s = float(np.median(np.diff(times_ns))) / 1e9
                    require(
                        abs(real_s / rig.adapter.period_s - 1) < _RATE_TOLERANCE,
                        f"`period_s` is {rig.adapter.period_s:g} s, but device {number} sends every {real_s:g} s",
                    )

        play(scenario)


def _pieces() -> int:
    """Pieces of memory that are in use."""
    gc.collect()
    return sys.getallocatedblocks()


async def _where_it_grows(rig: Running) -> str:
    """Where most of what comes and stays is made; of small pieces, Python does not always know it rightly."""
    snapshots = []
    tracemalloc.start(1)
    try:
        for _ in range(2):
            await rig.sleep(20 * rig.adapter.period_s)
            gc.collect()
            snapshots.append(tracemalloc.take_snapshot())
    finally:
        tracemalloc.stop()
    ours = [tracemalloc.Filter(False, f"*/skinware_drivers/{part}/*") for part in ("testing", "virtual")]
    first, second = (snapshot.filter_traces(ours) for snapshot in snapshots)
    return str(max(second.compare_to(first, "lineno"), key=lambda change: change.count_diff).traceback)


_NOTHING_OF_THESE = ("lost", "errors", "refused", "unknown", "bad_length", "bad_content", "orphans", "late")

__all__ = ["DriverConformance"]
