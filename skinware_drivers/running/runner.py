"""Runs a driver: all its buses in one event loop, into one ring, until it is stopped."""

from __future__ import annotations

import asyncio
import select
from collections.abc import Callable, Sequence
from typing import Any

from skinware.geometry import Geometry
from skinware.memory.namespace import Namespace
from skinware.memory.statistics import Histogram
from skinware.realtime import now_ns, short_turns
from skinware.status import DataPath, PatchState, load_report, sample_report
from skinware_drivers.adapter import AnyAdapter
from skinware_drivers.bus import Bus
from skinware_drivers.decoding.decoder import PATCH_COUNTERS
from skinware_drivers.running.building import Builder, Identity, PublishMode
from skinware_drivers.running.bus_line import BusLine, open_buses
from skinware_drivers.running.data_loop import DataLoop
from skinware_drivers.running.guard import Ending
from skinware_drivers.running.news import PatchChange
from skinware_drivers.running.publisher import ALL_BUS_COUNTERS
from skinware_drivers.running.serving import BusChanges, Serving
from skinware_drivers.running.wires import Wires

_END_S, _LEAST_FOR_CLOSING_S = 0.9, 0.2
"""Time in which devices are made silent and buses are closed, also if one hangs; and the least time for closing."""


class Runner:
    """A driver on its buses.

    Args:
        lines: name, adapter and (unopened) bus of every bus, in order.
        listen_only: send nothing; ``configure``, ``start`` and ``stop`` are not called.
        wait_for_buses: if no bus is available at the start, wait for one.
        publish: ``cycle`` (when every live update group has arrived, or after a short wait), ``rate`` (at the adapter's
            rate), ``request`` (by cycle, but only on request); default: what the adapter says.
        latency_s: longest time that frames may wait to be taken in one batch, s; default: a quarter of the shortest
            period, 1 to 20 ms.
        namespace, slots, group: as for :class:`skinware.driver_service.DriverWriter`.
        geometry: where the sensors are; None: as the buses and their adapters say.
        on_ready: called once, when frames are being published.
        on_patches: called with patches that fell silent, or are live again.

    Attributes:
        lines: the buses; those that were removed keep their places.
        buses: adds and removes buses while the driver runs.
        builder: makes what is in service: the writer and the generation.
    """

    def __init__(
        self,
        driver_type: str,
        lines: Sequence[tuple[str, AnyAdapter, Bus]],
        *,
        name: str,
        listen_only: bool = False,
        wait_for_buses: bool = False,
        publish: PublishMode | None = None,
        latency_s: float | None = None,
        namespace: Namespace | None = None,
        slots: int | None = None,
        group: str | None = None,
        geometry: Geometry | None = None,
        on_ready: Callable[[], None] = lambda: None,
        on_patches: Callable[[PatchChange], None] = lambda _change: None,
    ) -> None:
        self.identity = Identity(name, driver_type, listen_only, namespace or Namespace(), slots, group)
        self._epoll = select.epoll()
        self.lines: list[BusLine] = [
            BusLine(bus_name, i, adapter, bus, self._epoll) for i, (bus_name, adapter, bus) in enumerate(lines)
        ]
        self.ending = Ending()
        self.ready: bool = False
        self._on_ready = on_ready
        self._wait_for_buses = wait_for_buses
        self._data = DataLoop(self._epoll, self.lines, self.ending, on_patches)
        self.builder = Builder(self.identity, self.lines, publish, latency_s, geometry, self.ending, self._data.begin)
        self._serving = Serving(self.lines, listen_only, self.builder, self._be_ready, self.ending)
        self.buses = BusChanges(self.lines, self._epoll, self.builder, self._serving)
        self._wires = Wires(self.identity, self.lines)

    async def run(self) -> None:
        """Run until ``stop``. A bus that is not there is waited for while the others go on.

        Meanwhile other threads of this process get short turns of the interpreter.

        Raises:
            BusNotAvailable: at the start, not one bus is there, or this user may not open one.
            ConfigurationError: devices cannot be used as they are configured, and no other bus is served.
            DriverError: the driver's own code failed: for all buses, or for the last one that was served.
            NameInUse: a living driver has this name.
            NamespaceError: the namespace cannot be used.
        """
        with short_turns():
            self.identity.namespace.create(self.identity.group)
            self._wires.begin()
            beginning = asyncio.get_running_loop().create_task(self._begin())
            beginning.add_done_callback(self.ending.watch)
            try:
                await self.ending.has_come.wait()
            finally:
                beginning.cancel()
                await asyncio.gather(beginning, return_exceptions=True)
                await self._serving.end()
                await self._shut_down()
            if self.ending.error is not None:
                raise self.ending.error

    async def _begin(self) -> None:
        await open_buses(self.lines, wait_for_one=self._wait_for_buses)
        self._data.start()
        for line in self.lines:
            self._serving.begin(line)

    def stop(self) -> None:
        """Ask ``run`` to return; safe in a signal handler of the loop."""
        self.ending.has_come.set()

    def join(self) -> None:
        """Add what has appeared on the buses since the start, as a new generation."""
        self._serving.join()

    async def change_geometry(self, geometry: Geometry | None) -> None:
        """Publish these places of the sensors from now on; a new generation begins if one of them moves."""
        self.builder.geometry = geometry
        await self.builder.build()

    def _be_ready(self) -> None:
        if not self.ready:
            self.ready = True
            self._on_ready()

    async def _shut_down(self) -> None:
        loop = asyncio.get_running_loop()
        await self.builder.close()
        begun_s = loop.time()
        stopped = await asyncio.gather(*(line.stop() for line in self.lines), return_exceptions=True)
        for failed in stopped:
            if isinstance(failed, Exception):
                self.ending.fail(failed)
        self._data.stop()
        left_s = max(_LEAST_FOR_CLOSING_S, begun_s + _END_S - loop.time())
        await asyncio.gather(*(line.connection.close(left_s) for line in self.lines))
        self._epoll.close()
        await self._wires.end()
        if self.builder.writer is not None:
            self.builder.writer.close()

    def status(self) -> dict[str, Any]:
        """Return figures of every bus and patch, for ``skin-driver --json``; only of the buses before publication."""
        writer, generation = self.builder.writer, self.builder.generation
        machine = {"softnet_dropped": self._data.machine.softnet_dropped}
        if writer is None or generation is None:
            return {"sequence": 0, "buses": [_bus(line) for line in self.lines], "machine": machine}
        publisher, state, time_ns = generation.publisher, generation.decoder.state, now_ns()
        structure = generation.tables.structure
        buses = []
        for line, row in zip(self.lines, publisher.count_buses().tolist(), strict=True):
            counters = dict(zip(ALL_BUS_COUNTERS, row, strict=True))
            path = DataPath(int(publisher.buses.data_path[line.ordinal])).name.lower()
            buses.append({**_bus(line), "data_path": path, **counters})
        patches = []
        for patch in range(structure.n_patches):
            last_ns = int(state.patch_time_ns[patch])
            counters = dict(zip(PATCH_COUNTERS, state.patch_counters[patch].tolist(), strict=True))
            patches.append(
                {
                    "name": generation.name_of(patch),
                    "bus": self.lines[int(structure.patch_bus[patch])].name,
                    "state": PatchState(int(publisher.patches.state[patch])).name.lower(),
                    "age_ms": round((time_ns - last_ns) / 1e6, 3) if last_ns else None,
                    "interval": _bounds(publisher.timing.intervals[patch].tolist()),
                    "age": _bounds(publisher.timing.ages[patch].tolist()),
                    **counters,
                }
            )
        latency_ms = int(publisher.latency_ns[0]) / 1e6
        return {
            "sequence": writer.sequence,
            "latency_ms": latency_ms,
            "buses": buses,
            "patches": patches,
            "machine": machine,
        }


def _bus(line: BusLine) -> dict[str, Any]:
    condition = line.condition
    return {
        "name": line.name,
        "state": condition.state.name.lower(),
        "reason": condition.reason.name.lower() if condition.reason else None,
        "state_age_s": round((now_ns() - condition.since_ns) / 1e9, 3),
        **load_report(condition.limits.permille),
        "samples": sample_report(line.bus.samples.rows),
    }


def _bounds(counts: list[int]) -> dict[str, int | None]:
    histogram = Histogram(counts)
    return {"p50_ns": histogram.quantile_ns(0.5), "p99_ns": histogram.quantile_ns(0.99)}
