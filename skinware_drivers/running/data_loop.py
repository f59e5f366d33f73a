"""Takes frames from the buses of a driver, has them decoded, and publishes when a snapshot is due."""

from __future__ import annotations

import asyncio
import logging
import select
import time
from collections.abc import Callable, Sequence
from typing import Literal

import numpy as np

from skinware.realtime import NS_PER_S, now_ns
from skinware_drivers.bus import FrameBatch, is_read_natively
from skinware_drivers.running.bus_line import BusLine
from skinware_drivers.running.generation import Flow, FlowLoop, Generation, latency_for, make_batch, split_by_bus
from skinware_drivers.running.guard import Ending
from skinware_drivers.running.news import MachineLimits, PatchChange

_TURNS, _TURN_NS = 8, NS_PER_S // 50  # full batches per wake-up, and how long, before all else gets its turn
_REST, _REST_WHILE_ASKING, _REST_IN_STEP = 16, 4, 1
"""The rest after a take, as a multiple of its duration; more frames arrive meanwhile (decision 0006)."""


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
        if taken == "nothing" or self.latency_s <= 0:
            if self._rest is not None:
                self.start()
            return
        loop.remove_reader(self._epoll.fileno())
        links = [line.link for line in self._lines]
        asks = any(line.bus.asks for line in self._lines)
        factor = _REST_WHILE_ASKING if any(link.is_awaiting for link in links) else _REST
        if asks or any(link.expects_data for link in links):
            factor = _REST_IN_STEP  # only the answer comes, and then the next question
        rest_s = min(factor * (now_ns() - begun_ns) / NS_PER_S, self.latency_s)
        self._rest = loop.call_later(rest_s if taken == "all" else 0, self._look)

    def _fill(self, batch: FrameBatch, fds: Sequence[int], time_ns: int) -> bool:
        """Fill a batch from the buses that have frames; return whether none had more than its share."""
        if any(fd not in self._by_fd or self._by_fd[fd].bus.fileno() != fd for fd in fds):
            self._by_fd = {line.bus.fileno(): line for line in self._lines}
        ready = [self._by_fd[fd] for fd in fds if fd in self._by_fd]
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


log: logging.Logger = logging.getLogger("skinware.driver")

_LOOK_S = 0.5
"""Between two looks at files, states and counters while C publishes."""
_HELD_UP_NS = NS_PER_S // 10
"""Half of the shortest time after which anything counts as silent."""
_WORTH_A_LINE_NS = NS_PER_S


class Attention:
    """Notices when this process was stopped, had no processor time, or slept with its machine.

    A patch that falls silent in such a time has not fallen silent.
    """

    def __init__(self) -> None:
        self._looked_ns = now_ns()
        self._slept_ns = _slept_ns()

    def look(self, due_ns: int | None) -> tuple[int, int] | None:
        """Look at the clocks.

        Args:
            due_ns: when the event loop should have looked at the latest, CLOCK_MONOTONIC ns; None: at no certain time.

        Returns:
            When this process last ran, CLOCK_MONOTONIC ns, and how long the machine was suspended since, which that
            clock does not count; None: it was not held up.
        """
        time_ns, slept_ns, since_ns = now_ns(), _slept_ns(), self._looked_ns
        late_ns = 0 if due_ns is None else time_ns - max(due_ns, since_ns)
        asleep_ns = slept_ns - self._slept_ns
        self._looked_ns, self._slept_ns = time_ns, slept_ns
        if max(late_ns, asleep_ns) <= _HELD_UP_NS:
            return None
        if asleep_ns <= _HELD_UP_NS:  # two clocks are never read at the same moment
            asleep_ns = 0
        if asleep_ns:
            log.warning("this machine was suspended for %.1f s: silence is counted from now on", asleep_ns / NS_PER_S)
        elif late_ns > _WORTH_A_LINE_NS:
            log.warning(
                "this process was held up for %.1f s (stopped, or without processor time): silence is counted from"
                " now on",
                late_ns / NS_PER_S,
            )
        return since_ns, asleep_ns


