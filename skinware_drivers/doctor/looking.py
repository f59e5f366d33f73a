"""Gather the evidence of a running skin and of this machine."""

from __future__ import annotations

import contextlib
import grp
import os
import platform
import resource
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numpy as np

from skinware.bridge_state import BridgeReader, BridgeState
from skinware.driver_service import DriverReader
from skinware.driver_snapshot import DriverSnapshot
from skinware.drivers import Drivers
from skinware.errors import NamespaceError, Overrun, ServiceError, ServiceTimeout, StructureChanged
from skinware.memory.announcement import ReaderRecord, living_readers
from skinware.memory.namespace import ROOT, Namespace
from skinware.memory.ring import Sample
from skinware.memory.statistics import Histogram, Spread, WriterStatistics
from skinware.realtime import now_ns
from skinware.service import ServiceReader
from skinware.state import life_of, rate_now_hz, status_now
from skinware.status import Status
from skinware.tactile.health import HealthKind
from skinware.tactile.health_service import HealthReader
from skinware.views.live import LiveBridges
from skinware_drivers.doctor.driver_log import DriverLog, taxel_faults
from skinware_drivers.doctor.evidence import (
    Counted,
    DriverSeen,
    DriverTiming,
    Evidence,
    HealthSeen,
    MachineSeen,
    NamespaceSeen,
    ReaderSeen,
)
from skinware_drivers.finding import interfaces, ports, running
from skinware_drivers.finding.interfaces import CanInterface
from skinware_drivers.finding.ports import text_of
from skinware_drivers.running.news import softnet_dropped

_LOOK_EVERY_S = 0.02
_POLICIES = {os.SCHED_FIFO: "SCHED_FIFO", os.SCHED_RR: "SCHED_RR"}


def watch(namespace: Namespace, seconds: float, progress: Callable[[float], object]) -> tuple[DriverSeen, ...]:
    """Read all drivers of a namespace; raise ``NamespaceError`` if it cannot be trusted or read."""
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
            late=_grown(before.lateness, now.lateness),
            age=_grown(before.age, now.age),
            before_boot=now.before_boot,
            longest_gap_s=self._log.longest_gap_s,
        )
        seen = self._log.seen(
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
        )
        return replace(seen, health=_by_calm(reader, life) or seen.health)


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


_EVERY_FRAME = "in order"
"""The kind of readers that want every snapshot; others skip some on purpose."""
_DRIVER, _SECOND_HAND = "skin-driver", ("skin-calm", "skin-replay", "skin-bridge")
_PROC = Path("/proc")


def waiting_drivers(known: set[int], proc: Path = _PROC) -> tuple[int, ...]:
    """Return the processes of ``skin-driver`` but the ``known`` ones, which publish."""
    found = {int(path.name) for path in proc.glob("[0-9]*") if program_of(int(path.name), proc) == _DRIVER}
    return tuple(sorted(found - known))


def publishes_again(pid: int, proc: Path = _PROC) -> bool:
    """Return whether a process publishes the data of another driver or of a recording, and has no bus."""
    return program_of(pid, proc) in _SECOND_HAND


def program_of(pid: int, proc: Path = _PROC) -> str:
    """Return the name of a process' program; empty if there is no such process."""
    return text_of(proc / str(pid) / "comm")


_PACKAGES = (
    "skinware",
    "numpy",
    "python-can",
    "pyserial",
    "canopen",
    "msgspec",
    "click",
    "textual",
    "mcap",
    "zstandard",
)
_LIMITS = {
    "net.core.rmem_max": Path("/proc/sys/net/core/rmem_max"),
    "net.core.netdev_max_backlog": Path("/proc/sys/net/core/netdev_max_backlog"),
    "kernel.sched_rt_runtime_us": Path("/proc/sys/kernel/sched_rt_runtime_us"),
}
_GOVERNORS = "cpu*/cpufreq/scaling_governor"
_CPUS = Path("/sys/devices/system/cpu")
_MEMORY = Path("/proc/meminfo")


