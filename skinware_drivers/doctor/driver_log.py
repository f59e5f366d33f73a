"""Sum up the snapshots of one driver, running or recorded: counters, states, times, and the health of its taxels."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from skinware.driver_service import counters_of
from skinware.driver_snapshot import DriverSnapshot
from skinware.errors import ConfigurationError
from skinware.matrices import filled_by
from skinware.memory.statistics import BUCKETS, Histogram
from skinware.state import count_statuses, state_name
from skinware.status import BusReason, BusState, PatchState, Status, load_report, sample_report, sample_text
from skinware.structure import Structure
from skinware.tactile.chain import ChainSettings
from skinware.tactile.health import HealthKind, HealthReport
from skinware.tactile.health_service import ChainHealth
from skinware_drivers.doctor.evidence import (
    BusSeen,
    Change,
    Counted,
    DriverSeen,
    DriverTiming,
    HealthSeen,
    PatchSeen,
    TaxelFault,
)

_MOST_CHANGES = 500
_MOST_NAMES = 3
_JUDGE_EVERY_NS = 45_000_000
"""Snapshots at a higher rate say nothing more of a taxel's health."""
_STUCK_S = 600.0
_BAD = np.uint8(Status.SUSPECT | Status.NOT_CONNECTED | Status.NO_ACK)

Numbers = npt.NDArray[np.int64]
Tables = Mapping[str, npt.NDArray[Any]]


class _Growth:
    def __init__(self, names: list[str], counts: npt.NDArray[np.uint64]) -> None:
        self.names = names
        self.now: Numbers = counts.astype(np.int64)
        self.grown: Numbers = np.zeros_like(self.now)

    def follow(self, counts: npt.NDArray[np.uint64], *, same_writer: bool) -> None:
        """Add the counters of the next snapshot; one of another writer that is smaller has begun at 0 again.

        Of the same writer, frames that were taken for lost have come after all.
        """
        now = counts.astype(np.int64)
        self.grown += np.where(same_writer | (now >= self.now), now - self.now, now)
        self.now = now

    def counted(self, row: int) -> Counted:
        now, grown = (dict(zip(self.names, counts[row].tolist(), strict=True)) for counts in (self.now, self.grown))
        return Counted(now, grown)


