"""Takes frames from the buses of a driver, has them decoded, and publishes when a snapshot is due."""

from __future__ import annotations

import asyncio
import logging
import select
import time
from collections.abc import Callable, Sequence

import numpy as np

from skinware.realtime import NS_PER_S, now_ns
from skinware_drivers.bus import FrameBatch
from skinware_drivers.running.bus_line import BusLine
from skinware_drivers.running.flow import FlowLoop, flow_of
from skinware_drivers.running.generation import Generation, make_batch, split_by_bus
from skinware_drivers.running.guard import Ending
from skinware_drivers.running.intake import Intake, latency_for
from skinware_drivers.running.news import MachineLimits, PatchChange

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
        if asleep_ns > _HELD_UP_NS:
            log.warning("this machine was suspended for %.1f s: silence is counted from now on", asleep_ns / NS_PER_S)
        elif late_ns > _WORTH_A_LINE_NS:
            log.warning(
                "this process was held up for %.1f s (stopped, or without processor time): silence is counted from"
                " now on",
                late_ns / NS_PER_S,
            )
        return since_ns, max(0, asleep_ns)


def _slept_ns() -> int:
    """Return how long the machine has been suspended since it booted."""
    return time.clock_gettime_ns(time.CLOCK_BOOTTIME) - time.clock_gettime_ns(time.CLOCK_MONOTONIC)


class DataLoop:
    """The data path of a driver in its event loop.

    Args:
        on_patches: called with patches that fell silent, or are live again.
    """

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
            take = self._ending.guard(self._intake.take)
            flow = flow_of(generation, self._epoll.fileno(), self._intake.latency_s, take, self._ending.fail)
            generation.flows = flow is not None
            loop.selector.flow = None if flow is None else flow.run
            if flow is None:
                self._intake.start()
            else:
                self._intake.stop()
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
        self._attend(generation)
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        if not generation.flows:
            self._intake.take()  # what has arrived comes first: this may be late
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
