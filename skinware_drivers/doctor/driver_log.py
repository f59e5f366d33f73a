"""What the frames of one driver tell, one after the other: counters that grow, states that change, times that jump.

The frames may come from a running driver or from a recording.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from skinware.driver_service import counters_of
from skinware.driver_snapshot import DriverSnapshot
from skinware.memory.statistics import BUCKETS, Histogram
from skinware.samples import sample_report, sample_text
from skinware.state import bus_reason_name, bus_state_name, count_statuses, patch_state_name
from skinware.status import Status, load_report
from skinware.structure import Structure
from skinware_drivers.doctor.evidence import BusSeen, Change, Counted, PatchSeen
from skinware_drivers.doctor.judging import whole_lines

_HOUR_S = 3600
_MOST_CHANGES = 500
_MOST_NAMES = 3
_BAD = np.uint8(Status.SUSPECT | Status.NOT_CONNECTED | Status.NO_ACK)

Numbers = npt.NDArray[np.int64]
Tables = Mapping[str, npt.NDArray[Any]]


class _Growth:
    """Counters of all buses or patches: what they began with, and by how much they grew."""

    def __init__(self, names: list[str], counts: npt.NDArray[np.uint64]) -> None:
        self.names = names
        self.now: Numbers = counts.astype(np.int64)
        self.grown: Numbers = np.zeros_like(self.now)
        self.hours: dict[int, Numbers] = {}

    def follow(self, counts: npt.NDArray[np.uint64], time_s: float) -> None:
        """The next frame's; a counter that is smaller than before began at 0 again."""
        now = counts.astype(np.int64)
        by = np.where(now >= self.now, now - self.now, now)
        self.now = now
        if by.any():
            self.grown += by
            hour = int(time_s // _HOUR_S)
            self.hours[hour] = self.hours.get(hour, 0) + by

    def counted(self, row: int, *, by_hour: bool) -> Counted:
        hours = sorted(self.hours.items()) if by_hour else ()
        return Counted(
            self._named(self.now[row]),
            self._named(self.grown[row]),
            tuple((hour, self._named(counts[row])) for hour, counts in hours if counts[row].any()),
        )

    def _named(self, row: Numbers) -> dict[str, int]:
        return dict(zip(self.names, row.tolist(), strict=True))


@dataclass
class DriverLog:
    """Follows the frames of one structure of a driver.

    Args:
        structure: of the driver.
        by_hour: losses are told by the hour.

    Attributes:
        frames: that were taken.
        newest: the last one; None before the first.
        future_ns, backwards, longest_gap_s: see :class:`skinware_drivers.doctor.evidence.Timing`.
    """

    structure: Structure
    by_hour: bool = False
    frames: int = 0
    newest: DriverSnapshot | None = None
    future_ns: int = 0
    backwards: int = 0
    longest_gap_s: float = 0.0
    load: npt.NDArray[np.uint16] = field(init=False)
    _buses: _Growth | None = None
    _patches: _Growth | None = None
    _states: dict[tuple[str, int], list[Change]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        n = self.structure.n_patches
        self._interval, self._delay = (np.zeros((n, BUCKETS), np.int64) for _ in range(2))
        self.load = np.zeros(len(self.structure.buses), np.uint16)
        self._always: npt.NDArray[np.uint8] = np.full(self.structure.n_sensors, 0xFF, np.uint8)
        self._is_lit: npt.NDArray[np.bool_] = np.zeros(self.structure.n_sensors, bool)

    def take(self, frame: DriverSnapshot, tables: Tables, time_s: float) -> None:
        """Take in the next frame.

        Args:
            frame: it, of this structure.
            tables: static columns of its generation.
            time_s: when it was published, since somebody began to look.
        """
        bus_names, bus_counts = counters_of(frame, tables, "bus", len(self.structure.buses))
        patch_names, patch_counts = counters_of(frame, tables, "patch", self.structure.n_patches)
        before = self.newest
        if before is None or self._buses is None or self._patches is None:
            self._buses, self._patches = _Growth(bus_names, bus_counts), _Growth(patch_names, patch_counts)
        else:
            self._buses.follow(bus_counts, time_s)
            self._patches.follow(patch_counts, time_s)
            self._follow_times(before, frame)
        self.load = np.maximum(self.load, np.where(frame.bus_load == 0xFFFF, 0, frame.bus_load))
        self._follow_states(frame, time_s)
        self._always &= frame.status
        self._is_lit |= frame.values != 0
        self.frames += 1
        self.newest = frame

    def _follow_times(self, before: DriverSnapshot, frame: DriverSnapshot) -> None:
        same_writer = before.generation == frame.generation
        for total, name in ((self._interval, "patch_interval_counts"), (self._delay, "patch_age_counts")):
            now, was = (getattr(one, name).astype(np.int64) for one in (frame, before))
            total += np.where((now >= was) & same_writer, now - was, now)
        times, earlier = frame.group_time_ns, before.group_time_ns
        self.backwards += int(np.count_nonzero((times < earlier) & (times > 0))) if same_writer else 0
        self.future_ns = max(self.future_ns, int(times.max(initial=0)) - frame.published_ns)
        self.longest_gap_s = max(self.longest_gap_s, (frame.published_ns - before.published_ns) / 1e9)

    def _follow_states(self, frame: DriverSnapshot, time_s: float) -> None:
        reasons = frame.bus_reason.tolist()
        for row, state in enumerate(frame.bus_state.tolist()):
            reason = (bus_reason_name(reasons[row]) or "").replace("_", "-")
            self._note_state(("bus", row), Change(time_s, bus_state_name(state), reason))
        for row, state in enumerate(frame.patch_state.tolist()):
            self._note_state(("patch", row), Change(time_s, patch_state_name(state)))

    def _note_state(self, who: tuple[str, int], now: Change) -> None:
        states = self._states.setdefault(who, [])
        if not states or (states[-1].state, states[-1].reason) != (now.state, now.reason):
            if len(states) == _MOST_CHANGES:
                del states[1]
            states.append(now)

    # -- what came of it ----------------------------------------------------------------------------------------

    def buses(self) -> tuple[BusSeen, ...]:
        """Its buses, as the newest frame has them; none before the first."""
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
                    load=load_report(int(self.load[row]))["load"] if self.load[row] else None,  # type: ignore[arg-type]
                    counted=self._buses.counted(row, by_hour=self.by_hour),
                    samples=tuple(f"{one['why'].replace('_', ' ')}: {sample_text(one)}" for one in samples),
                    changes=changes,
                )
            )
        return tuple(found)

    def patches(self, status: npt.NDArray[np.uint8], at_ns: int) -> tuple[PatchSeen, ...]:
        """Its patches, likewise.

        Args:
            status: (n_sensors,) of the sensors at the end.
            at_ns: when that is, CLOCK_MONOTONIC.
        """
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
                counted=self._patches.counted(row, by_hour=self.by_hour),
                interval=Histogram(self._interval[row].tolist()),
                delay=Histogram(self._delay[row].tolist()),
                changes=tuple(self._states["patch", row]),
            )
            for row, name in enumerate(structure.patch_names)
        )

    def affected(self, status: npt.NDArray[np.uint8]) -> tuple[dict[str, int], dict[str, tuple[str, ...]]]:
        """Sensors by status, and the names of the first few of each but ``fresh``, and of modules that are dark.

        A sensor that was out of range for a while was pressed hard: only those that always are count as such.

        Args:
            status: (n_sensors,) of the sensors at the end.
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

    def lines(self) -> tuple[str, ...]:
        """Names of the rows and columns of matrices of which nothing good came, in no frame; of dark ones, none."""
        dark = self._dark_modules()[self.structure.sensor_module]
        return whole_lines(self.structure, ((self._always & _BAD) != 0) & ~dark) if self.frames else ()

    def dark(self) -> dict[str, int]:
        """The modules that sent nothing but 0, if the driver says so, with how many of their sensors are suspect."""
        suspect = (self._always & np.uint8(Status.SUSPECT)) != 0
        sensors = np.bincount(self.structure.sensor_module[suspect], minlength=self.structure.n_modules)
        dark = np.flatnonzero(self._dark_modules()).tolist()
        return {self.structure.module_names[module]: int(sensors[module]) for module in dark}

    def _dark_modules(self) -> npt.NDArray[np.bool_]:
        is_dark = ((self._always & np.uint8(Status.SUSPECT)) != 0) & ~self._is_lit & (self.frames > 0)
        found = np.bincount(self.structure.sensor_module, is_dark, self.structure.n_modules) > 0
        found[self.structure.sensor_module[~is_dark]] = False
        return found if self.newest is None else found | self.newest.module_untouched
