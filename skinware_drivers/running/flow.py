"""Frames flow from sockets into the ring in C, in the place of the event loop's rest.

An event loop that has nothing to do waits in its selector. Here it is there that frames are taken, published and rested
from, in one call without the interpreter lock, until the loop's next moment, or until something else has become
readable, or until the frames need Python (somebody waits for one, a bus went away).
"""

from __future__ import annotations

import asyncio
import ctypes
import selectors
from collections.abc import Callable, Sequence

from skinware.realtime import NS_PER_S, now_ns
from skinware.status import BusState
from skinware_drivers.bus import Received
from skinware_drivers.counters import OWN_BUS_COUNTERS
from skinware_drivers.native import structs
from skinware_drivers.running.bus_line import BusLine
from skinware_drivers.running.generation import Generation
from skinware_drivers.running.guard import bus_failure
from skinware_drivers.running.native_path import NativePath

_NEVER_NS = (1 << 63) - 1
_OTHER_BUS, _NEWS, _NO_MEMORY = range(2, 5)  # of flow.c
_LATENCY_WHILE_ASKING_S, _LATENCY_IN_STEP_S = 5e-4, 5e-5
"""The longest rest while devices are asked, and while the answer alone is what comes before the next question."""
_LOST, _FRAMES = OWN_BUS_COUNTERS.index("lost"), OWN_BUS_COUNTERS.index("frames")


class FlowSelector(selectors.EpollSelector):
    """A selector in whose waits frames flow.

    Attributes:
        flow: what lets them; called with this selector's descriptor and the longest wait, s. None: it only waits.
    """

    def __init__(self) -> None:
        super().__init__()
        self.flow: Callable[[int, float | None], None] | None = None

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        """Wait as any selector does."""
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
    """The buses of one generation, as long as C reads them.

    Args:
        generation: what is in service.
        path: its data path.
        lines: the buses; the list may change.
        epoll_fd: in which open buses are registered.
        latency_s: the longest rest.
        take: called in the loop when a bus has something that Python has to read.
        fail: called with what goes wrong.
    """

    def __init__(
        self,
        generation: Generation,
        path: NativePath,
        lines: Sequence[BusLine],
        epoll_fd: int,
        latency_s: float,
        take: Callable[[], object],
        fail: Callable[[BaseException], None],
    ) -> None:
        self._generation, self._path, self._lines, self._batch = generation, path, lines, generation.batch
        self._latency_s = latency_s
        self._take, self._fail = take, fail
        self._flow = structs.Flow(epoll_fd=epoll_fd)
        self._sources = (structs.Source * 0)()
        self._line_of: list[BusLine] = []
        path.sort_out, path.lose, path.heard = self._sort_out, self._lose, self._heard

    def run(self, loop_fd: int, timeout_s: float | None) -> None:
        """Let frames flow, for so long at the most."""
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
        flow.silence_ns = max(NS_PER_S // 2, self._generation.publisher.silence_ns)
        flow.latency_ns = round(self._rest_s() * NS_PER_S)
        self._hand_over()
        self._generation.prepare_native()
        self._path.interrupt(self._generation.interrupted())
        try:
            return self._path.run(flow)
        finally:
            self._take_back()
            self._generation.interrupted()  # C knows of these

    def _rest_s(self) -> float:
        links = [line.link for line in self._lines]
        if any(link.expects_data for link in links):
            return min(self._latency_s, _LATENCY_IN_STEP_S)
        if any(link.is_awaiting for link in links):
            return min(self._latency_s, _LATENCY_WHILE_ASKING_S)
        return self._latency_s

    def _hand_over(self) -> None:
        handed = [(line, source) for line in self._lines if (source := line.bus.hand_over(self._batch)) is not None]
        if len(handed) != len(self._sources):
            self._sources = (structs.Source * len(handed))()
            self._flow.sources, self._flow.n_sources = ctypes.addressof(self._sources), len(handed)
        self._line_of = [line for line, _ in handed]
        for at, (line, source) in zip(self._sources, handed, strict=True):
            at.fd, at.bus, at.headers, at.control = source.fd, line.ordinal, source.headers, source.control
            at.offset_ns, at.last_poll_ns = source.offset_ns, source.last_poll_ns
            at.lost_before, at.lost, at.frames = source.lost_before, line.bus.counters.lost, 0
            at.lost_column, at.frames_column = _LOST, _FRAMES
            at.is_counted, at.speed_up, at.wire_bits, at.fullest = source.is_counted, source.speed_up, 0.0, 0.0
            at.is_small = source.is_small
            at.heard_ns, at.is_watched = line.heard_ns, line.state != BusState.LIVE

    def _take_back(self) -> None:
        for line, at in zip(self._line_of, self._sources, strict=True):
            line.heard_ns = at.heard_ns
            line.bus.take_back(Received(at.offset_ns, at.last_poll_ns, at.frames, at.lost, at.wire_bits, at.fullest))

    def _heard(self) -> None:
        """A bus that was silent is not."""
        for line, at in zip(self._line_of, self._sources, strict=True):
            line.heard_ns = at.heard_ns
        self._generation.update_bus_states()
        for line, at in zip(self._line_of, self._sources, strict=True):
            at.is_watched = line.state != BusState.LIVE

    def _sort_out(self, bus: int, first: int, n: int) -> int:
        kept = self._lines[bus].bus.sort_out(self._batch, slice(first, first + n))
        self._path.interrupt(self._generation.interrupted())
        return kept

    def _lose(self, bus: int, number: int) -> None:
        line = self._lines[bus]
        try:
            line.bus.nothing_received(number)
        except Exception as error:  # noqa: BLE001  (whatever it is: the bus cannot be trusted any more)
            line.lose(bus_failure(line.name, "receive", error))
