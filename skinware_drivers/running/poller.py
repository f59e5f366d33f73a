"""Ask devices that only answer, at absolute deadlines."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Sequence

from skinware.errors import BusSendError
from skinware.realtime import NS_PER_S, Periodic, now_ns
from skinware_drivers.counters import BusCounters
from skinware_drivers.fields import Match
from skinware_drivers.link import Link
from skinware_drivers.polling import Poll
from skinware_drivers.running.guard import pauses_of_device

log: logging.Logger = logging.getLogger("skinware.driver")

_LOOK_AGAIN_S = 0.05
_ROOM, _LONGEST_EXTRA_S = 1.25, 1.0
"""The next time, an answer is awaited for this multiple of its delay, and at most so much longer."""


class _Place:
    """The polls at one place of the sequence.

    Attributes:
        asked_ns: when one was last sent, or would have been.
        pauses: while answers are missing.
        extra_s: time to wait for an answer beyond its timeout, because answers came late.
    """

    def __init__(self, timer: Periodic) -> None:
        self.timer = timer
        self.asked_ns = 0
        self.extra_s = 0.0
        self.pauses = pauses_of_device()


class Poller:
    """Sends the polls of one bus, one after the other.

    Every poll has deadlines of its own, by its place in the sequence: another payload at the same place keeps them. A
    missed deadline (the bus took no more frames, the answer before came late, or this process had no processor time)
    is counted and not made up for: the next poll is sent at the next deadline.

    In lock step, a device that does not answer costs the others its timeout. After three missing answers in a row it is
    asked less often, if there are others; once it has answered, as often as before. A late answer is an answer: it is
    counted in ``polls_late``, and the device then gets as much time as it takes, up to a second more, as long as its
    answers come late.

    Args:
        counters: of the bus; ``polls_missed`` and ``polls_unanswered`` are counted in them.
        check: called with the polls before the first question, and when their number or their times have changed.
    """

    def __init__(
        self, link: Link, counters: BusCounters, check: Callable[[Sequence[Poll]], None] = lambda _: None
    ) -> None:
        self._link = link
        self._counters = counters
        self._check = check
        self._checked: list[tuple[float, float]] = []
        self._places: list[_Place] = []
        self._slow: set[str] = set()

    async def run(self, polls: Callable[[], Sequence[Poll]], is_away: Callable[[], bool]) -> None:
        """Send polls, the first of each at once, until it is cancelled; raise whatever ``polls`` or ``check`` raises.

        Args:
            polls: returns the polls; called before each question. If there are none, it is called again after 50 ms.
            is_away: returns whether the bus is lost: nothing is sent, and nothing missed.
        """
        while True:
            await asyncio.sleep(0)  # if this is late, others have their turn all the same
            first_ns = min((place.timer.deadline_ns for place in self._places), default=0)
            while (left_ns := first_ns - now_ns()) > 0:  # noqa: ASYNC110 - the loop's timers may come a little early
                await asyncio.sleep(left_ns / NS_PER_S)
            asked = polls()
            times = [(poll.period_s, poll.patience_s) for poll in asked]
            if asked and times != self._checked:
                self._check(asked)
                self._checked = times
            self._keep_time(asked)
            if asked:
                await self._ask_first(asked, is_away())
            else:
                await asyncio.sleep(_LOOK_AGAIN_S)

    def _keep_time(self, asked: Sequence[Poll]) -> None:
        """Keep a timer for every poll; one whose period changed continues from its last deadline."""
        del self._places[len(asked) :]
        for number, poll in enumerate(asked):
            timer = Periodic(1 / poll.period_s)
            if number == len(self._places):
                timer.deadline_ns -= timer.period_ns
                self._places.append(_Place(timer))
            elif timer.period_ns != (before := self._places[number].timer).period_ns:
                timer.deadline_ns = before.deadline_ns - before.period_ns + timer.period_ns
                self._places[number].timer = timer

    async def _ask_first(self, asked: Sequence[Poll], is_away: bool) -> None:
        """Send the due poll that was sent the longest time ago, if any is due."""
        time_ns = now_ns()
        due = [pair for pair in zip(self._places, asked, strict=True) if pair[0].timer.deadline_ns <= time_ns]
        if not due:
            return
        place, poll = min(due, key=lambda pair: pair[0].asked_ns)
        missed_before = place.timer.missed
        place.timer.advance(time_ns)
        place.asked_ns = time_ns
        if is_away:
            place.pauses.begin_again()  # unknown
            return
        if len(asked) > 1 and not place.pauses.is_due:
            return
        self._counters.polls_missed += place.timer.missed - missed_before
        try:
            if poll.answer is None:
                await self._link.send(poll.identifier, poll.payload, timeout_s=poll.period_s)
            else:
                await self._ask(poll, poll.answer, place)
        except BusSendError:
            self._counters.polls_missed += 1

    async def _ask(self, poll: Poll, answer: Match, place: _Place) -> None:
        extra_s = place.extra_s
        place.extra_s /= 2  # one late answer must not hold up the others for long
        came = await self._link.ask(
            poll.identifier,
            poll.payload,
            answer,
            timeout_s=poll.patience_s,
            extra_s=extra_s,
            on_late=lambda late_s: self._count_late(poll, place, late_s),
        )
        if came:
            place.pauses.begin_again()
        else:
            self._counters.polls_unanswered += 1
            place.pauses.begin()

    def _count_late(self, poll: Poll, place: _Place, late_s: float) -> None:
        """Count an answer after its timeout: the device lives, at a pace of its own."""
        place.pauses.begin_again()
        if late_s <= 0:
            return  # it came in time, and was read late
        self._counters.polls_late += 1
        place.extra_s = min(max(place.extra_s, _ROOM * late_s), _LONGEST_EXTRA_S)
        if poll.name not in self._slow:
            self._slow.add(poll.name)
            log.warning(
                "%s: answers to %s come %.3g ms after timeout_s = %.3g ms; they are waited for, but others have to"
                " wait, too: make timeout_s longer; logged once",
                self._link.bus_name,
                poll.name,
                1e3 * late_s,
                1e3 * poll.patience_s,
            )
