"""Follow the bridge that serves a robot: whether it is heard, its clock, and what is wrong with it."""

from __future__ import annotations

import contextlib
import os
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Literal

from skinware.bridge.clock import Exchange, PeerClock, Pinger
from skinware.bridge.link import Guard, ZenohLink
from skinware.bridge.messages import ALL_TOKENS, VERSION, Keys, Services, token_parts
from skinware.errors import BridgeError
from skinware.realtime import NS_PER_S, now_ns

Change = Literal["appeared", "moved", "restarted", "lost", "clock"]
"""A bridge serves the robot now; another bridge does, with other keys; its clock and generations are others than
before; it is not heard any more; its clock was measured again."""

ANSWER_S, SLOWEST_ANSWER_S = 1.0, 5.0
"""Longest wait for an answer besides a round trip, and while no round trip is known."""
_MOST_JOBS, _MOST_BYTES = 4096, 1 << 27
_PATIENCE_NS, _NEVER_NS = 3 * NS_PER_S, 1 << 62
"""How long a robot is not reached before the reason is looked for, and before it is looked for again."""
_PING_NS = 150_000_000
_SILENCE_NS = 400_000_000
"""Silence that ends a connection; on a long link the round trips of a ping come on top."""
_ROUND_TRIPS, _LONGEST_ROUND_TRIP_NS = 2, 2 * NS_PER_S
"""Round trips of a ping, one of them for a packet that got lost."""
_MOST_TROUBLE, _MOST_BRIDGES = 256, 256


class Jobs:
    """A queue of jobs that other threads add.

    Attributes:
        fd: readable while there are jobs.
        left_out: jobs that were left out because too many waited.
    """

    def __init__(self) -> None:
        self._jobs: deque[tuple[int, Callable[[], object]]] = deque()
        self._size = 0  # bytes
        self._lock = threading.RLock()  # a signal handler may interrupt its holder
        self.left_out: int = 0
        self.fd: int = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK)

    def add(self, job: Callable[[], object], size: int = 0) -> None:
        """Add a job, from any thread; leave it out if too many jobs wait, or too many bytes of their messages."""
        with self._lock:
            if len(self._jobs) >= _MOST_JOBS or self._size + size > _MOST_BYTES:
                self.left_out += 1
                return
            self._size += size
            self._jobs.append((size, job))
        self.wake()

    def wake(self) -> None:
        """Make ``fd`` readable; from any thread, and from a signal handler."""
        with self._lock:
            if self.fd >= 0:
                os.eventfd_write(self.fd, 1)

    def run(self) -> None:
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


@dataclass
class Bridges:
    """The bridges of a robot that are there, and the one that is followed.

    Attributes:
        instance, host, start: of the one that is followed, as in :class:`Services`; empty: none so far.
        switches: how often another robot of this name took the place of the first.
        there: numbers of all that are there.
    """

    instance: str = ""
    host: str = ""
    start: str = ""
    switches: int = 0
    there: set[str] = field(default_factory=set)
    other_robots: set[str] = field(default_factory=set)

    @property
    def namesakes(self) -> int:
        return len(self.there - {self.instance}) if self.instance else 0


