"""Asking devices that only answer, at absolute deadlines."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from skinware.errors import BusSendError, ConfigurationError
from skinware.realtime import NS_PER_S, Periodic, now_ns
from skinware_drivers.bus import identifier_text
from skinware_drivers.counters import BusCounters
from skinware_drivers.link import Link, Match

_LOOK_AGAIN_S = 0.05


@dataclass(frozen=True)
class Poll:
    """A question that is asked again and again, so that a device answers it with data.

    Without ``answer`` it goes out every ``period_s``, whatever comes back. With ``answer`` it is asked *in lock step*:
    nothing else is sent on this bus until the answer came, or until ``timeout_s`` has passed.

    Attributes:
        identifier: of the frame.
        payload: of the frame.
        period_s: time from one to the next, s.
        answer: which frames, of data or not, are an answer.
        timeout_s: how long to wait for it, s; default: ``period_s``.

    Raises:
        ConfigurationError: a period or timeout that is not above 0, or a timeout without an answer.
    """

    identifier: int
    payload: bytes
    period_s: float
    answer: Match | None = None
    timeout_s: float | None = None

    def __post_init__(self) -> None:
        name = f"poll {identifier_text(self.identifier)}"
        if not self.period_s > 0:
            raise ConfigurationError(f"{name} every {self.period_s} s: give more than 0")
        if self.timeout_s is not None and self.answer is None:
            raise ConfigurationError(f"{name} has a timeout and no `answer` to wait for: say which frames answer it")
        if self.timeout_s is not None and not self.timeout_s > 0:
            raise ConfigurationError(f"{name} waits {self.timeout_s} s for its answer: give more than 0")


class _Timer(Periodic):
    """Deadlines of a poll, and when it was last asked."""

    asked_ns = 0


class Poller:
    """Asks the polls of one bus, one after the other.

    Every poll has deadlines of its own, by its place in the sequence: another payload at the same place keeps them. One
    that cannot be kept (the bus took no more frames, the answer before came late, or this process had no processor
    time) is counted as missed and not made up for: the next poll goes out at the next deadline.

    Args:
        link: the bus.
        counters: of the bus; ``polls_missed`` and ``polls_unanswered`` are counted in them.
    """

    def __init__(self, link: Link, counters: BusCounters) -> None:
        self._link = link
        self._counters = counters
        self._timers: list[_Timer] = []

    async def run(self, polls: Callable[[], Sequence[Poll]], is_away: Callable[[], bool]) -> None:
        """Ask what ``polls`` names, the first of each at once, until it is cancelled. What ``polls`` raises, it raises.

        Args:
            polls: called once before each question: what is to be asked may change. None: a pause, it is called again
                after 50 ms.
            is_away: the bus is lost: nothing is sent, and nothing missed.
        """
        while True:
            await self._until_first_deadline()
            asked = polls()
            self._keep_time(asked)
            if asked:
                await self._ask_first(asked, is_away())
            else:
                await asyncio.sleep(_LOOK_AGAIN_S)

    async def _until_first_deadline(self) -> None:
        await asyncio.sleep(0)  # if it is late, others have their turn all the same
        first_ns = min((timer.deadline_ns for timer in self._timers), default=0)
        while (left_ns := first_ns - now_ns()) > 0:  # noqa: ASYNC110 - the loop's timers may come a little early
            await asyncio.sleep(left_ns / NS_PER_S)

    def _keep_time(self, asked: Sequence[Poll]) -> None:
        """A timer for every poll: of one whose period changed, from its last deadline on."""
        del self._timers[len(asked) :]
        for place, poll in enumerate(asked):
            timer = _Timer(1 / poll.period_s)
            if place == len(self._timers):
                timer.deadline_ns -= timer.period_ns
                self._timers.append(timer)
            elif timer.period_ns != self._timers[place].period_ns:
                before = self._timers[place]
                timer.deadline_ns = before.deadline_ns - before.period_ns + timer.period_ns
                timer.asked_ns = before.asked_ns
                self._timers[place] = timer

    async def _ask_first(self, asked: Sequence[Poll], is_away: bool) -> None:
        """Of the polls that are due, ask the one that has waited longest since it was asked, if there is any."""
        time_ns = now_ns()
        due = [pair for pair in zip(self._timers, asked, strict=True) if pair[0].deadline_ns <= time_ns]
        if not due:
            return
        timer, poll = min(due, key=lambda pair: pair[0].asked_ns)
        missed_before = timer.missed
        timer.advance(time_ns)
        timer.asked_ns = time_ns
        if is_away:
            return
        counters = self._counters
        counters.polls_missed += timer.missed - missed_before
        try:
            if poll.answer is None:
                await self._link.send(poll.identifier, poll.payload, timeout_s=poll.period_s)
            elif not await self._link.ask(
                poll.identifier, poll.payload, poll.answer, timeout_s=poll.timeout_s or poll.period_s
            ):
                counters.polls_unanswered += 1
        except BusSendError:
            counters.polls_missed += 1
