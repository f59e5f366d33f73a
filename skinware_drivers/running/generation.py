"""One structure of a driver's skin in service, and the loop in whose rests its frames flow in C."""

from __future__ import annotations

import asyncio
import ctypes
import logging
import selectors
from collections.abc import Callable, Iterator, Sequence

import numpy as np
import numpy.typing as npt

from skinware.realtime import NS_PER_S, now_ns
from skinware.status import BusState, DataPath, PatchState
from skinware_drivers.bus import FrameBatch, KernelBus, is_read_natively
from skinware_drivers.decoding.decoder import PATCH_COUNTERS, Decoder
from skinware_drivers.description import Patch, SkinTables
from skinware_drivers.native import structs
from skinware_drivers.polling import Watch
from skinware_drivers.running.bus_line import BusLine
from skinware_drivers.running.guard import hook
from skinware_drivers.running.native_path import NativePath, Rows
from skinware_drivers.running.news import Doubles, PatchChange
from skinware_drivers.running.publisher import NEVER_NS, Publisher

log: logging.Logger = logging.getLogger("skinware.driver")

_UPDATES = PATCH_COUNTERS.index("updates")
_LOOK_PAUSE_NS = NS_PER_S // 20
_SHARE, _SHORTEST_S, _LONGEST_S = 0.25, 0.001, 0.020


def latency_for(period_s: float) -> float:
    """Return the longest rest between two batches, s, for patches that send with this period, s."""
    return min(max(_SHARE * period_s, _SHORTEST_S), _LONGEST_S)


def make_batch(lines: Sequence[BusLine], headroom: int = 0) -> FrameBatch:
    return FrameBatch.for_buses(len(lines), max(line.adapter.payload_size for line in lines), headroom)


def split_by_bus(batch: FrameBatch, rows: npt.NDArray[np.int64], n_buses: int) -> Sequence[npt.NDArray[np.int64]]:
    bus = batch.bus[rows]
    return [rows[bus == ordinal] for ordinal in range(n_buses)]


def make_watch(lines: Sequence[BusLine], tables: SkinTables) -> Watch:
    """Return the driver's watch, which knows already of the patches that report errors."""
    with hook("watch", *(line.name for line in lines), of_all=True):
        watch = lines[0].adapter.watch(tables)
    for line in lines:
        for key in line.suspects:
            patch = tables.patch_key.get((line.ordinal, key))
            if patch is not None:
                with hook("Watch.suspect", line.name, of_all=True):
                    watch.suspect(patch)
    return watch


