"""All robots that are reached, by the small message that each sends once a second."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field

from skinware.bridge.clock import Exchange, PeerClock, Pinger
from skinware.bridge.link import Guard, Link
from skinware.bridge.messages import (
    ALL_SUMMARIES,
    ALL_TOKENS,
    VERSION,
    Keys,
    Summary,
    bridge_of,
    read_text,
    token_parts,
)
from skinware.errors import BridgeError
from skinware.limits import LIMITS
from skinware.realtime import NS_PER_S, now_ns

_TICK_S = 0.05

Bridge = tuple[str, str]
"""(robot, number of the bridge that serves it)."""


@dataclass
class Seen:
    """A robot that is reached.

    Attributes:
        robot: its name.
        instance: number of the bridge that serves it.
        version: of that bridge.
        clock: of the robot.
        summary: what it told last; None: nothing yet.
        told_ns: when that was, 0 if it was never.
        bytes: of all that it told so far.
        guard: counts its messages that cannot be taken.
        next_clock_ns: when its clock is to be asked next.
        pinger: asks for it; None: nobody wants to know.
    """

    robot: str
    instance: str
    version: int = VERSION
    clock: PeerClock = field(default_factory=PeerClock)
    summary: Summary | None = None
    told_ns: int = 0
    bytes: int = 0
    guard: Guard = field(default_factory=Guard)
    next_clock_ns: int = 0
    pinger: Pinger | None = None


class Watcher:
    """Knows how all robots are that a link leads to; reads none of their frames.

    Args:
        link: to them.
        asks: have them tell how they are; otherwise only who is there.

    Attributes:
        guard: counts messages that cannot be taken, and are of no robot that is known.
    """

    def __init__(self, link: Link, *, asks: bool = True) -> None:
        self._link, self._asks, self._who = link, asks, os.urandom(8).hex()
        self._lock = threading.Lock()
        self._seen: dict[Bridge, Seen] = {}
        self._stopping = False
        self.guard = Guard()
        link.watch(ALL_TOKENS, self._token_changed)
        if asks:
            link.listen(ALL_SUMMARIES, self.guard.of_messages("a summary", self._told))

    def robots(self) -> list[Seen]:
        """All that are reached now, by name; two of one name are two."""
        with self._lock:
            return sorted(self._seen.values(), key=lambda seen: (seen.robot, seen.instance))

    def run(self, tell: Callable[[], object] = lambda: None) -> None:
        """Until ``stop``; ``tell`` is called once a second."""
        tell_ns = now_ns() + NS_PER_S
        while not self._stopping:
            time.sleep(_TICK_S)
            time_ns = now_ns()
            for seen in self.robots():
                if self._asks and seen.version == VERSION and time_ns >= seen.next_clock_ns:
                    self._ask_clock(seen)
            if time_ns >= tell_ns:
                tell_ns = max(tell_ns + NS_PER_S, time_ns)
                tell()

    def stop(self) -> None:
        """End it; from any thread, and from a signal handler."""
        self._stopping = True

    def _token_changed(self, key: str, there: bool) -> None:
        self.guard.run("a token", self._token, key, there)

    def _token(self, key: str, there: bool) -> None:
        robot, version, instance = token_parts(key)
        gone = None
        with self._lock:
            if there:
                if len(self._seen) >= LIMITS.robots and (robot, instance) not in self._seen:
                    raise BridgeError(f"more than {LIMITS.robots} bridges are reached")
                self._seen.setdefault((robot, instance), Seen(robot, instance)).version = version
            else:
                gone = self._seen.pop((robot, instance), None)
        if gone is not None and gone.pinger is not None:
            gone.pinger.close()

    def _told(self, key: str, payload: bytes) -> None:
        with self._lock:
            seen = self._seen.get(bridge_of(key))
        if seen is None:
            return
        try:
            summary = read_text(payload, Summary)
        except BridgeError as error:
            seen.guard.refuse("a summary", str(error))
        else:
            with self._lock:
                seen.summary, seen.told_ns = summary, now_ns()
                seen.bytes += len(payload)

    def _ask_clock(self, seen: Seen) -> None:
        def told(sample: Exchange) -> None:
            with self._lock:
                seen.clock.add(sample)

        seen.next_clock_ns = now_ns() + seen.clock.pause_ns()
        pinger = seen.pinger
        if pinger is None:
            pinger = Pinger(self._link, self._who, told, seen.guard)
            pinger.follow(Keys(seen.robot, seen.instance))
            with self._lock:
                if self._seen.get((seen.robot, seen.instance)) is seen:
                    seen.pinger = pinger
            if seen.pinger is None:  # the robot has gone meanwhile
                pinger.close()
        pinger.ask()
