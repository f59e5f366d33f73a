"""Measure the clock of a peer by questions and answers."""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from skinware.bridge.link import Guard, Link, Priority
from skinware.bridge.messages import Keys
from skinware.errors import BridgeError
from skinware.realtime import NS_PER_S, now_ns

_KEPT_NS = 30 * NS_PER_S
_AT_ONCE_NS = 20_000_000
_HORIZON_NS = 3 * NS_PER_S // 2
"""Until the next answers, what is told must hold."""
_MOST_DRIFT = 500e-6
"""Of two clocks, the worst that is corrected without a jump."""
_WANDER = 0.2e-6
"""By how much a drift may change within the time that is looked at."""
_FAST_ROUNDS, _FAST_NS, _SLOW_NS = 16, NS_PER_S // 8, NS_PER_S // 2

_Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Exchange:
    """What questions told at one moment.

    Attributes:
        at_ns: the moment, by our clock.
        low_ns, high_ns: our clock minus the other is not less, and not more.
        round_trip_ns: without the time that the other end took.
    """

    at_ns: int
    low_ns: int
    high_ns: int
    round_trip_ns: int

    @staticmethod
    def of(asked_ns: int, heard_ns: int, answered_ns: int, returned_ns: int) -> Exchange:
        """Of our times ``asked_ns`` and ``returned_ns`` and the other end's, ``heard_ns`` and ``answered_ns``."""
        low_ns, high_ns = asked_ns - heard_ns, returned_ns - answered_ns
        return Exchange((asked_ns + returned_ns) // 2, low_ns, high_ns, max(0, high_ns - low_ns))

    def with_(self, other: Exchange) -> Exchange:
        """What both told, at the moment of this one; only the other where the clock jumped between them."""
        drift_ns = round(_MOST_DRIFT * abs(other.at_ns - self.at_ns))
        low_ns, high_ns = max(self.low_ns, other.low_ns - drift_ns), min(self.high_ns, other.high_ns + drift_ns)
        if low_ns > high_ns:
            return other
        return Exchange(self.at_ns, low_ns, high_ns, min(self.round_trip_ns, other.round_trip_ns))


class PeerClock:
    """Moves times of another machine to ours.

    Attributes:
        error_ns: what ``offset_ns`` may be wrong by, until the next questions are answered.
    """

    def __init__(self) -> None:
        self._samples: deque[Exchange] = deque()
        self._rounds = 0
        self._at_ns = 0
        self._offset_ns = self._slope = 0.0
        self.error_ns: int = 0

    @property
    def is_known(self) -> bool:
        return bool(self._samples)

    @property
    def round_trip_ns(self) -> int:
        """The shortest that is known of, 0 if none is."""
        return min((sample.round_trip_ns for sample in self._samples), default=0)

    def pause_ns(self) -> int:
        """How long to wait before the next questions."""
        return _FAST_NS if self._rounds < _FAST_ROUNDS else _SLOW_NS

    def offset_ns(self, at_ns: int) -> int:
        """Our clock minus the other, at one of our moments."""
        return round(self._offset_ns + self._slope * (at_ns - self._at_ns))

    def add(self, sample: Exchange) -> None:
        samples = self._samples
        if samples and abs(sample.at_ns - samples[-1].at_ns) < _AT_ONCE_NS:
            samples[-1] = samples[-1].with_(sample)
        else:
            self._rounds += 1
            samples.append(sample)
            while sample.at_ns - samples[0].at_ns > _KEPT_NS:
                samples.popleft()
        while not self._fit():
            samples.popleft()

    def _fit(self) -> bool:
        """Find what all lines through the bounds have in common; False if there are none."""
        newest = self._samples[-1]
        at = np.array([sample.at_ns - newest.at_ns for sample in self._samples], np.float64)
        slack = _WANDER * -at
        low = np.array([sample.low_ns - newest.low_ns for sample in self._samples], np.float64) - slack
        high = np.array([sample.high_ns - newest.low_ns for sample in self._samples], np.float64) + slack
        most, least = _highest(at, low, high), -_highest(at, -high, -low)
        if (most < least).any():
            return False
        now, then = (most + least) / 2
        self._at_ns = newest.at_ns
        self._offset_ns, self._slope = newest.low_ns + float(now), float(then - now) / _HORIZON_NS
        self.error_ns = int(np.ceil((most - least).max() / 2)) + 1  # it is rounded, too
        return True


def _highest(at: _Floats, low: _Floats, high: _Floats) -> _Floats:
    """(2,) where the highest line between bounds is at time 0, and at the horizon.

    Args:
        at: (n,) times, growing, none above 0.
        low: (n,) bounds at these times.
        high: likewise.
    """
    later = at[None, :] - at[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        steep = np.where(later > 0, (high[None, :] - low[:, None]) / later, _MOST_DRIFT)
    steepest = np.minimum(steep.min(axis=0), _MOST_DRIFT)
    ends = np.array([0.0, _HORIZON_NS])
    highest: _Floats = (high + steepest * (ends[:, None] - at)).min(axis=1)
    return highest


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