class MachineWatch:
    def __init__(self) -> None:
        self._softnet = softnet_dropped()
        self._clock_s = time.time() - time.monotonic()

    def seen(self) -> MachineSeen:
        softnet = softnet_dropped()
        memory: dict[str, int] = {}
        for line in text_of(_MEMORY).splitlines():
            name, _, rest = line.partition(":")
            with contextlib.suppress(ValueError, IndexError):
                memory[name] = 1024 * int(rest.split()[0])
        total = free = 0
        try:
            room = os.statvfs(ROOT)
            total, free = room.f_frsize * room.f_blocks, room.f_frsize * room.f_bavail
            problem = "" if os.access(ROOT, os.W_OK | os.X_OK) else f"{ROOT} may not be written by this account"
        except OSError as error:
            problem = f"{ROOT}: {error.strerror}"
        groups = set()
        for number in {os.getegid(), *os.getgroups()}:
            with contextlib.suppress(KeyError):
                groups.add(grp.getgrgid(number).gr_name)
        return MachineSeen(
            versions=versions(),
            kernel=f"{platform.system()} {platform.release()} {platform.machine()}",
            cpus=len(os.sched_getaffinity(0)),
            load=os.getloadavg()[0],
            governors=tuple(sorted({text for path in _CPUS.glob(_GOVERNORS) if (text := text_of(path))})),
            memory_bytes=memory.get("MemTotal", 0),
            memory_available_bytes=memory.get("MemAvailable", 0),
            shared_bytes=total,
            shared_free_bytes=free,
            shared_problem=problem,
            locked_memory_bytes=resource.getrlimit(resource.RLIMIT_MEMLOCK)[0],
            realtime_priority=99 if os.geteuid() == 0 else resource.getrlimit(resource.RLIMIT_RTPRIO)[0],
            groups=tuple(sorted(groups)),
            limits={name: int(text) for name, path in _LIMITS.items() if (text := text_of(path)).lstrip("-").isdigit()},
            softnet_dropped=None if softnet is None or self._softnet is None else softnet - self._softnet,
            clock_set_s=time.time() - time.monotonic() - self._clock_s,
        )


def versions() -> dict[str, str]:
    found = {"skinware": "", "Python": f"{platform.python_version()} ({platform.python_implementation()})"}
    for name in _PACKAGES:
        with contextlib.suppress(PackageNotFoundError):
            found[name] = version(name)
    return found


def namespace_seen(namespace: Namespace) -> NamespaceSeen:
    path = str(namespace.path)
    if not namespace.path.exists() and not namespace.path.is_symlink():
        return NamespaceSeen(namespace.name, path)
    try:
        namespace.check()
        with Drivers(namespace, partial(ServiceReader[Sample], announce=False)) as services:
            services.look()
            if services.trouble:
                raise NamespaceError(services.trouble)
            living = tuple(name for name, reader in services.readers.items() if reader.alive)
            dead = tuple(name for name in services.readers if name not in living)
            damaged = tuple(services.unreadable.values())
        files = [namespace.ring_path(name) for name in dead]
        size = sum(file.stat().st_size for file in files if file.exists())
    except (NamespaceError, OSError) as error:
        return NamespaceSeen(namespace.name, path, problem=str(error))
    return NamespaceSeen(namespace.name, path, "", damaged, living, dead, size)


def look(namespace: Namespace, seconds: float, progress: Callable[[float], object] = lambda _seconds: None) -> Evidence:
    machine, readers_before = MachineWatch(), _readers(namespace)
    counts_before = {one.name: _counts(one) for one in interfaces.can_interfaces()}
    files = namespace_seen(namespace)
    drivers: tuple[DriverSeen, ...]
    try:
        drivers = watch(namespace, seconds, progress)
    except NamespaceError:  # a finding of its own
        drivers = ()
    living = running.running_drivers()
    readers = []
    for key, record in _readers(namespace).items():
        before = readers_before.get(key)
        if before is not None and record.kind == _EVERY_FRAME:
            frames, missed = record.frames - before.frames, record.missed - before.missed
            readers.append(ReaderSeen(record.program, record.pid, record.service, max(0, frames), max(0, missed)))
    interfaces_seen = []
    for one in interfaces.can_interfaces():
        total = _counts(one)
        was = counts_before.get(one.name, total)
        grown = {name: max(0, count - was.get(name, 0)) for name, count in total.items()}
        interfaces_seen.append((one, Counted(total, grown)))
    bridges: tuple[BridgeState, ...] = ()
    with contextlib.closing(LiveBridges(namespace, BridgeReader)) as live, contextlib.suppress(NamespaceError):
        live.look()
        bridges = tuple(live.states())
    return Evidence(
        seconds=seconds,
        namespace=namespace.name,
        drivers=drivers,
        machine=machine.seen(),
        files=files,
        interfaces=tuple(interfaces_seen),
        kernel_has_can=interfaces.kernel_has_can(),
        ports=tuple(ports.serial_ports()),
        running=tuple(one for one in living if not publishes_again(one.pid)),
        waiting=waiting_drivers({one.pid for one in living}),
        readers=tuple(readers),
        bridges=bridges,
    )


def _readers(namespace: Namespace) -> dict[tuple[int, str], ReaderRecord]:
    return {(one.pid, one.service): one for one in living_readers(namespace)}


def _counts(one: CanInterface) -> dict[str, int]:
    return {**one.statistics, **{f"controller_{name}": count for name, count in one.controller_errors.items()}}
