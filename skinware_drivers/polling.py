"""Asking devices that only answer, at absolute deadlines."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from skinware.errors import BusSendError, ConfigurationError
from skinware.realtime import NS_PER_S, Periodic, now_ns
from skinware_drivers.counters import BusCounters
from skinware_drivers.link import Link


@dataclass(frozen=True)
class Poll:
    """A frame that is sent again and again, so that devices answer it with data.

    Attributes:
        identifier: of the frame.
        payload: of the frame.
        period_s: time from one to the next, s.

    Raises:
        ConfigurationError: a period that is not above 0.
    """

    identifier: int
    payload: bytes
    period_s: float

    def __post_init__(self) -> None:
        if not self.period_s > 0:
            raise ConfigurationError(f"poll {self.identifier:03X} every {self.period_s} s: give more than 0")


class Poller:
    """Sends the polls of one bus.

    Every poll has deadlines of its own. One that cannot be kept (the bus took no more frames, or this process had no
    processor time) is counted as missed and not made up for: the next poll goes out at the next deadline.

    Args:
        link: the bus.
        counters: of the bus; ``polls_missed`` is counted in them.
    """

    def __init__(self, link: Link, counters: BusCounters) -> None:
        self._link = link
        self._counters = counters

    async def run(self, polls: Callable[[], Sequence[Poll]], is_away: Callable[[], bool]) -> None:
        """Send what ``polls`` names, as long as it names any; the first of each at once.

        Args:
            polls: asked again after every poll: what is to be sent may change.
            is_away: the bus is lost: nothing is sent, and nothing missed.
        """
        timers: dict[Poll, Periodic] = {}
        while True:
            timers = {poll: timers.get(poll) or _starting_now(poll) for poll in polls()}
            if not timers:
                return
            poll, timer = min(timers.items(), key=lambda item: item[1].deadline_ns)
            await asyncio.sleep((timer.deadline_ns - now_ns()) / NS_PER_S)
            missed_before = timer.missed
            timer.advance(now_ns())
            if is_away():
                continue
            self._counters.polls_missed += timer.missed - missed_before
            try:
                await self._link.send(poll.identifier, poll.payload, timeout_s=poll.period_s)
            except BusSendError:
                self._counters.polls_missed += 1


def _starting_now(poll: Poll) -> Periodic:
    timer = Periodic(1 / poll.period_s)
    timer.deadline_ns -= timer.period_ns
    return timer
