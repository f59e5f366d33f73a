"""Runs a driver: all its buses in one event loop, into one writer buffer, for ever."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import select
from collections.abc import Callable, Coroutine, Sequence
from typing import Any, Literal

import numpy as np

from skinware.driver_service import DriverWriter
from skinware.errors import BusError, BusNotAvailable, ConfigurationError, StructureError
from skinware.memory.namespace import Namespace
from skinware.realtime import NS_PER_S, Periodic, now_ns
from skinware.service import DEFAULT_SLOTS
from skinware.status import BusReason, PatchState
from skinware_drivers.adapter import AnyAdapter, Notice, Watch
from skinware_drivers.bus import Bus, FrameBatch
from skinware_drivers.bus_line import BusLine
from skinware_drivers.decoder import Decoder
from skinware_drivers.description import Patch, SkinTables, assemble, join_types
from skinware_drivers.desk import RequestDesk
from skinware_drivers.figures import figures
from skinware_drivers.layout import Layout
from skinware_drivers.limits import MachineLimits
from skinware_drivers.link import split_by_bus
from skinware_drivers.operations import operations_of
from skinware_drivers.polling import Poller
from skinware_drivers.publisher import ALL_BUS_COUNTERS, ALL_PATCH_COUNTERS, Publisher

log = logging.getLogger("skinware.driver")

_BATCH_FRAMES, _BATCH_BYTES = 2048, 1 << 20
_TURNS = 8  # full batches per wake-up before handshakes and timers get their turn
_REST, _LONGEST_REST_S = 4, 0.005  # after a take: so many times its duration, while more arrives (decision 0006)
_DATA_TIMEOUT_S = 1.0
_DATA_CHECKS_HZ = 100

PublishMode = Literal["cycle", "rate", "request"]


class Runner:
    """A driver on its buses.

    Args:
        driver_type: name of the driver, for people.
        lines: name, adapter and (unopened) bus of every bus, in order.
        name: the driver's name in the namespace.
        listen_only: send nothing; ``configure``, ``start`` and ``stop`` are not called.
        publish: ``cycle`` (when every living patch has delivered), ``rate`` (at the adapter's rate), ``request`` (by
            cycle, but only what a program has asked for); default: what the adapter says.
        namespace, slots, group: as for :class:`skinware.driver_service.DriverWriter`.
        on_ready: called once, when frames are being published.
    """

    def __init__(
        self,
        driver_type: str,
        lines: Sequence[tuple[str, AnyAdapter, Bus]],
        *,
        name: str,
        listen_only: bool = False,
        publish: PublishMode | None = None,
        namespace: Namespace | None = None,
        slots: int = DEFAULT_SLOTS,
        group: str | None = None,
        on_ready: Callable[[], None] = lambda: None,
    ) -> None:
        self.name = name
        self.driver_type = driver_type
        self._epoll = select.epoll()
        self.lines = [
            BusLine(bus_name, i, adapter, bus, self._epoll) for i, (bus_name, adapter, bus) in enumerate(lines)
        ]
        self.writer: DriverWriter | None = None
        self.publisher: Publisher | None = None
        self.decoder: Decoder | None = None
        self.ready = False
        self._listen_only = listen_only
        self._publish = publish
        self._desk: RequestDesk | None = None
        self._namespace = namespace or Namespace()
        self._slots = slots
        self._group = group
        self._on_ready = on_ready
        self._watch: Watch | None = None
        self._machine = MachineLimits()
        self._serving: dict[BusLine, asyncio.Task[None]] = {}
        self._batch = self._make_batch(headroom=0)
        self._stopping = asyncio.Event()
        self._failure: BaseException | None = None
        self._built = asyncio.Condition()
        self._timer: asyncio.TimerHandle | None = None
        self._rest: asyncio.TimerHandle | None = None
        self._known_patch_state = np.zeros(0, np.uint8)
        self._join_requested = asyncio.Event()
        self._begun_ns = 0  # the present generation
        self._built_period_s = 0.0

    @property
    def _layouts(self) -> list[Layout | None]:
        return [line.adapter.layout if line.patches else None for line in self.lines]

    def _make_batch(self, headroom: int) -> FrameBatch:
        """Room for what arrives at once; of long frames, fewer do."""
        return FrameBatch(max(64, min(_BATCH_FRAMES, _BATCH_BYTES // self._payload_size)), self._payload_size, headroom)

    @property
    def _payload_size(self) -> int:
        return max(line.adapter.payload_size for line in self.lines)

    # -- life -----------------------------------------------------------------------------------------------------

    async def run(self) -> None:
        """Run until ``stop``.

        Raises:
            BusNotAvailable: a bus could not be opened at the start (later, it is waited for).
            NameInUse: a living driver has this name.
            NamespaceError: the namespace cannot be used.
        """
        loop = asyncio.get_running_loop()
        self._namespace.create(self._group)
        try:
            for line in self.lines:
                line.open()
            loop.add_reader(self._epoll.fileno(), self._on_readable)
            self._serving = {line: self._beside(self._serve(line)) for line in self.lines}
            await self._stopping.wait()
            if self._failure is not None:
                raise self._failure
        finally:
            tasks = list(self._serving.values())
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
            await self._shut_down(loop)

    def stop(self) -> None:
        """Ask ``run`` to come back; safe in a signal handler of the loop."""
        self._stopping.set()

    def join(self) -> None:
        """Take in what has appeared on the buses since the start, as a new generation."""
        self._join_requested.set()

    @property
    def bus_names(self) -> list[str]:
        """Names of its buses, without those that were removed."""
        return [line.name for line in self.lines if line.reason != BusReason.REMOVED]

    async def add_bus(self, name: str, adapter: AnyAdapter, bus: Bus) -> None:
        """Take in one more bus while the others go on; users see a new generation. It need not be there yet.

        A bus that was removed gets its old place back. The others keep theirs, and with them the uids of their sensors.

        Raises:
            ConfigurationError: there is a bus of this name, or its sensor types contradict those of the others.
        """
        async with self._built:
            known = next((line for line in self.lines if line.name == name), None)
            if known is not None and known.reason != BusReason.REMOVED:
                raise ConfigurationError(f"bus {name} is in use already")
            line = BusLine(name, len(self.lines) if known is None else known.ordinal, adapter, bus, self._epoll)
            line.begin_lost()
            self.lines[line.ordinal : line.ordinal + 1] = [line]
            self._rebuild(anew=True)  # nothing of it may arrive before there is a place for it
            if self.decoder is not None and len(self.decoder.tables.structure.buses) < len(self.lines):
                del self.lines[line.ordinal]
                raise ConfigurationError(f"bus {name} does not fit the others (what was logged says why)")
        self._serving[line] = self._beside(self._serve(line))

    async def remove_bus(self, name: str) -> None:
        """Stop the devices on a bus and go on without it; users see a new generation.

        Its place stays, empty, so that the sensors of the other buses keep their uids.

        Raises:
            ConfigurationError: there is no such bus, or it is the last one with sensors.
        """
        line = next((line for line in self.lines if line.name == name and line.reason != BusReason.REMOVED), None)
        if line is None:
            raise ConfigurationError(f"there is no bus {name}")
        if not any(other.patches for other in self.lines if other is not line):
            raise ConfigurationError(f"bus {name} is the last one with sensors; stop the driver instead")
        task = self._serving.pop(line)
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
        await line.stop()
        async with self._built:
            line.remove()
            self._rebuild()

    async def _shut_down(self, loop: asyncio.AbstractEventLoop) -> None:
        if self._desk is not None and self.writer is not None:
            loop.remove_reader(self.writer.request_server().fileno())
            await self._desk.close()
        for line in self.lines:
            await line.stop()
        loop.remove_reader(self._epoll.fileno())
        for timer in (self._timer, self._rest):
            if timer is not None:
                timer.cancel()
        for line in self.lines:
            line.bus.close()
        self._epoll.close()
        if self.writer is not None:
            self.writer.close()

    async def _serve(self, line: BusLine) -> None:
        """One bus from discovery to the end: describe, set up, then look after it."""
        await line.describe(self._build)
        beside = [self._beside(self._join_on_request(line)), self._beside(self._attend(line))]
        try:
            if not self._listen_only:
                await line.set_up()
                poller = Poller(line.link, line.bus.counters)
                beside.append(self._beside(poller.run(lambda: line.adapter.polls, line.lost.is_set)))
            await self._check_data(line)
            while True:
                if line.lost.is_set():
                    await line.reopen()
                await self._recover_silent_patches(line)
                with contextlib.suppress(TimeoutError):
                    # not wait_for: that of Python 3.11 forgets a cancellation that comes in the moment of a loss
                    async with asyncio.timeout(self._silence_ns / NS_PER_S):
                        await line.lost.wait()
        finally:
            for task in beside:
                task.cancel()
            await asyncio.gather(*beside, return_exceptions=True)

    def _beside(self, work: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
        """Start what goes on beside serving a bus; should it fail, the driver does."""

        def look(done: asyncio.Task[None]) -> None:
            if not done.cancelled() and done.exception() is not None:
                self._failure = done.exception()
                self._stopping.set()

        task = asyncio.get_running_loop().create_task(work)
        task.add_done_callback(look)
        return task

    async def _check_data(self, line: BusLine) -> None:
        """Wait for the first data of every patch, and name those that send none."""
        async with self._built:  # other buses may still be asked what hangs on them
            await self._built.wait_for(lambda: self.publisher is not None)
        timer = Periodic(_DATA_CHECKS_HZ)
        for _ in range(round(_DATA_CHECKS_HZ * max(_DATA_TIMEOUT_S, 5 * line.adapter.period_s))):
            if not line.lost.is_set() and not self._patches_in(line, PatchState.EXPECTED):
                break
            await asyncio.sleep((timer.deadline_ns - now_ns()) / NS_PER_S)
            timer.advance(now_ns())
        for patch in self._patches_in(line, PatchState.EXPECTED):
            log.warning("%s: %s sends no data", line.name, self._patch_name(patch))
        if self.publisher is not None and not self.ready:
            self.ready = True
            self._on_ready()

    async def _join_on_request(self, line: BusLine) -> None:
        while True:
            await self._join_requested.wait()
            self._join_requested.clear()
            try:
                patches = await line.adapter.join(line.link, line.patches or ())
            except BusError as error:
                log.warning("%s: nothing joined: %s", line.name, str(error))
                continue
            if patches:  # also the same ones: what is known of their types and frames may have changed
                line.patches = patches
                await self._build()

    # -- structure ------------------------------------------------------------------------------------------------

    async def _build(self) -> None:
        """(Re)build tables, decoder and writer once every bus has been asked what hangs on it."""
        async with self._built:
            self._rebuild()

    def _rebuild(self, *, anew: bool = False) -> None:
        """With ``_built`` held. ``anew``: also if nothing has changed but the bus behind a name."""
        if any(line.patches is None for line in self.lines) or not any(line.patches for line in self.lines):
            return
        adapters = [line.adapter for line in self.lines]
        try:
            tables = assemble(
                [(line.name, line.patches or ()) for line in self.lines],
                join_types([adapter.types for adapter in adapters]),
                np.result_type(*(adapter.dtype for adapter in adapters)),
            )
        except StructureError as error:
            log.error("what was found makes no skin: %s", error)
            return
        known = self.decoder
        is_known = known is not None and tables.structure == known.tables.structure and self._layouts == known.layouts
        if is_known and not anew:
            return
        self._go_over_to(tables)
        self._built.notify_all()

    def _go_over_to(self, tables: SkinTables) -> None:
        adapter = self.lines[0].adapter
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
                operations={name: operation.method for name, operation in operations_of(type(adapter)).items()},
            )
            server = writer.request_server()
            self._desk = RequestDesk(server, self.lines, self._listen_only, self._after_operation)
            asyncio.get_running_loop().add_reader(server.fileno(), self._desk.take)
        else:
            writer = self.writer
            writer.restructure(tables.structure, rate_hz=1 / self._period_s)
            log.info("new generation: %r", tables.structure)
        self.decoder = Decoder(self._layouts, tables)
        for line in self.lines:
            if line.patches:
                line.link.narrow(line.adapter.layout)
        self._watch = adapter.watch(tables)
        for line in self.lines:
            for key in line.suspects:
                if (line.ordinal, key) in tables.patch_key:
                    self._watch.suspect(tables.patch_key[line.ordinal, key])
        self._batch = self._make_batch(self.decoder.headroom)
        by_cycle = adapter.by_cycle if self._publish is None else self._publish != "rate"
        on_request = self._publish == "request"
        self.publisher = Publisher(writer, self.decoder, self._watch, self._period_s, by_cycle, self._desk, on_request)
        self._built_period_s = self._period_s
        self.publisher.bus_counters = [line.bus.counters for line in self.lines]
        self._known_patch_state = self.publisher.patch_state.copy()
        self._begun_ns = now_ns()
        self._publish_when_due()

    @property
    def _period_s(self) -> float:
        return max(line.adapter.period_s for line in self.lines)

    def _after_operation(self, line: BusLine, patches: Sequence[Patch], set_up: bool) -> None:
        if self.decoder is None or self._watch is None or line.patches is None:
            return
        if self._period_s != self._built_period_s or self._layouts != self.decoder.layouts:
            self._go_over_to(self.decoder.tables)
        elif set_up:
            first = _first_patch(self.decoder, line)
            for patch in patches:
                self._watch.forget(first + list(line.patches).index(patch))

    # -- data -----------------------------------------------------------------------------------------------------

    def _on_readable(self) -> None:
        """Take what has arrived, then let more arrive before the next look: a batch costs little more than a frame."""
        loop = asyncio.get_running_loop()
        begun_ns = now_ns()
        taken = self._take_frames()
        if taken == "nothing":
            loop.add_reader(self._epoll.fileno(), self._on_readable)
        else:
            loop.remove_reader(self._epoll.fileno())
            rest_s = min(_REST * (now_ns() - begun_ns) / NS_PER_S, _LONGEST_REST_S)
            self._rest = loop.call_later(rest_s if taken == "all" else 0, self._on_readable)

    def _take_frames(self) -> Literal["nothing", "all", "some"]:
        """Take what has arrived, of every bus its share."""
        for turn in range(_TURNS):
            events = self._epoll.poll(0)
            if not events:
                return "all" if turn else "nothing"
            if self.decoder is not None:
                self.decoder.put_back(self._batch)
            else:
                self._batch.clear()
            time_ns = now_ns()
            is_behind = False
            batch, by_fd = self._batch, {line.bus.fileno(): line for line in self.lines}
            ready = [by_fd[fd] for fd, _ in events if fd in by_fd]
            for number, line in enumerate(ready):
                batch.limit = batch.stop + (batch.capacity - batch.stop) // (len(ready) - number)
                try:
                    first = batch.stop
                    if line.bus.receive(batch, line.ordinal):
                        line.adapter.stamp(batch.wire[first : batch.stop], batch.time_ns[first : batch.stop])
                        line.heard_ns = time_ns
                        is_behind |= not batch.free
                except BusNotAvailable as error:
                    line.lose(error)
            self._digest()
            if not is_behind:
                return "all"
        return "some"

    def _digest(self) -> None:
        batch = self._batch
        if self.decoder is None or self.publisher is None:
            rows = np.arange(batch.start, batch.stop)
            for line, own in zip(self.lines, split_by_bus(batch, rows, len(self.lines)), strict=True):
                line.link.offer(batch, own)
            return
        found, foreign = self.decoder.decode(batch)
        if len(foreign):
            for line, own in zip(self.lines, split_by_bus(batch, foreign, len(self.lines)), strict=True):
                self.decoder.count_unknown(batch, line.link.offer(batch, own))
        self._update_bus_states()
        self.publisher.take(found)
        self._arm_timer()

    def _publish_when_due(self) -> None:
        if self.publisher is None:
            return
        self._take_frames()  # what has arrived comes first: this may be late
        self._update_bus_states()
        self.publisher.publish_if_due()
        self._log_patches()
        self._arm_timer()

    def _arm_timer(self) -> None:
        if self.publisher is None:
            return
        loop = asyncio.get_running_loop()
        due_s = self.publisher.deadline_ns / NS_PER_S
        if self._timer is not None:
            if not self._timer.cancelled() and loop.time() < self._timer.when() <= due_s:
                return  # it comes early enough and then looks again
            self._timer.cancel()
        self._timer = loop.call_at(due_s, self._publish_when_due)

    # -- buses and patches ----------------------------------------------------------------------------------------

    def _update_bus_states(self) -> None:
        self._machine.look()
        for line in self.lines:
            line.look(self._silence_ns)
            if self.publisher is not None:
                self.publisher.bus_state[line.ordinal] = line.state
                self.publisher.bus_reason[line.ordinal] = line.reason
                self.publisher.bus_since_ns[line.ordinal] = line.since_ns

    @property
    def _silence_ns(self) -> int:
        return self.publisher.silence_ns if self.publisher is not None else NS_PER_S // 2

    async def _recover_silent_patches(self, line: BusLine) -> None:
        if self._listen_only or line.lost.is_set() or line.busy.locked():
            return
        if now_ns() - max(line.opened_ns, self._begun_ns) < 2 * self._silence_ns:
            return  # nobody listened, the boards may send: to set them up again would move their baseline
        silent = [*self._patches_in(line, PatchState.STALE), *self._patches_in(line, PatchState.EXPECTED)]
        if now_ns() - line.revived_ns > 2 * self._silence_ns:  # set up anew, and no data came of it
            silent += self._patches_in(line, PatchState.RESTARTED)
        for patch in silent:
            try:
                if not await line.adapter.probe(line.link, self._patch_of(line, patch)):
                    continue
                log.warning("%s: %s is silent but answers: it has restarted", line.name, self._patch_name(patch))
            except BusError as error:
                log.debug("%s: %s", line.name, str(error))
                continue
            await self._revive(line, self._patch_of(line, patch))

    async def _revive(self, line: BusLine, patch: Patch) -> None:
        """Set one patch up anew."""
        async with line.busy:
            number = self._number_of(line, patch)
            if self.publisher is None or self._watch is None or self.decoder is None or number is None:
                return
            self.publisher.lose(number, PatchState.RESTARTED)
            self.decoder.forget(number)
            try:
                await line.adapter.revive(line.link, patch)
            except BusError as error:
                log.debug("%s: %s", line.name, str(error))
                self.publisher.lose(number, PatchState.STALE)
                return
            line.revived_ns = now_ns()
            line.suspects.discard(patch.key)
            self._watch.forget(number)

    async def _attend(self, line: BusLine) -> None:
        """Hear what devices say of themselves."""
        reviving: dict[int, asyncio.Task[None]] = {}

        def tell(patch: Patch, notice: Notice) -> None:
            number = self._number_of(line, patch)
            if self.publisher is None or self._watch is None or number is None:
                return
            if notice is Notice.SUSPECT:
                line.suspects.add(patch.key)
                self._watch.suspect(number)
            elif notice is Notice.SOUND:
                line.suspects.discard(patch.key)
                self._watch.forget(number)
            elif notice is Notice.LOST or self._listen_only:
                self.publisher.lose(number, PatchState.STALE)
            elif notice is Notice.CHANGED:
                self.publisher.lose(number, PatchState.STALE)
                self.join()
            elif patch.key not in reviving or reviving[patch.key].done():
                log.warning("%s: %s has restarted", line.name, patch.name)
                self.publisher.lose(number, PatchState.RESTARTED)
                reviving[patch.key] = self._beside(self._revive(line, patch))

        try:
            while True:
                try:
                    await line.adapter.attend(line.link, tell)
                    return
                except BusError as error:
                    log.debug("%s: %s", line.name, str(error))
                await asyncio.sleep(self._silence_ns / NS_PER_S)
        finally:
            for task in reviving.values():
                task.cancel()

    def _patches_in(self, line: BusLine, state: PatchState) -> list[int]:
        if self.publisher is None or self.decoder is None:
            return []
        of_bus = self.decoder.tables.structure.patch_bus == line.ordinal
        found: list[int] = np.flatnonzero(of_bus & (self.publisher.patch_state == state)).tolist()
        return found

    def _patch_of(self, line: BusLine, patch: int) -> Patch:
        if self.decoder is None or line.patches is None:
            raise LookupError("no structure yet")
        return line.patches[patch - _first_patch(self.decoder, line)]

    def _number_of(self, line: BusLine, patch: Patch) -> int | None:
        """Number of a patch in the present structure, None if it is not in it (any more)."""
        return None if self.decoder is None else self.decoder.tables.patch_key.get((line.ordinal, patch.key))

    def _patch_name(self, patch: int) -> str:
        return bytes(self.decoder.tables.structure.patch_name[patch]).decode() if self.decoder else str(patch)

    def _log_patches(self) -> None:
        """Tell each change of a patch's state once."""
        if self.publisher is None or self.decoder is None:
            return
        now, before = self.publisher.patch_state, self._known_patch_state
        for patch in np.flatnonzero(now != before).tolist():
            line = self.lines[int(self.decoder.tables.structure.patch_bus[patch])]
            if now[patch] == PatchState.STALE:
                log.warning("%s: %s fell silent", line.name, self._patch_name(patch))
            elif now[patch] == PatchState.LIVE and before[patch] != PatchState.EXPECTED:
                log.warning("%s: %s is live again", line.name, self._patch_name(patch))
        self._known_patch_state = now.copy()

    def status(self) -> dict[str, Any]:
        """Figures of every bus and patch, for ``skin-driver --json``."""
        return figures(self.lines, self._machine, self.writer, self.decoder, self.publisher)


def _first_patch(decoder: Decoder, line: BusLine) -> int:
    """Number of the first patch of a bus, in the order of all buses."""
    return int(np.argmax(decoder.tables.structure.patch_bus == line.ordinal))
