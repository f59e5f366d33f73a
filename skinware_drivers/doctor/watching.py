"""Looks at the drivers of a namespace for some seconds, and sums up what their frames told."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np

from skinware.cli._report import health
from skinware.driver_service import DriverReader
from skinware.driver_snapshot import DriverSnapshot
from skinware.drivers import Drivers
from skinware.errors import NamespaceError, Overrun, ServiceError, ServiceTimeout, StructureChanged
from skinware.memory.namespace import Namespace
from skinware.memory.statistics import Histogram, Spread, WriterStatistics
from skinware.realtime import now_ns
from skinware.state import life_of, rate_now_hz, status_now
from skinware.status import Status
from skinware_drivers.doctor.driver_log import DriverLog
from skinware_drivers.doctor.evidence import DriverSeen, HealthSeen, TaxelFault, Timing
from skinware_drivers.doctor.judging import TaxelJudge

_LOOK_EVERY_S = 0.02
_POLICIES = {os.SCHED_FIFO: "SCHED_FIFO", os.SCHED_RR: "SCHED_RR"}


def watch(namespace: Namespace, seconds: float, tell: Callable[[float], object]) -> tuple[DriverSeen, ...]:
    """Look at all drivers of a namespace.

    Args:
        namespace: where.
        seconds: how long.
        tell: called now and then with how long that is by now, s.

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
            tell(passed_s)
            time.sleep(min(_LOOK_EVERY_S, seconds))
        return tuple(one.seen() for one in watches)


class _DriverWatch:
    """Looks at one driver.

    Args:
        reader: of it.
    """

    def __init__(self, reader: DriverReader) -> None:
        self._reader = reader
        self._log = DriverLog(reader.structure)
        self._judge = TaxelJudge(reader.structure, reader.name)
        self._generation = reader.generation
        self._begun = self._newest_statistics = reader.writer_statistics
        self._restarts = 0
        self._newest: DriverSnapshot | None = None

    def look(self, time_s: float) -> None:
        """Take the newest frame in, if there is one that is new.

        Args:
            time_s: since the watch began.
        """
        reader = self._reader
        try:
            frame = reader.read(newer_than=self._newest, timeout_s=0.0)
        except StructureChanged:
            with contextlib.suppress(ServiceError, NamespaceError):
                reader.reattach()
                self._log = DriverLog(reader.structure)
                self._judge = TaxelJudge(reader.structure, reader.name)
            return
        except (ServiceTimeout, Overrun):
            return
        if frame.generation != self._generation:
            self._generation, self._restarts = frame.generation, self._restarts + 1
            self._begun = _nothing()
        self._newest = frame
        self._newest_statistics = reader.writer_statistics
        self._log.take(frame, reader.static(), time_s)
        if not frame.stale:
            self._judge.take(frame)

    def seen(self) -> DriverSeen:
        reader, log = self._reader, self._log
        frame = self._newest
        life = life_of(reader, frame)
        status = (
            np.full(reader.structure.n_sensors, int(Status.NEVER_SEEN), np.uint8)
            if frame is None
            else status_now(life, frame)
        )
        statuses, affected = log.affected(status)
        pid = reader.writer_pid
        return DriverSeen(
            name=reader.name,
            namespace=reader.namespace.name,
            driver_type=reader.driver_type,
            life=life,
            pid=pid,
            scheduling=_scheduling(pid) if life != "dead" else "",
            data_path="not_told" if frame is None else frame.data_path.name.lower(),
            restarts=self._restarts,
            frames=log.frames,
            frames_lost=0,
            structure=reader.structure,
            statuses=statuses,
            affected=affected,
            lines=log.lines(),
            dark=log.dark(),
            buses=log.buses(),
            patches=log.patches(status, now_ns()),
            timing=self._timing(life),
            health=_by_calm(reader, life) or self._judge.seen(),
        )

    def _timing(self, life: str) -> Timing:
        before, now, log = self._begun, self._newest_statistics, self._log
        return Timing(
            rate_hz=rate_now_hz(life, self._reader.rate_hz()),
            period_ns=0 if self._newest is None else self._newest.period_ns,
            missed=now.missed_periods - before.missed_periods,
            missed_before=before.missed_periods,
            late=_grown(before.lateness, now.lateness),
            age=_grown(before.age, now.age),
            future_ns=log.future_ns,
            backwards=log.backwards,
            before_boot=now.before_boot,
            longest_gap_s=log.longest_gap_s,
        )


def _nothing() -> WriterStatistics:
    return WriterStatistics(0, 0, 0, 0, Spread(), Spread(), Histogram(), Histogram())


def _grown(before: Histogram, now: Histogram) -> Histogram:
    return Histogram([max(0, after - was) for was, after in zip(before.counts, now.counts, strict=True)])


def _scheduling(pid: int) -> str:
    """How the kernel schedules a process; empty where that cannot be known."""
    try:
        policy = os.sched_getscheduler(pid) & ~os.SCHED_RESET_ON_FORK
        if policy in _POLICIES:
            return f"{_POLICIES[policy]} {os.sched_getparam(pid).sched_priority}"
        return "normal scheduling"
    except OSError:
        return ""


def _by_calm(reader: DriverReader, life: str) -> HealthSeen | None:
    """What ``skin-calm`` says of a driver's taxels, where it runs for it."""
    if life == "dead":
        return None
    with contextlib.suppress(NamespaceError):
        found = health([reader.namespace, Namespace(reader.namespace.calm_name)], reader.name)
        for entry in found["health"]:
            if entry["state"] == "live" and entry["sensors"] == reader.structure.n_sensors:
                return _calm_health(entry)
    return None


def _calm_health(entry: Mapping[str, Any]) -> HealthSeen:
    kinds, judged, missing = entry["kinds"], entry["sensors"] - entry["kinds"]["unknown"], {}
    if kinds["never_touched"]:
        missing["dead and weak taxels"] = f"nothing has touched {kinds['never_touched']:,} of {judged:,} so far"
    faults = tuple(TaxelFault(one["name"], one["kind"], one["evidence"]) for one in entry["faults"])
    return HealthSeen("skin-calm", judged, faults, missing)
