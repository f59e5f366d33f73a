"""Runs a driver: all its buses in one event loop, into one ring, until it is stopped."""

from __future__ import annotations

import asyncio
import logging
import select
from collections.abc import Callable, Sequence
from typing import Any, Literal

import numpy as np

from skinware.driver_service import DriverWriter
from skinware.errors import DriverError, StructureError
from skinware.geometry import Geometry
from skinware.memory.namespace import Namespace
from skinware.realtime import NS_PER_S, short_turns
from skinware.status import BusReason
from skinware_drivers.adapter import AnyAdapter
from skinware_drivers.bus import Bus, FrameBatch
from skinware_drivers.decoding.decoder import Decoder
from skinware_drivers.description import Patch, SkinTables, assemble, join_types
from skinware_drivers.layout import Layout
from skinware_drivers.running.attention import Attention
from skinware_drivers.running.bus_changes import BusChanges
from skinware_drivers.running.bus_line import BusLine, open_buses
from skinware_drivers.running.desk import RequestDesk, offered
from skinware_drivers.running.figures import figures
from skinware_drivers.running.flow import FlowLoop, flow_of
from skinware_drivers.running.generation import Generation, make_batch, make_watch, split_by_bus
from skinware_drivers.running.guard import end_of_driver, hook
from skinware_drivers.running.intake import Intake, latency_for
from skinware_drivers.running.news import MachineLimits, PatchChange
from skinware_drivers.running.places import put_in_place
from skinware_drivers.running.publisher import ALL_BUS_COUNTERS, ALL_PATCH_COUNTERS, Publisher
from skinware_drivers.running.serving import Serving
from skinware_drivers.running.wires import Wires

log: logging.Logger = logging.getLogger("skinware.driver")

_END_S, _LEAST_FOR_CLOSING_S = 0.9, 0.2
"""In which devices are made silent and buses closed, whatever hangs; and what of it closing has at least."""
_LOOK_S = 0.5
"""While C publishes: how often files, states and counters are looked after."""

PublishMode = Literal["cycle", "rate", "request"]


