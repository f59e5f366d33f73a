"""Know a robot's end of a bridge: whether it is heard, its clock, and what is wrong with it."""

from __future__ import annotations

import contextlib
import os
import threading
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any, Protocol

from skinware.bridge.clock import Exchange, PeerClock, Pinger
from skinware.bridge.link import Guard, Link, Reply, Room
from skinware.bridge.messages import ALL_TOKENS, VERSION, Keys, Services, token_parts
from skinware.errors import BridgeError
from skinware.realtime import NS_PER_S, now_ns

_MOST = 4096
_MOST_BYTES = 1 << 27


class Turns:
    """Jobs that wait for their turn.

    Attributes:
        fd: can be read from while there are any.
        left_out: jobs that were left out because too many waited.
    """

    def __init__(self) -> None:
        self._jobs: deque[tuple[int, Callable[[], object]]] = deque()
        self._size = 0  # of what waits
        self._lock = threading.RLock()  # signal handlers come in between
        self.left_out: int = 0
        self.fd: int = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK)

    def soon(self, job: Callable[[], object], size: int = 0) -> None:
        """Have it done; from any thread.

        Args:
            job: what is to be done.
            size: of the message that it keeps until then, bytes. With too many of them it is left out.
        """
        with self._lock:
            if len(self._jobs) >= _MOST or self._size + size > _MOST_BYTES:
                self.left_out += 1
                return
            self._size += size
            self._jobs.append((size, job))
        self.ring()

    def ring(self) -> None:
        """Wake the one that waits; from any thread, and from a signal handler."""
        with self._lock:
            if self.fd >= 0:
                os.eventfd_write(self.fd, 1)

    def take(self) -> None:
        with contextlib.suppress(BlockingIOError):
            os.eventfd_read(self.fd)
        for _ in range(len(self._jobs)):
            with self._lock:
                size, job = self._jobs.popleft()
                self._size -= size
            job()

    def close(self) -> None:
        with self._lock:
            fd, self.fd = self.fd, -1
            os.close(fd)