class Peer:
    """A robot to which a link may lead. Messages that come in zenoh's threads are handled as ``jobs``.

    Args:
        why_not: returns the reason why the robot is not reached, in one line, or an empty text; it may wait.

    Attributes:
        keys: of the bridge that is followed; before one is, of any.
        guard: counts its messages that cannot be read.
    """

    def __init__(
        self,
        robot: str,
        link: ZenohLink,
        jobs: Jobs,
        changed: Callable[[Change], None],
        *,
        why_not: Callable[[], str],
        on_event: Callable[[dict[str, Any]], None],
    ) -> None:
        self.keys = Keys(robot)
        self.clock = PeerClock()
        self.bridges = Bridges()
        self.is_connected = False
        self.since_ns: int = now_ns()
        self.on_event = on_event
        self._link, self._jobs, self._changed = link, jobs, changed
        self._heard_ns = 0
        self._troubles: set[str] = set()
        self._why_not = why_not
        self._diagnose_ns = self.since_ns + _PATIENCE_NS
        self.guard = Guard(self._refused)
        self._pinger = Pinger(link, os.urandom(8).hex(), self._clock_answered, self.guard)
        link.watch_tokens(ALL_TOKENS, lambda key, there: self.soon("a token", partial(self._token, key, there)))

    @property
    def who(self) -> str:
        return self._pinger.who

    def ask(
        self,
        key: str,
        answered: Callable[[bytes | None, int], None],
        **how: Any,
    ) -> None:
        """Ask as :meth:`skinware.bridge.link.ZenohLink.ask`; a job calls ``answered(answer, when it came)``."""

        def came(answer: bytes | None) -> None:
            self.soon("an answer", partial(answered, answer, now_ns()), len(answer or b""))

        self._link.ask(key, came, **how)

    def listen(self, key: str, heard: Callable[[str, bytes], None]) -> Callable[[], None]:
        """Listen as :meth:`skinware.bridge.link.ZenohLink.listen`, in the receiving thread."""
        return self._link.listen(key, partial(self.guard.run, "a frame", heard))

    def soon(self, kind: str, work: Callable[[], object], size: int = 0) -> None:
        """Handle a message of the robot as a job; ``size`` as for :meth:`Jobs.add`."""
        self._jobs.add(partial(self.guard.run, kind, work), size)

    def heard(self) -> None:
        self._heard_ns = now_ns()
        if not self.is_connected:
            self.is_connected, self.since_ns = True, self._heard_ns
            self._troubles.clear()
            self._event("connected")

    def follows(self, services: Services) -> bool:
        """Return whether a list of services counts: not if another bridge is followed and still there."""
        bridges, instance = self.bridges, services.instance
        is_new = instance != bridges.instance
        if is_new and bridges.instance and bridges.instance in bridges.there:
            self.report_once(
                "robot",
                f"robot {self.keys.robot} is served by two bridges: {_named(bridges.instance, bridges.host)}, which is"
                f" followed, and {_named(instance, services.host)}: give each robot a name of its own",
            )
            return False
        is_restarted = services.start != bridges.start
        before = _named(bridges.instance, bridges.host) if bridges.instance and is_new and is_restarted else ""
        bridges.instance, bridges.host, bridges.start = instance, services.host, services.start
        if is_new:
            self.keys = Keys(self.keys.robot, instance)
            self._pinger.follow(self.keys)
            self._changed("moved")
        self.heard()
        if before:
            bridges.switches += 1
            now = _named(instance, bridges.host)
            self._event("switched", why=f"{now} serves it now, no longer {before}: it may be another robot")
        if is_restarted:
            self.clock = PeerClock()
            self._pinger.ask()
            self._changed("restarted")
        return True

    def look(self, time_ns: int) -> None:
        if time_ns >= self._pinger.asked_ns + self.clock.pause_ns():
            self._pinger.ask()
        silent_ns = time_ns - self._heard_ns
        if not self.is_connected:
            if time_ns >= self._diagnose_ns:
                self._diagnose_ns = _NEVER_NS
                threading.Thread(
                    target=self._diagnose, args=(time_ns,), name="skinware bridge diagnosis", daemon=True
                ).start()
        elif silent_ns > _SILENCE_NS - _PING_NS:
            round_trip_ns = self.clock.recent_round_trip_ns if self.clock.is_known else _LONGEST_ROUND_TRIP_NS
            if silent_ns > _SILENCE_NS + _ROUND_TRIPS * round_trip_ns:
                self._lose(_silence_text(silent_ns))
            elif time_ns - self._pinger.asked_ns > _PING_NS:
                self._pinger.ask()

    def report_once(self, about: str, why: str) -> None:
        """Report trouble, once until the robot is heard again."""
        if why not in self._troubles and len(self._troubles) < _MOST_TROUBLE:
            self._troubles.add(why)
            self.on_event({"event": "trouble", "about": about, "why": why})

    def _event(self, event: str, **more: str) -> None:
        bridge = {"instance": self.bridges.instance, "host": self.bridges.host}
        self.on_event({"event": event, "robot": self.keys.robot, **bridge, **more})

    def _refused(self, kind: str, why: str) -> None:
        text = f"robot {self.keys.robot}: {kind} cannot be read: {why}"
        self._jobs.add(lambda: self.on_event({"event": "trouble", "about": "message", "why": text}))

    def _token(self, key: str, there: bool) -> None:
        robot, version, instance = token_parts(key)
        bridges, is_ours = self.bridges, robot == self.keys.robot
        known, name = (bridges.there, instance) if is_ours else (bridges.other_robots, robot)
        if not there:
            known.discard(name)
        elif len(known) < _MOST_BRIDGES:
            known.add(name)
        elif is_ours:
            raise BridgeError(f"more than {_MOST_BRIDGES} bridges serve robot {robot}")
        if not is_ours:
            return
        if there and version != VERSION:
            self.report_once(
                "version",
                f"robot {robot} is served by version {version or '?'} of the bridge; this one is {VERSION}:"
                " install the same on both machines",
            )
        elif there:
            self._changed("appeared")
        elif instance == bridges.instance:
            silent_ns = now_ns() - self._heard_ns
            ended = "its bridge ended, or the connection was closed"
            self._lose(_silence_text(silent_ns) if silent_ns > _SILENCE_NS else ended)

    def _lose(self, why: str) -> None:
        if self.is_connected:
            self.is_connected, self.since_ns = False, now_ns()
            if self._diagnose_ns != _NEVER_NS:
                self._diagnose_ns = self.since_ns + _PATIENCE_NS  # another bridge may serve the robot
            self._changed("lost")
            self.on_event({"event": "disconnected", "robot": self.keys.robot, "why": why})

    def _diagnose(self, begun_ns: int) -> None:
        self._jobs.add(partial(self._diagnosed, self._why_not(), begun_ns + _PATIENCE_NS))

    def _diagnosed(self, why: str, again_ns: int) -> None:
        self._diagnose_ns = again_ns
        if not self.is_connected:
            robots = ", ".join(sorted(self.bridges.other_robots))
            hint = f"robots there: {robots}" if robots else "does it want --tls?"
            silent = f"something listens there, but no robot {self.keys.robot!r} answers; {hint}"
            self.report_once("link", why or silent)

    def _clock_answered(self, sample: Exchange) -> None:
        def take() -> None:
            self.heard()
            self.clock.add(sample)
            self._changed("clock")

        self.soon("a clock", take)


def _silence_text(silent_ns: int) -> str:
    return f"no answer for {silent_ns / NS_PER_S:.1f} s"


def _named(instance: str, host: str) -> str:
    return f"bridge {instance[:8]} on {host}" if host else f"bridge {instance[:8]}"