class Generation:
    """One structure in service.

    Attributes:
        lines: the buses; the list may change, their places do not.
        period_s: nominal time between two updates, for the publisher.
        begun_ns: when it began, CLOCK_MONOTONIC ns.
        flows: C reads the buses that it can read (see :class:`FlowSelector`).
    """

    def __init__(
        self, lines: Sequence[BusLine], decoder: Decoder, watch: Watch, publisher: Publisher, period_s: float
    ) -> None:
        self.lines, self.decoder, self.watch, self.publisher = lines, decoder, watch, publisher
        self.period_s = period_s
        self.tables = decoder.tables
        self.batch = make_batch(lines, decoder.compiled.headroom)
        self.begun_ns = now_ns()
        self.flows: bool = False
        self._known_state = publisher.patches.state.copy()
        self._known_losses: dict[int, tuple[int, ...]] = {}
        self._look_ns = 0
        self._doubles = Doubles(self.tables.structure, publisher.pace.period_ns)
        self.publisher.buses.counters = [line.bus.counters for line in self.lines]
        self.decoder.samples = [line.bus.samples for line in self.lines]
        self.path = NativePath(self.decoder, self.publisher, self.batch)
        self.path.listeners.hear, self.path.listeners.offer = self._hear, self._offer
        for line in self.lines:
            if line.patches:
                line.link.narrow(line.adapter.layout)

    def empty_batch(self) -> FrameBatch:
        """Return the batch, empty except for frames that wait for their partners."""
        self.path.empty()
        return self.batch

    def digest(self, _batch: FrameBatch) -> None:
        """Decode the batch, and publish snapshots that are due."""
        self.update_bus_states(settled=now_ns() >= self._look_ns)
        self.announce_waits()
        self.path.digest(self.interrupted())

    def announce_waits(self) -> None:
        """Set the frames that handshakes wait for; before each call of C."""
        expects_data = any(line.link.expects_data for line in self.lines)
        self.path.announce_waits(expects_data, [wanted for line in self.lines for wanted in line.link.awaited])

    def _hear(self, rows: Rows) -> None:
        for line, own in zip(self.lines, split_by_bus(self.batch, rows, len(self.lines)), strict=True):
            line.link.hear(self.batch, own)

    def _offer(self, rows: Rows) -> Rows:
        """Give rows that are of no module to the handshakes that wait; return the rest."""
        by_bus = split_by_bus(self.batch, rows, len(self.lines))
        return np.concatenate([line.link.offer(self.batch, own) for line, own in zip(self.lines, by_bus, strict=True)])

    def interrupted(self) -> list[int]:
        """Return the buses that are known to have lost frames since the last call."""
        losses = {line.ordinal: line.losses for line in self.lines}
        before, self._known_losses = self._known_losses, losses
        return [ordinal for ordinal, now in losses.items() if now != before.get(ordinal, now)]

    def update_bus_states(self, settled: bool = True) -> None:
        """Publish the states of the buses; if settled, look also at those that were in order the last time."""
        if settled:
            self._look_ns = now_ns() + _LOOK_PAUSE_NS
        for line in self.lines:
            if not settled and line.condition.is_in_order:
                continue
            line.look(self.publisher.pace.silence_ns)
            buses, number, condition = self.publisher.buses, line.ordinal, line.condition
            buses.state[number], buses.reason[number] = condition.state, condition.reason
            buses.since_ns[number], buses.load[number] = condition.since_ns, condition.limits.permille
            buses.samples[number] = line.bus.samples.rows
            in_c = self.flows and is_read_natively(line.bus)
            buses.data_path[number] = DataPath.NATIVE if in_c else DataPath.PYTHON

    def number_of(self, line: BusLine, patch: Patch) -> int | None:
        return self.tables.patch_key.get((line.ordinal, patch.key))

    def name_of(self, patch: int) -> str:
        return bytes(self.tables.structure.patch_name[patch]).decode()

    def patches_in(self, line: BusLine, *states: PatchState) -> list[Patch]:
        if not line.patches:
            return []
        state = self.publisher.patches.state[self.tables.structure.patch_bus == line.ordinal]
        return [line.patches[number] for number in np.flatnonzero(np.isin(state, states)).tolist()]

    def note_patches(self) -> Iterator[PatchChange]:
        """Note changes of the patches' states, and the buses that need care; yield the changes that were logged."""
        now, before = self.publisher.patches.state, self._known_state
        for patch in np.flatnonzero(now != before).tolist():
            line = self.lines[int(self.tables.structure.patch_bus[patch])]
            if line.busy.locked():
                continue  # its devices are being set up, and may be silent for it
            is_live = bool(now[patch] == PatchState.LIVE)
            if now[patch] == PatchState.STALE or (is_live and before[patch] != PatchState.EXPECTED):
                line.patch_news.note(self.name_of(patch), is_live=is_live)
            before[patch] = now[patch]
        for bus in set(self.tables.structure.patch_bus[now != PatchState.LIVE].tolist()):
            self.lines[bus].needs_care.set()
        for patch, ratio in self._doubles.look(self.decoder.state.patch_counters[:, _UPDATES]):
            log.warning(
                "%s has sent %.1f times as much as its period allows for a while: do two devices send with one"
                " identifier? Their values would mix. Unplug one and look, or give the driver the right period"
                " (period_ms, period_s); logged once",
                self.name_of(patch),
                ratio,
            )
        for line in self.lines:
            change = line.patch_news.catch_up()
            if change is not None:
                yield change


_OTHER_BUS, _NEWS, _NO_MEMORY = range(2, 5)  # of flow.c
_LATENCY_WHILE_ASKING_S, _LATENCY_IN_STEP_S = 5e-4, 5e-5
"""The longest rest while devices are asked, and while only the answer comes before the next question."""


class FlowSelector(selectors.EpollSelector):
    """A selector that waits in ``flow``, called with its descriptor and the longest wait, s; None: it only waits.

    It takes and publishes frames meanwhile, in one call without the interpreter lock, until the loop's next timer, or
    until another descriptor is readable, or until the frames need Python (a coroutine waits for one, a bus went away).
    """

    def __init__(self) -> None:
        super().__init__()
        self.flow: Callable[[int, float | None], None] | None = None

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        if self.flow is None or (timeout is not None and timeout <= 0):
            return super().select(timeout)
        self.flow(self.fileno(), timeout)
        return super().select(0)


