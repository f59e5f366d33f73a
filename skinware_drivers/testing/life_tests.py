"""Test a driver's description, and how it starts, stops, listens and releases resources."""

from __future__ import annotations

import gc
import sys
import tracemalloc
from collections.abc import Sequence
from typing import Any

import numpy as np

from skinware.errors import BusError, ConfigurationError, StructureError
from skinware.geometry import Geometry
from skinware.memory.namespace import Namespace
from skinware.structure import Structure
from skinware_drivers.adapter import AnyAdapter, check_layout
from skinware_drivers.description import SkinTables, assemble
from skinware_drivers.testing.comparison import until_fresh
from skinware_drivers.testing.plugin import Belongings, files_left
from skinware_drivers.testing.rig import Running, Suite, in_its_time, play
from skinware_drivers.testing.waiting import defect, require
from skinware_drivers.virtual.hand_clock import HandClock
from skinware_drivers.virtual.hardware import WireFrame

_ABSENT_S = 1.5
_LISTEN_S = 2.0
_MANY_BURSTS = 200
_MOST_GROWN = 1.5


def _check_matrices(structure: Structure, geometry: Geometry) -> None:
    """Fail unless taxels of matrices lie in the order of their rows and columns."""
    for sensor_type in structure.types:
        places = geometry.of(structure, sensor_type.name).position_m
        for name, taxels in structure.matrices(sensor_type.name).items():
            for axis, along in enumerate(("column", "row")):
                steps = np.diff(places[taxels], axis=axis).reshape(-1, 3)
                require(
                    not len(steps) or not (steps @ steps.mean(axis=0) <= 0).any(),
                    f"module {name!r} is called a matrix ({taxels.shape[0]}x{taxels.shape[1]}), but by `geometry` its"
                    f" {sensor_type.name} sensors go to and fro along a {along}: its sensors are row by row; is their"
                    " order or the kind another?",
                )