class Runner:
    """A driver on its buses.

    Args:
        driver_type: name of the driver, for people.
        lines: name, adapter and (unopened) bus of every bus, in order.
        name: the driver's name in the namespace.
        listen_only: send nothing; ``configure``, ``start`` and ``stop`` are not called.
        wait_for_buses: for one to appear, if there is none at the start.
        publish: ``cycle`` (when every living patch has delivered), ``rate`` (at the adapter's rate), ``request`` (by
            cycle, but only what a program has asked for); default: what the adapter says.
        latency_s: the longest that frames may wait so that more are taken with them, s; default: a quarter of the
            shortest period, 1 to 20 ms.
        namespace, slots, group: as for :class:`skinware.driver_service.DriverWriter`.
        geometry: where the sensors are, for programs; None where nobody knows.
        on_ready: called once, when frames are being published.
        on_patches: called with patches that fell silent, or are live again.

    Attributes:
        lines: the buses; those that were removed keep their places.
        buses: adds and removes buses while it runs.
        writer: the driver's end in shared memory, once there is a structure.
        generation: what is in service, once there is a structure.
        ready: frames are being published.
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
        self.name = name
        self.driver_type = driver_type
        self._epoll = select.epoll()
        self.lines: list[BusLine] = [
            BusLine(bus_name, i, adapter, bus, self._epoll) for i, (bus_name, adapter, bus) in enumerate(lines)
        ]
        self.buses = BusChanges(self.lines, self._epoll, self._put_in, self._take_out, self._build)
        self.writer: DriverWriter | None = None
        self.generation: Generation | None = None
        self.ready: bool = False
        self._listen_only = listen_only
        self._wait_for_buses = wait_for_buses
        self._publish = publish
        self._desk: RequestDesk | None = None
        self._namespace = namespace or Namespace()
        self._slots = slots
        self._group = group
        self._geometry = geometry
        self._on_ready, self._on_patches = on_ready, on_patches
        self._machine = MachineLimits()
        self._attention = Attention()
        self._latency_s = latency_s
        self._intake = Intake(
            self._epoll, self.lines, self._empty_batch, self._digest, self._longest_rest_s, self._guard
        )
        self._first_batch = make_batch(self.lines)
        self._stopping = asyncio.Event()
        self._failure: BaseException | None = None
        self._built = asyncio.Condition()
        self._serving = Serving(
            self.lines, listen_only, lambda: self.generation, self._built, self._build, self._tell_ready, self.fail
        )
        self._wires = Wires(name, driver_type, self.lines, listen_only, self._namespace, group)
        self._timer: asyncio.TimerHandle | None = None
        self._flows = False

    @property
    def _layouts(self) -> list[Layout | None]:
        return [line.adapter.layout if line.patches else None for line in self.lines]

    # -- life -----------------------------------------------------------------------------------------------------

    async def run(self) -> None:
        """Run until ``stop``. A bus that is not there is waited for while the others go on.

        Meanwhile other threads of this process get short turns of the interpreter (see ``running.turns``).

        Raises:
            BusNotAvailable: at the start, not one bus is there, or this user may not open one.
            ConfigurationError: devices cannot be used as they are configured, and no other bus is served.
            DriverError: the driver's own code failed: for all buses, or for the last one that was served.
            NameInUse: a living driver has this name.
            NamespaceError: the namespace cannot be used.
        """
        with short_turns():
            await self._run(asyncio.get_running_loop())

    async def _run(self, loop: asyncio.AbstractEventLoop) -> None:
        self._namespace.create(self._group)
        self._wires.begin()
        beginning = loop.create_task(self._begin())
        beginning.add_done_callback(self._has_begun)
        try:
            await self._stopping.wait()
        finally:
            beginning.cancel()
            await asyncio.gather(beginning, return_exceptions=True)
            await self._serving.end()
            await self._shut_down(loop)
        if self._failure is not None:
            raise self._failure

    async def _begin(self) -> None:
        await open_buses(self.lines, wait_for_one=self._wait_for_buses)
        self._intake.start()
        for line in self.lines:
            self._serving.begin(line)

    def _has_begun(self, beginning: asyncio.Task[None]) -> None:
        if not beginning.cancelled() and (error := beginning.exception()) is not None:
            self.fail(error)

    def stop(self) -> None:
        """Ask ``run`` to come back; safe in a signal handler of the loop."""
        self._stopping.set()

    def fail(self, error: BaseException) -> None:
        """End ``run`` with this error: nothing may go on as if it had not happened. Only the first one counts."""
        if self._failure is None:
            self._failure = end_of_driver(error)
        self._stopping.set()

    def _guard(self, callback: Callable[[], object]) -> Callable[[], None]:
        """The same for the event loop, which would log what it raises and go on."""

        def call() -> None:
            if self._failure is not None:
                return
            try:
                callback()
            except (Exception, SystemExit) as error:  # noqa: BLE001  (whatever it is, it ends the driver)
                self.fail(error)

        return call

    def join(self) -> None:
        """Take in what has appeared on the buses since the start, as a new generation."""
        self._serving.join()

    async def change_geometry(self, geometry: Geometry | None) -> None:
        """Have these places of the sensors from now on; a new generation, if one of them moves."""
        self._geometry = geometry
        await self._build()

    async def _put_in(self, line: BusLine) -> None:
        """Begin with a bus that joins: users see a new generation."""
        async with self._built:
            line.begin_lost()
            self.lines[line.ordinal : line.ordinal + 1] = [line]
            self._rebuild(anew=True)  # nothing of it may arrive before there is a place for it
        self._serving.begin(line)

    async def _take_out(self, line: BusLine) -> None:
        """Stop what is on a bus, and close it. The sensors stay in the structure until that is built again."""
        await self._serving.end(line)
        try:
            await line.stop()
        except DriverError as error:
            log.warning("%s", str(error))  # the bus goes all the same
        async with self._built:
            line.remove()

    async def _shut_down(self, loop: asyncio.AbstractEventLoop) -> None:
        if self._desk is not None and self.writer is not None:
            loop.remove_reader(self.writer.request_server().fileno())
            await self._desk.close()
        begun_s = loop.time()
        stopped = await asyncio.gather(*(line.stop() for line in self.lines), return_exceptions=True)
        for failed in stopped:
            if isinstance(failed, Exception):
                self.fail(failed)
        if isinstance(loop, FlowLoop):
            loop.selector.flow = None
        self._intake.stop()
        if self._timer is not None:
            self._timer.cancel()
        left_s = max(_LEAST_FOR_CLOSING_S, begun_s + _END_S - loop.time())
        await asyncio.gather(*(line.close(left_s) for line in self.lines))
        self._epoll.close()
        await self._wires.end()
        if self.writer is not None:
            self.writer.close()

    def _tell_ready(self) -> None:
        if not self.ready:
            self.ready = True
            self._on_ready()

    # -- structure ------------------------------------------------------------------------------------------------

    async def _build(self) -> None:
        """(Re)build tables, decoder and writer once every bus has been asked what is attached to it."""
        async with self._built:
            self._rebuild()

    def _rebuild(self, *, anew: bool = False) -> None:
        """With ``_built`` held. ``anew``: also if nothing has changed but the bus behind a name."""
        if any(line.patches is None for line in self.lines):
            return
        adapters = [line.adapter for line in self.lines if line.patches]
        if not adapters:
            if anew and self.generation is not None:  # the sensors stay, without data
                self._go_over_to(self.generation.decoder.described.with_buses([line.name for line in self.lines]))
            return
        try:
            tables = assemble(
                [(line.name, line.patches or ()) for line in self.lines],
                join_types([adapter.types for adapter in adapters]),
                np.result_type(*(adapter.dtype for adapter in adapters)),
            )
            tables = put_in_place(tables, self._geometry, [line.geometry for line in self.lines])
        except StructureError as error:
            log.error("the devices that were found do not form a valid skin: %s", str(error))
            return
        known = self.generation
        is_known = known is not None and (known.decoder.described.structure, known.decoder.layouts) == (
            tables.structure,
            self._layouts,
        )
        if is_known and not anew:
            return
        self._go_over_to(tables)
        self._built.notify_all()

    def _go_over_to(self, described: SkinTables) -> None:
        # the driver's own code comes first: if it fails, nothing has changed
        decoder = Decoder(self._layouts, described, [line.adapter.period_s for line in self.lines])
        tables = decoder.tables
        watch = make_watch(self.lines, tables)
        if self.writer is None:
            self.writer = writer = DriverWriter(
                self.name,
                tables.structure,
                driver_type=self.driver_type,
                bus_counters=ALL_BUS_COUNTERS,
                patch_counters=ALL_PATCH_COUNTERS,
                namespace=self._namespace,
                slots=self._slots,
                rate_hz=1 / self._period_s,
                operations=offered(self.lines),
            )
            server = writer.request_server()
            self._desk = RequestDesk(server, self.lines, self._listen_only, self._after_operation, self.fail)
            asyncio.get_running_loop().add_reader(server.fileno(), self._guard(self._desk.take))
        else:
            writer = self.writer
            writer.restructure(tables.structure, rate_hz=1 / self._period_s)
            log.info("new generation: %r", tables.structure)
        by_cycle = self.lines[0].adapter.by_cycle if self._publish is None else self._publish != "rate"
        on_request = self._publish == "request"
        publisher = Publisher(writer, decoder, watch, self._period_s, by_cycle, self._desk, on_request)
        self._intake.latency_s = self._longest_rest_s
        publisher.latency_ns[:] = round(self._longest_rest_s * NS_PER_S)
        self.generation = Generation(self.lines, decoder, watch, publisher, self._period_s)
        self._let_flow()
        self._guard(self._publish_when_due)()

    def _let_flow(self) -> None:
        """Have C read the buses while the event loop rests, if that can be; else they wake the loop."""
        loop = asyncio.get_running_loop()
        if not isinstance(loop, FlowLoop) or self.generation is None:
            return
        take = self._guard(self._intake.take)
        flow = flow_of(self.generation, self._epoll.fileno(), self._intake.latency_s, take, self.fail)
        self._flows = self.generation.flows = flow is not None
        loop.selector.flow = None if flow is None else flow.run
        if flow is None:
            self._intake.start()
        else:
            self._intake.stop()

    @property
    def _periods_s(self) -> list[float]:
        present = [line for line in self.lines if line.reason != BusReason.REMOVED] or self.lines
        return [line.adapter.period_s for line in present]

    @property
    def _period_s(self) -> float:
        return max(self._periods_s)

    @property
    def _longest_rest_s(self) -> float:
        return latency_for(min(self._periods_s)) if self._latency_s is None else self._latency_s

    def _after_operation(self, line: BusLine, patches: Sequence[Patch], set_up: bool) -> None:
        generation = self.generation
        if generation is None:
            return
        if self._period_s != generation.period_s or self._layouts != generation.decoder.layouts:
            self._go_over_to(generation.decoder.described)
        elif set_up:
            for number in (generation.number_of(line, patch) for patch in patches):
                if number is not None:
                    with hook("Watch.forget", line.name):
                        generation.watch.forget(number)

    # -- data -----------------------------------------------------------------------------------------------------

    def _empty_batch(self) -> FrameBatch:
        if self.generation is not None:
            return self.generation.empty_batch()
        self._first_batch.clear()
        return self._first_batch

    def _digest(self, batch: FrameBatch) -> None:
        if self.generation is not None:
            self._attend()
            self._machine.look()
            self.generation.digest(batch)
            self._arm_timer()
            return
        rows = np.arange(batch.start, batch.stop)
        for line, own in zip(self.lines, split_by_bus(batch, rows, len(self.lines)), strict=True):
            line.link.hear(batch, own)
            line.link.offer(batch, own)

    def _attend(self) -> None:
        """If this process was held up: what fell silent meanwhile did so because nobody listened."""
        hold_up = self._attention.look(None if self._timer is None else round(self._timer.when() * NS_PER_S))
        if hold_up is None or self.generation is None:
            return
        self.generation.publisher.excuse(hold_up)
        for line in self.lines:
            line.excuse(hold_up.since_ns, self.generation.publisher.pace.silence_ns)

    def _publish_when_due(self) -> None:
        self._attend()
        if not self._flows:
            self._intake.take()  # what has arrived comes first: this may be late
        if self.writer is None or self.generation is None:
            return
        self.writer.keep_files()
        self._machine.look()
        self.generation.update_bus_states()
        self.generation.path.publish_if_due(self._intake.read_until_ns)
        for change in self.generation.tell_patches():
            self._on_patches(change)
        self._arm_timer()

    def _arm_timer(self) -> None:
        if self.generation is None:
            return
        loop = asyncio.get_running_loop()
        due_s = loop.time() + _LOOK_S if self._flows else self.generation.path.deadline_ns / NS_PER_S
        if self._timer is not None:
            if not self._timer.cancelled() and loop.time() < self._timer.when() <= due_s:
                return  # it comes early enough and then looks again
            self._timer.cancel()
        self._timer = loop.call_at(due_s, self._guard(self._publish_when_due))

    def status(self) -> dict[str, Any]:
        """Figures of every bus and patch, for ``skin-driver --json``."""
        return figures(self.lines, self._machine, self.writer, self.generation)