class DriverLog:
    def __init__(self, structure: Structure, driver: str) -> None:
        self.structure = structure
        self.newest: DriverSnapshot | None = None
        self._frames = 0
        self._future_ns = self._backwards = 0
        self.longest_gap_s = 0.0
        self._buses: _Growth | None = None
        self._patches: _Growth | None = None
        self._states: dict[tuple[str, int], list[Change]] = {}
        self._judge = TaxelJudge(structure, driver)
        names = ("patch_interval_counts", "patch_age_counts")
        self._times = {name: np.zeros((structure.n_patches, BUCKETS), np.int64) for name in names}
        self._load = np.zeros(len(structure.buses), np.uint16)
        self._always: npt.NDArray[np.uint8] = np.full(structure.n_sensors, 0xFF, np.uint8)
        self._is_lit: npt.NDArray[np.bool_] = np.zeros(structure.n_sensors, bool)

    def take(self, frame: DriverSnapshot, tables: Tables, time_s: float) -> None:
        bus_names, bus_counts = counters_of(frame, tables, "bus", len(self.structure.buses))
        patch_names, patch_counts = counters_of(frame, tables, "patch", self.structure.n_patches)
        before = self.newest
        if before is None or self._buses is None or self._patches is None:
            self._buses, self._patches = _Growth(bus_names, bus_counts), _Growth(patch_names, patch_counts)
        else:
            same_writer = before.generation == frame.generation
            self._buses.follow(bus_counts, same_writer=same_writer)
            self._patches.follow(patch_counts, same_writer=same_writer)
            self._follow_times(before, frame)
        self._load = np.maximum(self._load, np.where(frame.bus_load == 0xFFFF, 0, frame.bus_load))
        self._follow_states(frame, time_s)
        self._always &= frame.status
        self._is_lit |= frame.values != 0
        self._frames += 1
        self.newest = frame
        if not frame.stale:
            self._judge.take(frame)

    def _follow_times(self, before: DriverSnapshot, frame: DriverSnapshot) -> None:
        same_writer = before.generation == frame.generation
        for name, total in self._times.items():
            now, was = (getattr(one, name).astype(np.int64) for one in (frame, before))
            total += np.where((now >= was) & same_writer, now - was, now)
        times, earlier = frame.group_time_ns, before.group_time_ns
        self._backwards += int(np.count_nonzero((times < earlier) & (times > 0))) if same_writer else 0
        self._future_ns = max(self._future_ns, int(times.max(initial=0)) - frame.published_ns)
        self.longest_gap_s = max(self.longest_gap_s, (frame.published_ns - before.published_ns) / 1e9)

    def _follow_states(self, frame: DriverSnapshot, time_s: float) -> None:
        states: dict[tuple[str, int], Change] = {}
        for row, (state, reason) in enumerate(zip(frame.bus_state.tolist(), frame.bus_reason.tolist(), strict=True)):
            why = state_name(BusReason, reason).replace("_", "-") if reason else ""
            states["bus", row] = Change(time_s, state_name(BusState, state), why)
        for row, state in enumerate(frame.patch_state.tolist()):
            states["patch", row] = Change(time_s, state_name(PatchState, state))
        for part, now in states.items():
            changes = self._states.setdefault(part, [])
            if not changes or (changes[-1].state, changes[-1].reason) != (now.state, now.reason):
                if len(changes) == _MOST_CHANGES:
                    del changes[1]
                changes.append(now)

    def seen(self, status: npt.NDArray[np.uint8], at_ns: int, timing: DriverTiming, **facts: Any) -> DriverSeen:
        """Return the sum.

        Args:
            status: (n_sensors,) of the sensors at the end.
            at_ns: time of the end, CLOCK_MONOTONIC.
            facts: fields that are not in snapshots: the name of the driver, its process, its life and restarts.
        """
        statuses, affected = self._affected(status)
        suspect = (self._always & np.uint8(Status.SUSPECT)) != 0
        is_dark = self._dark_modules()
        dark_sensors = np.bincount(self.structure.sensor_module[suspect], minlength=self.structure.n_modules)
        bad = ((self._always & _BAD) != 0) & ~is_dark[self.structure.sensor_module]
        period_ns = 0 if self.newest is None else self.newest.period_ns
        return DriverSeen(
            data_path="not_told" if self.newest is None else self.newest.data_path.name.lower(),
            frames=self._frames,
            structure=self.structure,
            statuses=statuses,
            affected=affected,
            lines=whole_lines(self.structure, bad) if self._frames else (),
            dark={self.structure.module_names[row]: int(dark_sensors[row]) for row in np.flatnonzero(is_dark).tolist()},
            buses=self.buses(),
            patches=self.patches(status, at_ns),
            timing=replace(timing, period_ns=period_ns, future_ns=self._future_ns, backwards=self._backwards),
            health=self._judge.seen(),
            **facts,
        )

    def buses(self) -> tuple[BusSeen, ...]:
        frame = self.newest
        if frame is None or self._buses is None:
            return ()
        found = []
        for row, name in enumerate(self.structure.buses):
            changes = tuple(self._states["bus", row])
            since_ns = int(frame.bus_since_ns[row])
            samples = sample_report(frame.bus_samples[row])
            found.append(
                BusSeen(
                    name=name,
                    state=changes[-1].state,
                    reason=changes[-1].reason,
                    since_s=(frame.published_ns - since_ns) / 1e9 if since_ns else None,
                    load=load_report(int(self._load[row]))["load"] if self._load[row] else None,  # type: ignore[arg-type]
                    counted=self._buses.counted(row),
                    samples=tuple(f"{one['why'].replace('_', ' ')}: {sample_text(one)}" for one in samples),
                    changes=changes,
                )
            )
        return tuple(found)

    def patches(self, status: npt.NDArray[np.uint8], at_ns: int) -> tuple[PatchSeen, ...]:
        frame, structure = self.newest, self.structure
        if frame is None or self._patches is None:
            return ()
        n = structure.n_patches
        newest_ns = np.zeros(n, np.int64)
        np.maximum.at(newest_ns, structure.group_patch, frame.group_time_ns)
        sensors, modules, fresh = (
            np.bincount(of, minlength=n).tolist()
            for of in (structure.sensor_patch, structure.module_patch, structure.sensor_patch[status == 0])
        )
        return tuple(
            PatchSeen(
                name=name,
                bus=structure.buses[int(structure.patch_bus[row])],
                state=self._states["patch", row][-1].state,
                sensors=sensors[row],
                modules=modules[row],
                fresh=fresh[row],
                age_ns=at_ns - int(newest_ns[row]) if newest_ns[row] else None,
                counted=self._patches.counted(row),
                interval=Histogram(self._times["patch_interval_counts"][row].tolist()),
                delay=Histogram(self._times["patch_age_counts"][row].tolist()),
                changes=tuple(self._states["patch", row]),
            )
            for row, name in enumerate(structure.patch_names)
        )

    def _affected(self, status: npt.NDArray[np.uint8]) -> tuple[dict[str, int], dict[str, tuple[str, ...]]]:
        """Return the numbers of sensors by status, and the names of the first few with each status but ``fresh``.

        A sensor that was out of range for a while was pressed hard: only sensors that always were are counted.
        """
        shown = status & (self._always | ~np.uint8(Status.OUT_OF_RANGE))
        counts = count_statuses(shown)
        dark = self._dark_modules()[self.structure.sensor_module]
        named = np.where(dark, shown & ~np.uint8(Status.SUSPECT), shown)
        names = {
            bit.name.lower(): tuple(
                self.structure.sensor_name(position)
                for position in np.flatnonzero(named & np.uint8(bit))[:_MOST_NAMES].tolist()
            )
            for bit in Status
            if bit.name and counts[bit.name.lower()]
        }
        return counts, names

    def _dark_modules(self) -> npt.NDArray[np.bool_]:
        is_dark = ((self._always & np.uint8(Status.SUSPECT)) != 0) & ~self._is_lit & (self._frames > 0)
        found = np.bincount(self.structure.sensor_module, is_dark, self.structure.n_modules) > 0
        found[self.structure.sensor_module[~is_dark]] = False
        return found if self.newest is None else found | self.newest.module_untouched


