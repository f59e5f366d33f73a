"""A robot's end of a bridge, as this end knows it: whether it is heard, its clock, and what is wrong with it."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Mapping
from typing import Any, Protocol

from skinware.bridge.clock import PeerClock, Sample
from skinware.bridge.link import Link, Reply
from skinware.bridge.messages import ALL_TOKENS, VERSION, Keys, token_parts
from skinware.bridge.pinging import Pinger
from skinware.bridge.turns import Turns
from skinware.realtime import NS_PER_S, now_ns

ANSWER_S = 1.0
_PATIENCE_NS = 3 * NS_PER_S
"""With nobody there, until it is looked at why, and until it is looked at again."""
_PING_NS = 150_000_000
_SILENCE_NS = 400_000_000


class Watcher(Protocol):
    """Is told of a robot, in turns."""

    def appeared(self) -> None:
        """A bridge serves it."""

    def moved(self) -> None:
        """Another bridge serves it than before: its keys are others."""

    def restarted(self) -> None:
        """Its clock and its generations are others than before."""

    def lost(self) -> None:
        """It was heard, and is not any more."""

    def clock_told(self) -> None:
        """There is a new answer of its clock."""


class Peer:
    """A robot to which a link may lead.

    Args:
        robot: its name.
        link: to it.
        turns: what comes in zenoh's threads is done in these.
        watcher: is told what happens.
        why_not: why nobody is reached, a line for people, empty if somebody is; called in a thread, may wait.
        tell: is told what happens, as JSON has it.

    Attributes:
        keys: of the robot, by the bridge that is followed; before one is, of any.
        who: this end, in questions.
        clock: of the robot.
        is_connected: whether it is heard.
        since_ns: since when that is so.
    """

    def __init__(
        self,
        robot: str,
        link: Link,
        turns: Turns,
        watcher: Watcher,
        *,
        why_not: Callable[[], str],
        tell: Callable[[dict[str, Any]], None],
    ) -> None:
        self.keys = Keys(robot)
        self.who: str = os.urandom(8).hex()
        self.clock = PeerClock()
        self._instance, self._start = "", ""
        self.is_connected = False
        self.since_ns: int = now_ns()
        self.tell = tell
        self._link, self._turns, self._watcher = link, turns, watcher
        self._there: set[str] = set()  # bridges that serve the robot
        self._others: set[str] = set()  # other robots
        self._why_not, self._next_why_ns, self._asking_why = why_not, now_ns() + _PATIENCE_NS, False
        self._heard_ns = self._pinged_ns = self._next_clock_ns = 0
        self._told: set[str] = set()
        self._pinger = Pinger(link, self.who, lambda sample: turns.soon(lambda: self._take_clock(sample)))
        link.watch(ALL_TOKENS, lambda key, there: turns.soon(lambda: self._token(key, there)))

    @property
    def robot(self) -> str:
        """Its name."""
        return self.keys.robot

    def ask(
        self,
        key: str,
        answered: Callable[[bytes | None, int], None],
        *,
        timeout_s: float,
        priority: Any,
        parameters: Mapping[str, object] | None = None,
        payload: bytes = b"",
        is_large: bool = False,
    ) -> None:
        """See :meth:`skinware.bridge.link.Link.ask`; in a turn it is told the answer and when that came."""

        def came(reply: Reply) -> None:
            returned_ns = now_ns()
            self._turns.soon(lambda: answered(reply.payload, returned_ns))

        self._link.ask(
            key,
            came,
            timeout_s=timeout_s,
            priority=priority,
            parameters=parameters,
            payload=payload,
            is_large=is_large,
        )

    def listen(self, key: str, heard: Callable[[str, bytes], None]) -> Callable[[], None]:
        """See :meth:`skinware.bridge.link.Link.listen`: it is heard in the thread that receives."""
        return self._link.listen(key, heard)

    def follows(self, instance: str, start: str) -> bool:
        """Whether what a bridge says of itself counts: not if another one is followed and still there.

        Args:
            instance: its number.
            start: from which its clock counts.
        """
        if self._instance and instance != self._instance and self._instance in self._there:
            self.say_once("robot", f"robot {self.robot} is served by two bridges: give each robot a name of its own")
            return False
        self.heard()
        if instance != self._instance:
            self._instance, self.keys = instance, Keys(self.robot, instance)
            self._pinger.follow(self.keys)
            self._watcher.moved()
        if start != self._start:
            self._start = start
            self.clock = PeerClock()
            self._ask_clock()
            self._watcher.restarted()
        return True

    def heard(self) -> None:
        """Something came from it."""
        self._heard_ns = now_ns()
        if not self.is_connected:
            self.is_connected, self.since_ns = True, self._heard_ns
            self._told.clear()
            self.tell({"event": "connected", "robot": self.robot})

    def look(self, time_ns: int) -> None:
        """What is to be done by the clock."""
        if time_ns >= self._next_clock_ns:
            self._ask_clock()
        if self.is_connected and time_ns - self._heard_ns > _SILENCE_NS - _PING_NS:
            if time_ns - self._heard_ns > _SILENCE_NS:
                self._lose("nothing comes over the link")
            elif time_ns - self._pinged_ns > _PING_NS:
                self._ask_clock()
        if not self.is_connected and time_ns >= self._next_why_ns and not self._asking_why:
            self._asking_why, self._next_why_ns = True, time_ns + _PATIENCE_NS
            threading.Thread(target=self._ask_why, name="skinware bridge diagnosis", daemon=True).start()

    def say_once(self, about: str, text: str) -> None:
        """Tell of trouble, once for as long as the robot is heard."""
        if text not in self._told:
            self._told.add(text)
            self.tell({"event": "trouble", "about": about, "why": text})

    def _token(self, key: str, there: bool) -> None:
        robot, version, instance = token_parts(key)
        if robot != self.robot:
            (self._others.add if there else self._others.discard)(robot)
            return
        (self._there.add if there else self._there.discard)(instance)
        if there and version != VERSION:
            self.say_once(
                "version",
                f"robot {self.robot} is served by version {version or '?'} of the bridge; this one is {VERSION}:"
                " install the same on both machines",
            )
        elif there:
            self._watcher.appeared()
        elif instance == self._instance:
            self._lose("its bridge ended")

    def _lose(self, why: str) -> None:
        if not self.is_connected:
            return
        self.is_connected, self.since_ns = False, now_ns()
        self._watcher.lost()
        self.tell({"event": "disconnected", "robot": self.robot, "why": why})

    def _ask_why(self) -> None:
        why = self._why_not()

        def tell() -> None:
            self._asking_why = False
            if self.is_connected:
                return
            others = f"; there are: {', '.join(sorted(self._others))}" if self._others else ""
            silent = f"something listens there, but no robot {self.robot!r} answers; does it want --tls?{others}"
            self.say_once("link", why or silent)

        self._turns.soon(tell)

    def _ask_clock(self) -> None:
        self._pinged_ns = now_ns()
        self._next_clock_ns = self._pinged_ns + self.clock.pause_ns()
        self._pinger.ask()

    def _take_clock(self, sample: Sample) -> None:
        self.heard()
        self.clock.add(sample)
        self._watcher.clock_told()


__all__ = ["ANSWER_S", "Peer", "Watcher"]
