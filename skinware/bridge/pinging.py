"""Questions for the other machine's clock: a few one after the other, each as soon as the last one is answered.

Threads that have just worked are quick. A question that stands alone wakes four of them, here, there and back, and each
may take as long as all the rest; of those that follow each other closely, some find all awake. They are messages rather
than questions of zenoh, which take twice as long. What comes is answered in the thread that receives it.
"""

from __future__ import annotations

import struct
from collections.abc import Callable

from skinware.bridge.clock import Exchange
from skinware.bridge.guarding import Guard
from skinware.bridge.link import Link, Priority
from skinware.bridge.messages import Keys
from skinware.errors import BridgeError
from skinware.realtime import now_ns

QUESTIONS = 16
_PING = struct.Struct("<16sq")
_PONG = struct.Struct("<qqq")
_LATEST_NS = 1 << 61
"""No clock has counted so far."""


class Pinger:
    """Asks for the time.

    Args:
        link: to the other machine.
        who: asks, 16 letters.
        told: gets the sample of all of them, in the thread that receives the last answer; where some are not answered,
            when the next ones are asked.
        guard: counts answers that cannot be.
    """

    def __init__(self, link: Link, who: str, told: Callable[[Exchange], None], guard: Guard) -> None:
        self._link, self._who, self._told, self._guard = link, who, told, guard
        self._ping = ""
        self._silence: Callable[[], None] = lambda: None
        self._asked_ns = self._left = self._since_ns = 0
        self._known: Exchange | None = None

    def follow(self, keys: Keys) -> None:
        self._silence()
        self._ping, self._since_ns = keys.ping, now_ns()
        self._silence = self._link.listen(keys.pong(self._who), self._guard.of_messages("a clock", self._answered))

    def close(self) -> None:
        self._ping = ""
        self._silence()

    def ask(self) -> None:
        """Begin to ask, if it is known whom; what was asked before is over."""
        if self._ping:
            self._tell()
            self._left = QUESTIONS
            self._ask()

    def _tell(self) -> None:
        known, self._known = self._known, None
        if known is not None:
            self._told(known)

    def _ask(self) -> None:
        self._left -= 1
        self._asked_ns = asked_ns = now_ns()
        self._link.tell(self._ping, _PING.pack(self._who.encode(), asked_ns), Priority.CLOCK)

    def _answered(self, _key: str, message: bytes) -> None:
        returned_ns = now_ns()
        if len(message) != _PONG.size:
            return
        asked_ns, heard_ns, answered_ns = _PONG.unpack(message)
        if not self._since_ns <= asked_ns <= returned_ns:
            return  # of another bridge, whose clock may be another
        took_ns = answered_ns - heard_ns
        if not 0 <= heard_ns < _LATEST_NS or not 0 <= took_ns <= returned_ns - asked_ns:
            raise BridgeError(f"a clock that shows {heard_ns} ns, and {took_ns} ns later, cannot be")
        is_newest, is_last = asked_ns == self._asked_ns, self._left == 0
        if is_newest and not is_last:
            self._ask()  # before all else, while threads are awake
        sample = Exchange.of(asked_ns, heard_ns, answered_ns, returned_ns)
        self._known = sample if self._known is None else self._known.with_(sample)
        if is_newest and is_last:
            self._tell()


def answering(link: Link, keys: Keys, clock: Callable[[], int] = now_ns) -> Callable[[], None]:
    """Answer who asks for the time of a clock; what ends it."""

    def asked(_key: str, message: bytes) -> None:
        heard_ns = clock()
        if len(message) != _PING.size:
            return
        who, asked_ns = _PING.unpack(message)
        if who.isalnum():
            pong = keys.pong(who.decode("ascii"))
            link.tell(pong, _PONG.pack(asked_ns, heard_ns, clock()), Priority.CLOCK)

    return link.listen(keys.ping, asked)
