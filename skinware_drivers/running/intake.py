"""Take frames from all buses of a driver: one epoll, one batch, and a share for every bus."""

from __future__ import annotations

import asyncio
import select
from collections.abc import Callable, Sequence
from typing import Literal

from skinware.realtime import NS_PER_S, now_ns
from skinware_drivers.bus import FrameBatch
from skinware_drivers.running.bus_line import BusLine

_TURNS, _TURN_NS = 8, NS_PER_S // 50  # full batches per wake-up, and how long, before all else gets its turn
_REST, _REST_WHILE_ASKING, _REST_IN_STEP = 16, 4, 1
"""The rest after a take, as a multiple of its duration; more frames arrive meanwhile (decision 0006)."""
_SHARE = 0.25
_SHORTEST_S, _LONGEST_S = 0.001, 0.020


def latency_for(period_s: float) -> float:
    """Return the longest rest, s, for patches that send with this period, s: a quarter of it, 1 to 20 ms."""
    return min(max(_SHARE * period_s, _SHORTEST_S), _LONGEST_S)


class Intake:
    """Takes frames when some have arrived, and then rests for a moment so that more are taken together.

    Args:
        latency_s: the longest rest; may be changed.
        guard: makes a callback safe for the event loop (:meth:`.guard.Ending.guard`).

    Attributes:
        read_until_ns: all frames that arrived until then were taken, CLOCK_MONOTONIC ns.
    """

    def __init__(
        self,
        epoll: select.epoll,
        lines: Sequence[BusLine],
        empty_batch: Callable[[], FrameBatch],
        digest: Callable[[FrameBatch], None],
        latency_s: float,
        guard: Callable[[Callable[[], None]], Callable[[], None]] = lambda callback: callback,
    ) -> None:
        self._epoll = epoll
        self._lines = lines
        self._empty_batch = empty_batch
        self._digest = digest
        self.latency_s: float = latency_s
        self.read_until_ns: int = 0
        self._look = guard(self._on_readable)
        self._rest: asyncio.TimerHandle | None = None
        self._by_fd: dict[int, BusLine] = {}

    def start(self) -> None:
        self._end_rest()  # two looks pending would be one that stop() does not know
        asyncio.get_running_loop().add_reader(self._epoll.fileno(), self._look)

    def stop(self) -> None:
        asyncio.get_running_loop().remove_reader(self._epoll.fileno())
        self._end_rest()

    def _end_rest(self) -> None:
        if self._rest is not None:
            self._rest.cancel()
            self._rest = None

    def take(self) -> Literal["nothing", "all", "some"]:
        """Take the frames that have arrived; ``some``: more are waiting."""
        begun_ns = now_ns()
        for turn in range(_TURNS):
            time_ns = now_ns()
            if time_ns - begun_ns > _TURN_NS:
                return "some"
            events = self._epoll.poll(0)
            if not events:
                self.read_until_ns = time_ns
                return "all" if turn else "nothing"
            batch = self._empty_batch()
            is_all = self._fill(batch, [fd for fd, _ in events], time_ns)
            self._digest(batch)
            if is_all:
                return "all"
        return "some"

    def _on_readable(self) -> None:
        """Take, then let more arrive before the next look: a batch costs little more than a frame."""
        loop = asyncio.get_running_loop()
        begun_ns = now_ns()
        taken = self.take()
        if taken == "nothing":
            self.start()
        else:
            loop.remove_reader(self._epoll.fileno())
            links = [line.link for line in self._lines]
            asks = any(line.bus.asks for line in self._lines)
            factor = _REST_WHILE_ASKING if any(link.is_awaiting for link in links) else _REST
            if asks or any(link.expects_data for link in links):
                factor = _REST_IN_STEP  # only the answer comes, and then the next question
            rest_s = min(factor * (now_ns() - begun_ns) / NS_PER_S, self.latency_s)
            self._rest = loop.call_later(rest_s if taken == "all" else 0, self._look)

    def _fill(self, batch: FrameBatch, fds: Sequence[int], time_ns: int) -> bool:
        """Fill a batch from the buses that have frames.

        Returns:
            Whether no bus had more than its share.
        """
        ready = [line for fd in fds if (line := self._line_of(fd)) is not None]
        is_all, self.read_until_ns = True, time_ns
        for number, line in enumerate(ready):
            batch.limit = batch.stop + (batch.capacity - batch.stop) // (len(ready) - number)
            try:
                if line.bus.receive(batch, line.ordinal):
                    line.condition.heard_ns = time_ns
                    if not batch.free:
                        is_all = False
                        self.read_until_ns = min(self.read_until_ns, int(batch.time_ns[batch.stop - 1]) - 1)
            except Exception as error:  # noqa: BLE001  (the bus cannot be trusted any more)
                line.lose("receive", error)
        return is_all

    def _line_of(self, fd: int) -> BusLine | None:
        line = self._by_fd.get(fd)
        if line is None or line.bus.fileno() != fd:
            self._by_fd = {line.bus.fileno(): line for line in self._lines}
            line = self._by_fd.get(fd)
        return line
