"""Measure the clock of a peer: each answer bounds the difference of the clocks from below and above."""

from __future__ import annotations

import itertools
import struct
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import numpy.typing as npt

from skinware.bridge.link import Guard, Priority, ZenohLink
from skinware.bridge.messages import Keys
from skinware.errors import BridgeError
from skinware.limits import LIMITS
from skinware.realtime import NS_PER_S, now_ns

_KEPT_NS = 30 * NS_PER_S
_RECENT = 5
_AT_ONCE_NS = 20_000_000
_HORIZON_NS = 3 * NS_PER_S // 2
"""An estimate must hold until the answers to the next questions come."""
_MOST_DRIFT = 500e-6
"""The largest drift between two clocks that is corrected without a jump."""
_WANDER = 0.2e-6
"""Largest change of a drift within ``_KEPT_NS``."""
_FAST_ROUNDS, _FAST_NS, _SLOW_NS = 16, NS_PER_S // 8, NS_PER_S // 2
QUESTIONS = 16
"""Questions of a round, one after the other."""
_PING = struct.Struct("<16sq")
_PONG = struct.Struct("<qqq")

_Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Exchange:
    """Bounds of our clock minus the other one, from a question and its answer; the other end's time is left out."""

    at_ns: int
    low_ns: int
    high_ns: int
    round_trip_ns: int

    @staticmethod
    def of(asked_ns: int, heard_ns: int, answered_ns: int, returned_ns: int) -> Exchange:
        """Return the bounds; we asked and got the answer at the outer times, the inner ones are of the other clock."""
        low_ns, high_ns = asked_ns - heard_ns, returned_ns - answered_ns
        return Exchange((asked_ns + returned_ns) // 2, low_ns, high_ns, max(0, high_ns - low_ns))

    def narrowed(self, other: Exchange) -> Exchange:
        """Return the bounds that both give at the moment of this one; only ``other`` if a clock jumped in between."""
        drift_ns = round(_MOST_DRIFT * abs(other.at_ns - self.at_ns))
        low_ns, high_ns = max(self.low_ns, other.low_ns - drift_ns), min(self.high_ns, other.high_ns + drift_ns)
        if low_ns > high_ns:
            return other
        return Exchange(self.at_ns, low_ns, high_ns, min(self.round_trip_ns, other.round_trip_ns))


class PeerClock:
    """The difference of our clock and another; ``error_ns``: its largest error until the next answers come."""

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
        """The shortest of the last half minute; 0: none is known."""
        return min((sample.round_trip_ns for sample in self._samples), default=0)

    @property
    def recent_round_trip_ns(self) -> int:
        """The longest of the last few; 0: none is known. The delay of a link may have grown since the shortest."""
        recent = itertools.islice(reversed(self._samples), _RECENT)
        return max((sample.round_trip_ns for sample in recent), default=0)

    def pause_ns(self) -> int:
        return _FAST_NS if self._rounds < _FAST_ROUNDS else _SLOW_NS

    def offset_ns(self, at_ns: int) -> int:
        """Return our clock minus the other at a time of ours."""
        return round(self._offset_ns + self._slope * (at_ns - self._at_ns))

    def add(self, sample: Exchange) -> None:
        samples = self._samples
        if samples and abs(sample.at_ns - samples[-1].at_ns) < _AT_ONCE_NS:
            samples[-1] = samples[-1].narrowed(sample)
        else:
            self._rounds += 1
            samples.append(sample)
            while sample.at_ns - samples[0].at_ns > _KEPT_NS:
                samples.popleft()
        while not self._fit():
            samples.popleft()

    def _fit(self) -> bool:
        """Estimate from all lines that fit between the bounds; return False if there is none."""
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
        self.error_ns = int(np.ceil((most - least).max() / 2)) + 1  # the offset is rounded, too
        return True


def _highest(at: _Floats, low: _Floats, high: _Floats) -> _Floats:
    """Return (2,) the highest value, at time 0 and the horizon, of a line between bounds at (n,) ascending times."""
    later = at[None, :] - at[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        steep = np.where(later > 0, (high[None, :] - low[:, None]) / later, _MOST_DRIFT)
    steepest = np.minimum(steep.min(axis=0), _MOST_DRIFT)
    ends = np.array([0.0, _HORIZON_NS])
    highest: _Floats = (high + steepest * (ends[:, None] - at)).min(axis=1)
    return highest


class Pinger:
    """Asks the bridge of a robot for the time of its clock.

    ``on_sample`` gets the bounds of a round: in the receiving thread with the last answer, or, if some answers do not
    come, when the next round begins.
    """

    def __init__(self, link: ZenohLink, who: str, on_sample: Callable[[Exchange], None], guard: Guard) -> None:
        self._link, self.who, self._on_sample, self._guard = link, who, on_sample, guard
        self._ping = ""
        self._end_listening: Callable[[], None] = lambda: None
        self._question_ns = self._left = self._since_ns = 0
        self._bounds: Exchange | None = None
        self.asked_ns: int = 0

    def follow(self, keys: Keys) -> None:
        """Ask the bridge that has these keys from now on."""
        self._end_listening()
        self._ping, self._since_ns = keys.ping, now_ns()
        self._end_listening = self._link.listen(
            keys.pong(self.who), partial(self._guard.run, "a clock", self._answered)
        )

    def close(self) -> None:
        self._ping = ""
        self._end_listening()

    def ask(self) -> None:
        """Begin a round, if a bridge is followed; the round before is over."""
        self.asked_ns = now_ns()
        if self._ping:
            self._report()
            self._left = QUESTIONS
            self._ask_once()

    def _ask_once(self) -> None:
        self._left -= 1
        self._question_ns = now_ns()
        self._link.put(self._ping, _PING.pack(self.who.encode(), self._question_ns), Priority.CLOCK)

    def _report(self) -> None:
        bounds, self._bounds = self._bounds, None
        if bounds is not None:
            self._on_sample(bounds)

    def _answered(self, _key: str, message: bytes) -> None:
        returned_ns = now_ns()
        if len(message) != _PONG.size:
            return
        asked_ns, heard_ns, answered_ns = _PONG.unpack(message)
        if not self._since_ns <= asked_ns <= returned_ns:
            return  # from another bridge, which may have another clock
        took_ns = answered_ns - heard_ns
        if not 0 <= heard_ns < LIMITS.time_ns or not 0 <= took_ns <= returned_ns - asked_ns:
            raise BridgeError(f"a clock that shows {heard_ns} ns, and {took_ns} ns later, cannot be")
        is_newest, is_last = asked_ns == self._question_ns, self._left == 0
        if is_newest and not is_last:
            self._ask_once()  # first, while threads are awake
        sample = Exchange.of(asked_ns, heard_ns, answered_ns, returned_ns)
        self._bounds = sample if self._bounds is None else self._bounds.narrowed(sample)
        if is_newest and is_last:
            self._report()


def answer_pings(link: ZenohLink, keys: Keys, clock: Callable[[], int] = now_ns) -> Callable[[], None]:
    """Answer questions for the time of a clock; return a function that ends it."""

    def asked(_key: str, message: bytes) -> None:
        heard_ns = clock()
        if len(message) != _PING.size:
            return
        who, asked_ns = _PING.unpack(message)
        if who.isalnum():
            link.put(keys.pong(who.decode("ascii")), _PONG.pack(asked_ns, heard_ns, clock()), Priority.CLOCK)

    return link.listen(keys.ping, asked)