ANSWER_S = 1.0
_PATIENCE_NS = 3 * NS_PER_S
"""With nobody there, until it is looked at why, and until it is looked at again."""
_PING_NS = 150_000_000
_SILENCE_NS = 400_000_000
"""Without round trips: on a long link the answer to a ping needs that, too."""
_ROUND_TRIPS, _LONGEST_ROUND_TRIP_NS = 2, NS_PER_S
"""The answer to a ping, and once more where a packet of it got lost."""
_MOST_TROUBLE, _MOST_BRIDGES = 256, 256


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
        guard: counts its messages that cannot be taken.
        room: memory for its services.
        host: name of its machine; empty: not known.
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
        self.instance, self._start, self.host = "", "", ""
        self.switches = 0
        self.is_connected = False
        self.since_ns: int = now_ns()
        self.tell = tell
        self._link, self._turns, self._watcher = link, turns, watcher
        self._there: set[str] = set()  # bridges that serve the robot
        self._others: set[str] = set()  # other robots
        self._why_not, self._next_why_ns, self._asking_why = why_not, now_ns() + _PATIENCE_NS, False
        self._heard_ns = self._pinged_ns = self._next_clock_ns = 0
        self._told: set[str] = set()
        self.guard = Guard(self._refused)
        self.room = Room()
        self._pinger = Pinger(link, self.who, self._clock_answered, self.guard)
        link.watch(ALL_TOKENS, lambda key, there: self.soon("a token", lambda: self._token(key, there)))

    @property
    def robot(self) -> str:
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
            returned_ns, payload = now_ns(), reply.payload
            self.soon("an answer", lambda: answered(payload, returned_ns), len(payload or b""))

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
        return self._link.listen(key, self.guard.of_messages("a frame", heard))

    def soon(self, kind: str, work: Callable[[], object], size: int = 0) -> None:
        """Have what a message of the robot asks for done in a turn; see :meth:`skinware.bridge.peer.Turns.soon`."""
        self._turns.soon(lambda: self.guard.run(kind, work), size)

    def follows(self, told: Services) -> bool:
        """Whether what a bridge says of itself counts: not if another one is followed and still there."""
        before, instance = self.instance, told.instance
        if before and instance != before and before in self._there:
            self._namesake(instance, told.host)
            return False
        is_other = bool(before) and (instance != before) and told.start != self._start
        host, self.host = self.host, told.host
        if instance != before:
            self.instance, self.keys = instance, Keys(self.robot, instance)
            self._pinger.follow(self.keys)
            self._watcher.moved()
        self.heard()
        if is_other:
            self._switched(before, host)
        if told.start != self._start:
            self._start = told.start
            self.clock = PeerClock()
            self._ask_clock()
            self._watcher.restarted()
        return True

    @property
    def namesakes(self) -> int:
        """Other bridges that serve a robot of this name."""
        return len(self._there - {self.instance}) if self.instance else 0

    def _namesake(self, instance: str, host: str) -> None:
        self.say_once(
            "robot",
            f"robot {self.robot} is served by two bridges: {_named(self.instance, self.host)}, which is followed, and"
            f" {_named(instance, host)}: give each robot a name of its own",
        )

    def _switched(self, before: str, host: str) -> None:
        """Another machine, or another start or namespace of it, has taken the place of the one that was followed."""
        why = (
            f"{_named(self.instance, self.host)} serves it now, and not {_named(before, host)}: it may be another robot"
        )
        self.switches += 1
        self.tell({"event": "switched", "robot": self.robot, "instance": self.instance, "host": self.host, "why": why})

    def heard(self) -> None:
        self._heard_ns = now_ns()
        if not self.is_connected:
            self.is_connected, self.since_ns = True, self._heard_ns
            self._told.clear()
            self.tell({"event": "connected", "robot": self.robot, "instance": self.instance, "host": self.host})

    def look(self, time_ns: int) -> None:
        if time_ns >= self._next_clock_ns:
            self._ask_clock()
        if self.is_connected and time_ns - self._heard_ns > _SILENCE_NS - _PING_NS:
            round_trip_ns = self.clock.round_trip_ns if self.clock.is_known else _LONGEST_ROUND_TRIP_NS
            if time_ns - self._heard_ns > _SILENCE_NS + _ROUND_TRIPS * round_trip_ns:
                self._lose("nothing comes over the link")
            elif time_ns - self._pinged_ns > _PING_NS:
                self._ask_clock()
        if not self.is_connected and time_ns >= self._next_why_ns and not self._asking_why:
            self._asking_why, self._next_why_ns = True, time_ns + _PATIENCE_NS
            threading.Thread(target=self._ask_why, name="skinware bridge diagnosis", daemon=True).start()

    def _refused(self, kind: str, why: str) -> None:
        text = f"robot {self.robot}: {kind} cannot be read: {why}"
        self._turns.soon(lambda: self.tell({"event": "trouble", "about": "message", "why": text}))

    def say_once(self, about: str, text: str) -> None:
        """Report trouble, once for as long as the robot is heard."""
        if text not in self._told and len(self._told) < _MOST_TROUBLE:
            self._told.add(text)
            self.tell({"event": "trouble", "about": about, "why": text})

    def _token(self, key: str, there: bool) -> None:
        robot, version, instance = token_parts(key)
        if robot != self.robot:
            if not there or len(self._others) < _MOST_BRIDGES:
                (self._others.add if there else self._others.discard)(robot)
            return
        if there and len(self._there) >= _MOST_BRIDGES:
            raise BridgeError(f"more than {_MOST_BRIDGES} bridges serve robot {self.robot}")
        (self._there.add if there else self._there.discard)(instance)
        if there and version != VERSION:
            self.say_once(
                "version",
                f"robot {self.robot} is served by version {version or '?'} of the bridge; this one is {VERSION}:"
                " install the same on both machines",
            )
        elif there:
            self._watcher.appeared()
        elif instance == self.instance:
            self._lose("its bridge ended")

    def _lose(self, why: str) -> None:
        if not self.is_connected:
            return
        self.is_connected, self.since_ns = False, now_ns()
        self._next_why_ns = self.since_ns + _PATIENCE_NS  # another bridge may serve it
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

    def _clock_answered(self, sample: Exchange) -> None:
        self.soon("a clock", lambda: self._take_clock(sample))

    def _take_clock(self, sample: Exchange) -> None:
        self.heard()
        self.clock.add(sample)
        self._watcher.clock_told()


def _named(instance: str, host: str) -> str:
    return f"bridge {instance[:8]} on {host}" if host else f"bridge {instance[:8]}"