class FlowLoop(asyncio.SelectorEventLoop):
    """An event loop in whose rests frames flow."""

    def __init__(self) -> None:
        self.selector = FlowSelector()
        super().__init__(self.selector)


class Flow:
    """The buses of one generation while C reads them; C returns when a bus that it cannot read is readable."""

    def __init__(
        self,
        generation: Generation,
        epoll_fd: int,
        latency_s: float,
        take: Callable[[], object],
        fail: Callable[[BaseException], None],
    ) -> None:
        self._generation, self._path = generation, generation.path
        self._lines, self._batch = generation.lines, generation.batch
        self._latency_s = latency_s
        self._take, self._fail = take, fail
        self._flow = structs.Flow(epoll_fd=epoll_fd)
        self._sources = (structs.Source * 0)()
        self._handed: list[tuple[BusLine, KernelBus, structs.Source]] = []
        listeners = self._path.listeners
        listeners.sort_out, listeners.lose = self._sort_out, self._lose
        listeners.heard = self._heard

    def run(self, loop_fd: int, timeout_s: float | None) -> None:
        """Let frames flow, at most for a time, s."""
        try:
            reason = self._run(loop_fd, timeout_s)
        except BaseException as error:  # noqa: BLE001
            self._fail(error)
            return
        if reason == _NO_MEMORY:
            self._fail(MemoryError("no memory for the updates of a driver"))
        elif reason == _NEWS:
            self._generation.update_bus_states()
        elif reason == _OTHER_BUS:
            asyncio.get_running_loop().call_soon(self._take)

    def _run(self, loop_fd: int, timeout_s: float | None) -> int:
        flow = self._flow
        flow.loop_fd = loop_fd
        flow.until_ns = NEVER_NS if timeout_s is None else now_ns() + round(timeout_s * NS_PER_S)
        flow.silence_ns = max(NS_PER_S // 2, self._generation.publisher.pace.silence_ns)
        flow.latency_ns = round(self._rest_s() * NS_PER_S)
        self._hand_over()
        self._generation.announce_waits()
        self._path.interrupt(self._generation.interrupted())
        try:
            return self._path.run(flow)
        finally:
            for line, bus, source in self._handed:
                line.condition.heard_ns = source.heard_ns
                bus.take_back(source)
            self._generation.interrupted()  # C knows of these

    def _rest_s(self) -> float:
        links = [line.link for line in self._lines]
        if any(line.bus.asks for line in self._lines):
            return 0.0
        if any(link.expects_data for link in links):
            return min(self._latency_s, _LATENCY_IN_STEP_S)
        if any(link.is_awaiting for link in links):
            return min(self._latency_s, _LATENCY_WHILE_ASKING_S)
        return self._latency_s

    def _hand_over(self) -> None:
        if len(self._sources) < len(self._lines):
            self._sources = (structs.Source * len(self._lines))()
            self._flow.sources = ctypes.addressof(self._sources)
        self._handed = []
        for line in self._lines:
            source = self._sources[len(self._handed)]
            source.stream = source.asker = source.can = None
            if isinstance(line.bus, KernelBus) and line.bus.hand_over(self._batch, source):
                source.bus = line.ordinal
                source.heard_ns = line.condition.heard_ns
                source.is_watched = line.condition.state != BusState.LIVE
                self._handed.append((line, line.bus, source))
        n_open = sum(line.bus.fileno() >= 0 for line in self._lines)
        self._flow.n_sources, self._flow.has_others = len(self._handed), n_open > len(self._handed)

    def _heard(self) -> None:
        for line, _, source in self._handed:
            line.condition.heard_ns = source.heard_ns
        self._generation.update_bus_states()
        for line, _, source in self._handed:
            source.is_watched = line.condition.state != BusState.LIVE

    def _bus(self, ordinal: int) -> KernelBus:
        return next(bus for line, bus, _ in self._handed if line.ordinal == ordinal)

    def _sort_out(self, bus: int, first: int, n: int) -> int:
        kept = self._bus(bus).sort_out(self._batch, slice(first, first + n))
        self._path.interrupt(self._generation.interrupted())
        return kept

    def _lose(self, bus: int, number: int) -> None:
        line = self._lines[bus]
        try:
            self._bus(bus).nothing_received(number)
        except Exception as error:  # noqa: BLE001  (the bus cannot be trusted any more)
            line.lose("receive", error)
