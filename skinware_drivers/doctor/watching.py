"""Read the drivers of a namespace for some seconds, and sum up their snapshots."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from skinware.driver_service import DriverReader
from skinware.driver_snapshot import DriverSnapshot
from skinware.drivers import Drivers
from skinware.errors import NamespaceError, Overrun, ServiceError, ServiceTimeout, StructureChanged
from skinware.memory.namespace import Namespace
from skinware.memory.statistics import Histogram, Spread, WriterStatistics
from skinware.realtime import now_ns
from skinware.state import life_of, rate_now_hz, status_now
from skinware.status import Status
from skinware.tactile.health import HealthKind
from skinware.tactile.health_service import HealthReader
from skinware_drivers.doctor.driver_log import DriverLog, taxel_faults
from skinware_drivers.doctor.evidence import DriverSeen, DriverTiming, HealthSeen

_LOOK_EVERY_S = 0.02
_POLICIES = {os.SCHED_FIFO: "SCHED_FIFO", os.SCHED_RR: "SCHED_RR"}


def watch(namespace: Namespace, seconds: float, progress: Callable[[float], object]) -> tuple[DriverSeen, ...]:
    """Read all drivers of a namespace.

    Raises:
        NamespaceError: the namespace cannot be trusted or read.
    """
    with Drivers(namespace, partial(DriverReader, announce=False)) as drivers:
        drivers.look()
        if drivers.trouble:
            raise NamespaceError(drivers.trouble)
        watches = [_DriverWatch(reader) for reader in drivers.readers.values()]
        begun_s = time.monotonic()
        while (passed_s := time.monotonic() - begun_s) < seconds:
            for one in watches:
                one.look(passed_s)
            progress(passed_s)
            time.sleep(min(_LOOK_EVERY_S, seconds))
        return tuple(one.seen() for one in watches)


class _DriverWatch:
    def __init__(self, reader: DriverReader) -> None:
        self._reader = reader
        self._log = DriverLog(reader.structure, reader.name)
        self._generation = reader.generation
        self._begun = self._newest_statistics = reader.writer_statistics
        self._restarts = 0
        self._newest: DriverSnapshot | None = None

    def look(self, time_s: float) -> None:
        """Add the newest snapshot if there is a new one, ``time_s`` after the watch began."""
        reader = self._reader
        try:
            frame = reader.read(newer_than=self._newest, timeout_s=0.0)
        except StructureChanged:
            with contextlib.suppress(ServiceError, NamespaceError):
                reader.reattach()
                self._log = DriverLog(reader.structure, reader.name)
            return
        except (ServiceTimeout, Overrun):
            return
        if frame.generation != self._generation:
            self._generation, self._restarts = frame.generation, self._restarts + 1
            self._begun = WriterStatistics(0, 0, 0, 0, Spread(), Spread(), Histogram(), Histogram())
        self._newest = frame
        self._newest_statistics = reader.writer_statistics
        self._log.take(frame, reader.static(), time_s)

    def seen(self) -> DriverSeen:
        reader, frame = self._reader, self._newest
        life = life_of(reader, frame)
        status = np.full(reader.structure.n_sensors, int(Status.NEVER_SEEN), np.uint8)
        if frame is not None:
            status = status_now(life, frame)
        before, now = self._begun, self._newest_statistics
        timing = DriverTiming(
            rate_hz=rate_now_hz(life, reader.rate_hz()),
            missed=now.missed_periods - before.missed_periods,
            missed_before=before.missed_periods,
            late=_grown(before.lateness, now.lateness),
            age=_grown(before.age, now.age),
            before_boot=now.before_boot,
            longest_gap_s=self._log.longest_gap_s,
        )
        facts: dict[str, Any] = {}
        health = _by_calm(reader, life)
        if health is not None:
            facts["health"] = health
        return self._log.seen(
            status,
            now_ns(),
            timing,
            name=reader.name,
            namespace=reader.namespace.name,
            driver_type=reader.driver_type,
            life=life,
            pid=reader.writer_pid,
            scheduling=_scheduling(reader.writer_pid) if life != "dead" else "",
            restarts=self._restarts,
            **facts,
        )


def _grown(before: Histogram, now: Histogram) -> Histogram:
    return Histogram([max(0, after - was) for was, after in zip(before.counts, now.counts, strict=True)])


def _scheduling(pid: int) -> str:
    """Return how the kernel schedules a process; empty if that is unknown."""
    try:
        policy = os.sched_getscheduler(pid) & ~os.SCHED_RESET_ON_FORK
        if policy in _POLICIES:
            return f"{_POLICIES[policy]} {os.sched_getparam(pid).sched_priority}"
        return "normal scheduling"
    except OSError:
        return ""


def _by_calm(reader: DriverReader, life: str) -> HealthSeen | None:
    """Return the health of a driver's taxels as a running ``skin-calm`` publishes it; None without one."""
    for namespace in (reader.namespace, Namespace(reader.namespace.calm_name)) if life != "dead" else ():
        with (
            contextlib.suppress(NamespaceError, ServiceTimeout, Overrun),
            Drivers(namespace, partial(HealthReader, announce=False)) as judges,
        ):
            judges.look()
            for judge in judges.readers.values():
                source = judge.source
                if source.driver == reader.name and np.array_equal(source.uid, reader.structure.sensor_uid):
                    sample = judge.read(timeout_s=0.0)
                    if life_of(judge, sample) == "live":
                        report, structure, missing = sample.report, reader.structure, {}
                        judged = int(np.isfinite(report.still_s).sum())
                        untouched = int((report.kind == HealthKind.NEVER_TOUCHED).sum())
                        if untouched:
                            missing["dead and weak taxels"] = f"nothing has touched {untouched:,} of {judged:,} so far"
                        faults = taxel_faults(structure, np.arange(structure.n_sensors), report)
                        return HealthSeen("skin-calm", judged, faults, missing)
    return None
