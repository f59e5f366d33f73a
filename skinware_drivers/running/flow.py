"""Let frames flow from sockets and serial lines into the ring in C, while the event loop rests.

An event loop that has nothing to do waits in its selector. Here, the selector takes and publishes frames meanwhile, in
one call without the interpreter lock, until the loop's next timer, or until another descriptor is readable, or until
the frames need Python (a coroutine waits for one, a bus went away).
"""

from __future__ import annotations

import asyncio
import ctypes
import selectors
from collections.abc import Callable

from skinware.realtime import NS_PER_S, now_ns
from skinware.status import BusState
from skinware_drivers.bus import KernelBus
from skinware_drivers.native import structs
from skinware_drivers.running.bus_line import BusLine
from skinware_drivers.running.generation import Generation

_NEVER_NS = (1 << 63) - 1
_OTHER_BUS, _NEWS, _NO_MEMORY = range(2, 5)  # of flow.c
_LATENCY_WHILE_ASKING_S, _LATENCY_IN_STEP_S = 5e-4, 5e-5
"""The longest rest while devices are asked, and while only the answer comes before the next question."""


class FlowSelector(selectors.EpollSelector):
    """A selector that waits in ``flow``, called with its descriptor and the longest wait, s; None: it only waits."""

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
        flow.until_ns = _NEVER_NS if timeout_s is None else now_ns() + round(timeout_s * NS_PER_S)
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
            source.stream = source.asker = None
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