class LifeTests(Suite):
    """Description, handshakes, stop, listening, leaks."""

    @in_its_time
    async def test_the_description_is_valid_complete_and_stable(self, clock: HandClock) -> None:
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
                "`describe` returns another structure for the same devices when it is called again: readers would"
                " have to follow a new structure each time",
            )
            other = self.make_adapter()
            third = self._tables(other, await other.describe(rig.link))
            require(
                first.structure == third.structure,
                "another object of the driver describes the same devices in another way: does the class keep"
                " something that belongs to the object?",
            )

    @staticmethod
    def _tables(adapter: AnyAdapter, patches: Sequence[Any]) -> SkinTables:
        require(patches, "`describe` found no patch, though the emulated devices have power")
        names = [patch.name for patch in patches]
        require(len(set(names)) == len(names), f"two patches of one bus have the same name: {names}")
        try:
            tables = assemble([("bus", patches)], adapter.types, adapter.dtype)
            check_layout(adapter.layout, patches, tables, adapter.period_s)
        except (StructureError, ConfigurationError) as error:
            return defect(f"the description is not valid: {error}")
        if adapter.geometry is not None:
            _check_matrices(tables.structure, adapter.geometry)
        return tables

    @in_its_time
    async def test_handshakes_in_any_order(self, clock: HandClock) -> None:
        """Stop without start, twice, start again, close twice, use after close: only bus errors may be raised."""
        async with self.handshakes(clock) as rig:
            adapter, link = rig.adapter, rig.link

            async def step(name: str, *arguments: Any) -> Any:
                try:
                    return await getattr(adapter, name)(link, *arguments)
                except BusError as error:
                    return defect(f"`{name}` failed ({story}) though the devices are there: {error}")
                except Exception as error:  # noqa: BLE001  (reported to the author)
                    return defect(f"`{name}` raised {type(error).__name__}: {error} ({story}); only BusError may be")

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
                except Exception as error:  # noqa: BLE001  (reported to the author)
                    defect(f"`{name}` raised {type(error).__name__} on a closed bus: {error}; only BusError may be")
            rig.open()
            story = "after the bus was closed and opened again"
            for name in ("describe", "configure", "start", "stop"):
                await step(name)

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

    @in_its_time
    async def test_devices_that_come_late_are_found(self, clock: HandClock) -> None:
        """No device has power when the driver starts; devices that are switched on later are set up and shown."""
        rig = self.running(clock)
        rig.wire.silent = True
        async with rig:
            await rig.sleep(_ABSENT_S)
            rig.wire.silent = False
            await until_fresh(rig)

    @in_its_time
    async def test_devices_are_silent_again_after_stop(self, clock: HandClock) -> None:
        rig = self.running(clock)
        async with rig:
            rig.wire.skip(clock.now_ns)
            others = self.emulator(self.make_options(), log=None, source=self.handshakes(clock).truth)
            others.skip(clock.now_ns)
            if others.emit(clock.now_ns + 1_000_000_000):
                return  # they send by themselves: nothing stops them
            await until_fresh(rig)
        self._let_pass(rig, 0.1)
        sent = len(self._let_pass(rig, 1.0))
        require(
            not sent,
            f"the devices continue to send after the driver was stopped ({sent} frames in a second): `stop` does"
            " not make them silent",
        )

    @staticmethod
    def _let_pass(rig: Running, duration_s: float) -> list[WireFrame]:
        """Return the frames that devices send in this time, while nothing listens."""
        rig.clock.now_ns += round(duration_s * 1e9)
        return rig.devices.emit(rig.clock.now_ns)  # type: ignore[no-any-return]

    def test_nothing_leaks(self) -> None:
        """Started and stopped again and again, with its bus lost in between, it leaves nothing behind."""

        async def scenario(clock: HandClock) -> None:
            async with self.running(clock) as rig:
                await until_fresh(rig)
                rig.bus.vanish()
                await rig.sleep(0.5)
                rig.bus.come_back()
                await rig.sleep(1.0)

        play(scenario)  # makes what is kept from then on
        before = Belongings()
        for _ in range(2):
            play(scenario)
        self._require_nothing_left(before, "after it was started and stopped twice")

    @staticmethod
    def _require_nothing_left(before: Belongings, when: str) -> None:
        left = before.left_since() + files_left(Namespace().path)
        require(not left, f"left behind {when}: {', '.join(left)}: what `start` opens, `stop` must close")

    @in_its_time
    async def test_memory_does_not_grow(self, clock: HandClock) -> None:
        rig = self.running(clock)
        rig.record.keep = False
        async with rig:
            await until_fresh(rig)
            await rig.sleep(10 * rig.adapter.period_s)
            rig.truth.remember = rig.wire.remember = False  # then only the driver can grow
            await rig.sleep(20 * rig.adapter.period_s)  # makes what is kept from then on
            before = _pieces()
            await rig.sleep(_MANY_BURSTS * rig.adapter.period_s)
            grown = _pieces() - before
            if grown > _MANY_BURSTS * _MOST_GROWN:
                where = await _where_it_grows(rig)
                defect(
                    f"memory grows with the data: {grown} pieces more after {_MANY_BURSTS} bursts; most of them"
                    f" seem to be made at {where}"
                )

    def test_a_listener_sends_nothing(self) -> None:
        async def scenario(clock: HandClock, streaming: bool) -> None:
            async with self.running(clock, listen_only=True, streaming=streaming) as rig:
                await rig.sleep(_LISTEN_S)
                tried = rig.bus.counters.send_failures
                require(
                    not tried and not rig.wire.sent,
                    f"it may only listen, and tried to send {tried} frames: ask `link.listen_only` before"
                    " sending in `describe`, `attend` and `join`",
                )

        for streaming in (True, False):
            play(lambda clock, streaming=streaming: scenario(clock, streaming))  # type: ignore[misc]


def _pieces() -> int:
    gc.collect()
    return sys.getallocatedblocks()


async def _where_it_grows(rig: Running) -> str:
    """Return the line that makes most of the objects that stay; for small objects, Python is not always right."""
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