def _slept_ns() -> int:
    """Return how long the machine has been suspended since it booted, not bent by a pause between two clocks."""
    reads = []
    for _ in range(3):
        before_ns, boot_ns = time.monotonic_ns(), time.clock_gettime_ns(time.CLOCK_BOOTTIME)
        after_ns = time.monotonic_ns()
        reads.append((after_ns - before_ns, boot_ns - (before_ns + after_ns) // 2))
    return min(reads)[1]


class DataLoop:
    """The data path of a driver in its event loop."""

    def __init__(
        self,
        epoll: select.epoll,
        lines: Sequence[BusLine],
        ending: Ending,
        on_patches: Callable[[PatchChange], None],
    ) -> None:
        self._epoll, self._lines, self._ending, self._on_patches = epoll, lines, ending, on_patches
        self.machine = MachineLimits()
        self._attention = Attention()
        self._first_batch = make_batch(lines)
        self._generation: Generation | None = None
        latency_s = latency_for(min(line.adapter.period_s for line in lines))
        self._intake = Intake(epoll, lines, self._empty_batch, self._digest, latency_s, ending.guard)
        self._timer: asyncio.TimerHandle | None = None

    def start(self) -> None:
        """Begin to take frames, for the handshakes: there is no structure yet."""
        self._intake.start()

    def begin(self, generation: Generation) -> None:
        """Decode and publish for this generation from now on; let C read the buses that it can read."""
        self._generation = generation
        self._intake.latency_s = int(generation.publisher.latency_ns[0]) / NS_PER_S
        loop = asyncio.get_running_loop()
        if isinstance(loop, FlowLoop):
            generation.flows = any(is_read_natively(line.bus) for line in generation.lines if not line.is_removed)
            if generation.flows:
                take = self._ending.guard(self._intake.take)
                flow = Flow(generation, self._epoll.fileno(), self._intake.latency_s, take, self._ending.fail)
                loop.selector.flow = flow.run
                self._intake.stop()
            else:
                loop.selector.flow = None
                self._intake.start()
        self._ending.guard(self._publish_when_due)()

    def stop(self) -> None:
        """Take no more frames, and publish nothing."""
        loop = asyncio.get_running_loop()
        if isinstance(loop, FlowLoop):
            loop.selector.flow = None
        self._intake.stop()
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _empty_batch(self) -> FrameBatch:
        if self._generation is not None:
            return self._generation.empty_batch()
        self._first_batch.clear()
        return self._first_batch

    def _digest(self, batch: FrameBatch) -> None:
        if self._generation is not None:
            self._attend(self._generation)
            self.machine.look()
            self._generation.digest(batch)
            self._arm_timer(self._generation)
            return
        rows = np.arange(batch.start, batch.stop)
        for line, own in zip(self._lines, split_by_bus(batch, rows, len(self._lines)), strict=True):
            line.link.hear(batch, own)
            line.link.offer(batch, own)

    def _attend(self, generation: Generation) -> None:
        hold_up = self._attention.look(None if self._timer is None else round(self._timer.when() * NS_PER_S))
        if hold_up is not None:
            generation.publisher.excuse(*hold_up)
            for line in self._lines:
                line.condition.excuse(hold_up[0], generation.publisher.pace.silence_ns)

    def _publish_when_due(self) -> None:
        generation = self._generation
        if generation is None:
            return
        if not generation.flows:
            self._intake.take()  # what has arrived comes first: this may be late
        self._attend(generation)
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        generation.publisher.writer.keep_files()
        self.machine.look()
        generation.update_bus_states()
        generation.path.publish_if_due(self._intake.read_until_ns)
        for change in generation.note_patches():
            self._on_patches(change)
        self._arm_timer(generation)

    def _arm_timer(self, generation: Generation) -> None:
        loop = asyncio.get_running_loop()
        due_s = loop.time() + _LOOK_S if generation.flows else generation.path.deadline_ns / NS_PER_S
        if self._timer is not None:
            if self._timer.when() <= due_s:
                return  # it comes early enough and then looks again; also if it is due in this turn of the loop
            self._timer.cancel()
        self._timer = loop.call_at(due_s, self._ending.guard(self._publish_when_due))
