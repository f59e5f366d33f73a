"""Gather the evidence of a recording, from the file alone."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

import skinware.recording
from skinware.memory.statistics import Histogram
from skinware.realtime import NS_PER_S
from skinware.recording import RecordedDriverSnapshot, Recording
from skinware.status import Status
from skinware_drivers.doctor.driver_log import DriverLog
from skinware_drivers.doctor.evidence import (
    BusSeen,
    Counted,
    DriverSeen,
    DriverTiming,
    Evidence,
    PatchSeen,
    RecordingSeen,
)
from skinware_drivers.doctor.looking import MachineWatch

_LOOK_EVERY_NS = 45_000_000
"""Snapshots in between are only counted and timed."""
_PROGRESS_EVERY = 200
_SET_S = 0.1
_CLOSED, _DEAD = "closed", "dead"

_PartT = TypeVar("_PartT", BusSeen, PatchSeen)


def look_at(file: Path, progress: Callable[[float], object] = lambda _seconds: None) -> Evidence:
    with skinware.recording.open(file) as recording:
        events = recording.events
        drivers = {name: _DriverTrack(name) for name in recording.drivers}
        for number, (time_s, name, frame, _) in enumerate(recording.moments(tuple(drivers))):
            if isinstance(frame, RecordedDriverSnapshot):
                drivers[name].take(frame, recording[name].generation(frame.generation).static(), time_s)
            if number % _PROGRESS_EVERY == 0:
                progress(time_s)
        seen = tuple(one for track in drivers.values() if (one := track.seen(events)) is not None)
        return Evidence(
            seconds=recording.duration_s,
            namespace="",
            drivers=seen,
            machine=MachineWatch().seen(),
            recording=_recording_seen(recording, events),
        )


def _recording_seen(recording: Recording, events: Sequence[dict[str, Any]]) -> RecordingSeen:
    clock = recording.clock
    # the wall clock against CLOCK_MONOTONIC, which cannot be set
    offsets = [
        (moment["time_s"], (moment["realtime_ns"] - moment["monotonic_ns"]) / NS_PER_S, moment.get("boot"))
        for moment in clock
        if isinstance(moment.get("realtime_ns"), int) and isinstance(moment.get("monotonic_ns"), int)
    ]
    clock_sets = [
        (time_s, now - before)
        for (_, before, boot), (time_s, now, boot_now) in pairwise(offsets)
        if boot == boot_now and abs(now - before) > _SET_S
    ]
    return RecordingSeen(
        name=recording.path.name,
        size=recording.path.stat().st_size,
        duration_s=recording.duration_s,
        is_whole=recording.is_whole,
        problems=tuple(recording.problems),
        services=tuple(name for name in recording.services if name not in recording.drivers),
        missed=sum(
            event["count"] for event in events if event.get("event") == "missed" and isinstance(event.get("count"), int)
        ),
        events=Counter(str(event.get("event")) for event in events),
        clock_sets=tuple(clock_sets),
        boots=len({str(moment.get("boot")) for moment in clock}),
        recorded_by=recording.recorded_by,
    )


class _DriverTrack:
    def __init__(self, name: str) -> None:
        self._name = name
        self._logs: list[DriverLog] = []
        self._newest: RecordedDriverSnapshot | None = None
        self._driver_type = ""
        self._looked_ns = 0
        self._frames = self._restarts = 0
        self._live_ns = self._intervals = 0
        self._late, self._age = Histogram(), Histogram()
        self._longest_gap_ns = 0

    def take(self, frame: RecordedDriverSnapshot, tables: Any, time_s: float) -> None:
        before, self._newest = self._newest, frame
        self._frames += 1
        self._age.add(max(0, frame.published_ns - frame.acquired_ns))
        is_new = before is None or before.generation != frame.generation
        if is_new:
            self._restarts += before is not None
            driver_type = b"".join(bytes(text) for text in tables.get("driver_type", ())[:1])
            self._driver_type = driver_type.decode(errors="replace")
            if not self._logs or self._logs[-1].structure != frame.structure:
                self._logs.append(DriverLog(frame.structure, self._name))
        elif before is not None and frame.sequence == before.sequence + 1:  # without a loss between them
            interval_ns = frame.published_ns - before.published_ns
            self._live_ns += interval_ns
            self._intervals += 1
            self._longest_gap_ns = max(self._longest_gap_ns, interval_ns)
            if frame.period_ns:
                self._late.add(max(0, interval_ns - frame.period_ns))
        if is_new or abs(frame.published_ns - self._looked_ns) >= _LOOK_EVERY_NS:
            self._looked_ns = frame.published_ns
            self._logs[-1].take(frame, tables, time_s)

    def seen(self, events: Sequence[dict[str, Any]]) -> DriverSeen | None:
        """Return the sum, with the events of the recording; None if it has no snapshot."""
        newest = self._newest
        if newest is None:
            return None
        own = [event for event in events if event.get("service") == self._name]
        last = str(own[-1].get("event")) if own else ""
        *earlier, log = self._logs
        status, at_ns = newest.status, newest.published_ns
        buses, patches = log.buses(), log.patches(status, at_ns)
        for before in reversed(earlier):
            never_seen = np.full(before.structure.n_sensors, int(Status.NEVER_SEEN), np.uint8)
            buses = _continued(buses, before.buses())
            patches = _continued(patches, before.patches(never_seen, at_ns))
        timing = DriverTiming(
            rate_hz=self._intervals * NS_PER_S / self._live_ns if self._live_ns > 0 else None,
            late=self._late,
            age=self._age,
            longest_gap_s=self._longest_gap_ns / NS_PER_S,
        )
        seen = log.seen(
            status,
            at_ns,
            timing,
            name=self._name,
            namespace="",
            driver_type=self._driver_type,
            life=last if last in (_CLOSED, _DEAD, "paused") else "live",
            pid=0,
            scheduling="",
            restarts=self._restarts,
        )
        return replace(seen, frames=self._frames, buses=buses, patches=patches)


def _continued(now: tuple[_PartT, ...], before: tuple[_PartT, ...]) -> tuple[_PartT, ...]:
    """Return buses or patches with the counters that they had under the same name before the structure changed."""
    earlier = {part.name: part for part in before}
    return tuple(_after(earlier[part.name], part) if part.name in earlier else part for part in now)


def _after(old: _PartT, part: _PartT) -> _PartT:
    counted = Counted(part.counted.total, dict(Counter(old.counted.grown) + Counter(part.counted.grown)))
    return replace(part, counted=counted, changes=(*old.changes, *part.changes))