def whole_lines(structure: Structure, bad: npt.NDArray[np.bool_]) -> tuple[str, ...]:
    """Return the names of rows, columns (counted from 0) and whole matrices (kind ``12x32``) of bad sensors."""
    found: list[str] = []
    for module, name in enumerate(structure.module_names):
        kind = structure.module_kind[module].decode()
        index = structure.module_index(module)
        for type_id in np.unique(structure.sensor_type[index]).tolist():
            of_type = bad[index[structure.sensor_type[index] == type_id]]
            shape = filled_by(kind, len(of_type))
            if shape is None:
                continue
            matrix = of_type.reshape(shape)
            if matrix.all():
                found.append(f"all of {name}")
            elif 1 not in shape:
                rows, columns = (np.flatnonzero(matrix.all(axis=axis)).tolist() for axis in (1, 0))
                found += [f"row {row} of {name}" for row in rows]
                found += [f"column {column} of {name}" for column in columns]
    return tuple(dict.fromkeys(found))


class TaxelJudge:
    def __init__(self, structure: Structure, driver: str) -> None:
        self._structure = structure
        self._first_ns = self._due_ns = self._last_ns = 0
        self._why_not = ""
        self._values: npt.NDArray[np.float32] = np.zeros(structure.n_sensors, np.float32)
        self._status: npt.NDArray[np.uint8] = np.zeros(structure.n_sensors, np.uint8)
        try:
            self._chain = ChainSettings.calm().chain(structure)
        except ConfigurationError:
            self._why_not = "its sensors have no value of rest"
            return
        self._health = ChainHealth(self._chain, driver)

    def take(self, frame: DriverSnapshot) -> None:
        if self._why_not or frame.acquired_ns < self._due_ns:
            return
        self._first_ns = self._first_ns or frame.acquired_ns
        self._last_ns, self._due_ns = frame.acquired_ns, frame.acquired_ns + _JUDGE_EVERY_NS
        with np.errstate(all="ignore"):  # values may be any that a file or a device gives
            self._chain.step(frame, self._values, self._status)
            self._health.update(frame.acquired_ns)

    def seen(self) -> HealthSeen:
        if self._why_not or not self._health:
            return HealthSeen("", 0, (), {"health": self._why_not or "no sensor can be judged"})
        faults: list[TaxelFault] = []
        with np.errstate(all="ignore"):
            reports = self._health.reports()
        known_noise = untouched = judged = 0
        for name, report in reports.items():
            positions = self._structure.index(name)
            faults += taxel_faults(self._structure, positions, report)
            judged += len(positions)
            known_noise += int(np.isfinite(report.noise).sum())
            untouched += int((report.kind == HealthKind.NEVER_TOUCHED).sum())
        missing = {}
        seconds = (self._last_ns - self._first_ns) / 1e9
        if not known_noise:
            missing["noisy and clipped taxels"] = f"that takes 10 s without a touch, and these were {seconds:.0f} s"
        if seconds < _STUCK_S:
            missing["stuck taxels"] = f"that takes {_STUCK_S / 60:.0f} min of use, and these were {seconds:.0f} s"
        if untouched or not faults:
            missing["dead and weak taxels"] = f"nothing has touched {untouched:,} of {judged:,} meanwhile"
        return HealthSeen("these frames", judged, tuple(faults), missing)


def taxel_faults(
    structure: Structure, positions: npt.NDArray[np.int64], report: HealthReport
) -> tuple[TaxelFault, ...]:
    units = {sensor_type.id: sensor_type.unit for sensor_type in structure.types}
    faults = []
    for row in np.flatnonzero(report.faulty).tolist():
        position, other = int(positions[row]), int(report.other[row])
        other_name = structure.sensor_name(int(positions[other])) if other >= 0 else ""
        evidence = report.evidence(row, units[int(structure.sensor_type[position])], other_name)
        kind = HealthKind(int(report.kind[row])).name.lower()
        faults.append(TaxelFault(structure.sensor_name(position), kind, evidence))
    return tuple(faults)
