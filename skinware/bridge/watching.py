"""Summaries of robots: each robot sends one a second, and a watcher collects those of all that it reaches."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial

import msgspec
import numpy as np

from skinware.bridge.clock import Exchange, PeerClock, Pinger
from skinware.bridge.link import Guard, Sender, ZenohLink
from skinware.bridge.messages import (
    ALL_SUMMARIES,
    ALL_TOKENS,
    VERSION,
    DriverSummary,
    Keys,
    Summary,
    host_name,
    read_text,
    token_parts,
)
from skinware.bridge.parts import ServedService
from skinware.driver_service import counters_of
from skinware.errors import BridgeError
from skinware.limits import LIMITS
from skinware.realtime import NS_PER_S, now_ns
from skinware.status import BusState, PatchState, is_fresh
from skinware.structure import Structure
from skinware.transfer.generation import Generation, RecordedDriverSnapshot

_TICK_S = 0.05
_MOST_NAMES = 4
"""Names of silent patches in a summary; all are counted."""


class Summaries:
    """Sends the summary of a robot while there are listeners."""

    def __init__(self, namespace: str, send: Sender) -> None:
        self._namespace, self._host, self._send = namespace, host_name(), send
        self._frames: dict[str, int] = {}
        self._counted_ns = now_ns()

    def send(self, services: Mapping[str, ServedService], missed: int) -> None:
        """Count the frames of the services, about once a second, and send the summary.

        Args:
            missed: frames that the bridge missed in their rings.
        """
        before, time_ns = self._frames, now_ns()
        seconds = (time_ns - self._counted_ns) / NS_PER_S
        self._frames, self._counted_ns = {name: served.stream.frames for name, served in services.items()}, time_ns
        if not self._send.is_heard:
            return
        drivers: dict[str, DriverSummary] = {}
        for name, served in services.items():
            driver = served.file.driver
            if driver is not None and driver.structure is not None:
                rate_hz = round((self._frames[name] - before.get(name, 0)) / seconds, 1)
                drivers[name] = _summary(rate_hz, served, driver, driver.structure)
        n_others = len(services) - len(drivers)
        self._send(msgspec.json.encode(Summary(self._namespace, drivers, n_others, missed, self._host)))


def _summary(rate_hz: float, served: ServedService, generation: Generation, structure: Structure) -> DriverSummary:
    state, newest = served.service.state, served.stream.newest
    is_live = state == "live"
    age_ms, dropped, fresh, problems = None, 0, 0, int(not is_live)
    silent: list[str] = []
    if newest is not None and newest.generation == generation.generation:
        frame = RecordedDriverSnapshot(generation, newest.slot)
        time_ns = now_ns()
        age_ms = round((time_ns - frame.acquired_ns) / 1e6, 3)
        limits_ns = structure.age_limits_ns(frame.period_ns)
        flags = is_fresh(frame.status, frame.sensor_time_ns, at_ns=time_ns, max_age_ns=limits_ns, alive=is_live)
        fresh = int(np.count_nonzero(flags))
        names, counts = counters_of(frame, generation.static(), "bus", len(structure.buses))
        dropped = int(counts[:, names.index("dropped")].sum()) if "dropped" in names else 0
        if is_live:
            rows = np.flatnonzero(frame.patch_state != PatchState.LIVE).tolist()
            silent = [structure.patch_names[row] for row in rows]
            problems += len(silent) + int(np.count_nonzero(frame.bus_state != BusState.LIVE))
    return DriverSummary(
        state,
        rate_hz,
        age_ms,
        dropped,
        structure.n_sensors,
        fresh,
        structure.n_patches,
        tuple(silent[:_MOST_NAMES]),
        len(silent),
        problems,
    )


@dataclass
class Seen:
    """A robot that is reached.

    Attributes:
        heard_ns: when that came; 0: never.
        guard: counts its messages that cannot be read.
        pinger: asks for its clock; None: not asked yet.
    """

    robot: str
    instance: str
    version: int = VERSION
    clock: PeerClock = field(default_factory=PeerClock)
    summary: Summary | None = None
    heard_ns: int = 0
    bytes: int = 0
    guard: Guard = field(default_factory=Guard)
    pinger: Pinger | None = None


class Watcher:
    """Follows all robots that a link leads to, without reading their frames.

    Args:
        asks: collect their summaries; otherwise only their names.

    Attributes:
        guard: counts messages that cannot be read and belong to no known robot.
    """

    def __init__(self, link: ZenohLink, *, asks: bool = True) -> None:
        self._link, self._asks, self._who = link, asks, os.urandom(8).hex()
        self._lock = threading.Lock()
        self._seen: dict[tuple[str, str], Seen] = {}  # by robot and instance
        self._stopping = False
        self.guard = Guard()
        link.watch_tokens(ALL_TOKENS, partial(self.guard.run, "a token", self._token))
        if asks:
            link.listen(ALL_SUMMARIES, partial(self.guard.run, "a summary", self._take_summary))

    def robots(self) -> list[Seen]:
        """Return all that are reached now, by name; two bridges of one name are two."""
        with self._lock:
            return sorted(self._seen.values(), key=lambda seen: (seen.robot, seen.instance))

    def run(self, each_second: Callable[[], object] = lambda: None) -> None:
        """Run until ``stop``; call ``each_second`` once a second."""
        second_ns = now_ns() + NS_PER_S
        while not self._stopping:
            time.sleep(_TICK_S)
            time_ns = now_ns()
            for seen in self.robots() if self._asks else ():
                is_due = seen.pinger is None or time_ns >= seen.pinger.asked_ns + seen.clock.pause_ns()
                if seen.version == VERSION and is_due:
                    self._ask_clock(seen)
            if time_ns >= second_ns:
                second_ns = max(second_ns + NS_PER_S, time_ns)
                each_second()

    def stop(self) -> None:
        """End it; from any thread, and from a signal handler."""
        self._stopping = True

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

    def _take_summary(self, key: str, payload: bytes) -> None:
        robot, instance = key.split("/")[2:4]
        with self._lock:
            seen = self._seen.get((robot, instance))
        if seen is None:
            return
        try:
            summary = read_text(payload, Summary)
        except BridgeError as error:
            seen.guard.refuse("a summary", str(error))
        else:
            with self._lock:
                seen.summary, seen.heard_ns = summary, now_ns()
                seen.bytes += len(payload)

    def _ask_clock(self, seen: Seen) -> None:
        def add(sample: Exchange) -> None:
            with self._lock:
                seen.clock.add(sample)

        pinger = seen.pinger
        if pinger is None:
            pinger = Pinger(self._link, self._who, add, seen.guard)
            pinger.follow(Keys(seen.robot, seen.instance))
            with self._lock:
                if self._seen.get((seen.robot, seen.instance)) is seen:
                    seen.pinger = pinger
            if seen.pinger is None:  # the robot has gone meanwhile
                pinger.close()
        pinger.ask()
