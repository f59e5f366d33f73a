"""The skin at one moment, and over the last seconds: samples of several drivers brought to one time base."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from skinware.driver_snapshot import DriverSnapshot
from skinware.errors import ConfigurationError
from skinware.realtime import NS_PER_S
from skinware.skin_layout import SkinLayout
from skinware.snapshot import Snapshot
from skinware.status import age_limit_ns

_SPARE = 1.5
"""So many times the window is kept, so that the rows before the newest one of the slowest driver are there."""


@dataclass(frozen=True, eq=False)
class SkinMoment:
    """The skin at one moment: the samples of each driver around it.

    A sensor's data has a time of its own (``Snapshot.time_ns``), and values are interpolated between these times.

    Attributes:
        time_ns: the moment, CLOCK_MONOTONIC ns.
        before, after: of each driver the last sample acquired by the moment, and the next one; the same sample where
            its ring has none on one side.
    """

    time_ns: int
    before: Snapshot
    after: Snapshot

    @property
    def nearest(self) -> Snapshot:
        """The snapshot whose sample of each driver is the one acquired nearest to the moment."""
        pairs = zip(self.before.samples, self.after.samples, strict=True)
        return Snapshot(self.before.layout, tuple(self._nearer(*pair) for pair in pairs))

    def _nearer(self, before: DriverSnapshot, after: DriverSnapshot) -> DriverSnapshot:
        return after if after.acquired_ns - self.time_ns < self.time_ns - before.acquired_ns else before

    def off_s(self, type_name: str) -> npt.NDArray[np.float64]:
        """Return (n,) float64, s: time of the data in ``nearest`` minus the moment; NaN where it was never seen.

        Raises:
            StructureError: no driver has such sensors; the same for all that take a type.
        """
        time_ns = self.nearest.time_ns(type_name)
        return np.where(time_ns > 0, (time_ns - self.time_ns) / NS_PER_S, np.nan)

    def physical(self, type_name: str) -> npt.NDArray[np.floating[Any]]:
        """Return (n,) float32 (float64 for raw values of int32): values at the moment, interpolated linearly.

        Beyond the samples in a ring, and between two samples with the same data, it is the nearest value.

        Raises:
            StructureError: also where drivers have different units.
        """
        before, after = self.before.physical(type_name), self.after.physical(type_name)
        weight = self._weight(type_name).astype(before.dtype)
        found: npt.NDArray[np.floating[Any]] = before + weight * (after - before)
        return found

    def error(self, type_name: str) -> npt.NDArray[np.floating[Any]]:
        """Return (n,) of the same dtype: how far the true value can be from ``physical``, in its unit.

        That holds where it stayed between the two samples meanwhile; a shorter touch is in neither.
        """
        before, after = self.before.physical(type_name), self.after.physical(type_name)
        weight = self._weight(type_name).astype(before.dtype)
        found: npt.NDArray[np.floating[Any]] = np.abs(after - before) * np.maximum(weight, 1 - weight)
        return found

    def fresh(self, type_name: str) -> npt.NDArray[np.bool_]:
        """Return (n,) bool: good status on both sides, and data at most three periods away (at least 0.2 s)."""
        is_good = (self.before.status_of(type_name) | self.after.status_of(type_name)) == 0
        limits = [
            (sample.structure.age_limits_ns(sample.period_ns)[positions]) / NS_PER_S
            for sample, positions in ((self.after.samples[d], index) for d, index in self._parts(type_name))
        ]
        found: npt.NDArray[np.bool_] = is_good & (np.abs(self.off_s(type_name)) <= np.concatenate(limits))
        return found

    def _parts(self, type_name: str) -> list[tuple[int, Any]]:
        return self.before.layout.parts(type_name)

    def _weight(self, type_name: str) -> npt.NDArray[np.float64]:
        """Share of the value after the moment, (n,)."""
        before, after = self.before.time_ns(type_name), self.after.time_ns(type_name)
        span = np.where(after > before, after - before, 1)
        return np.where(after > before, np.clip((self.time_ns - before) / span, 0.0, 1.0), 0.0)


class TimedRows(NamedTuple):
    """Values on one time base.

    Attributes:
        time_ns: (rows,) int64, CLOCK_MONOTONIC ns, the oldest first.
        physical: (rows, n) float32 (float64 for raw values of int32).
        mask: (rows, n) bool: the value was fresh, and its sample lies within a period of the row.
        off_s: (rows, drivers) float64, s: time of the sample minus the row's, of each driver that has the type.
    """

    time_ns: npt.NDArray[np.int64]
    physical: npt.NDArray[np.floating[Any]]
    mask: npt.NDArray[np.bool_]
    off_s: npt.NDArray[np.float64]


class _Kept(NamedTuple):
    acquired_ns: int
    physical: npt.NDArray[np.floating[Any]]
    fresh: npt.NDArray[np.bool_]


class TimeWindow:
    """The last seconds of a sensor type of a whole skin: all drivers on one time base, as one array.

    ::

        window = TimeWindow("pressure", 2.0, rate_hz=50)
        for snapshot in skin:
            window.add(snapshot)
            rows = window.rows()  # rows.physical is (100, n), rows.mask says which values count

    Args:
        type_name: which sensors.
        seconds: length of the window.
        rate_hz: rows a second.

    Raises:
        ConfigurationError: a window of no row.
    """

    def __init__(self, type_name: str, seconds: float, *, rate_hz: float) -> None:
        self.type_name = type_name
        self.length: int = round(seconds * rate_hz) if seconds > 0 and rate_hz > 0 else 0
        if self.length < 1:
            raise ConfigurationError(f"a window of {seconds:g} s with {rate_hz:g} rows a second has no row")
        self._step_ns = NS_PER_S / rate_hz
        self._layout = SkinLayout((), ())
        self._kept: list[deque[_Kept]] = []
        self._periods_ns: list[int] = []

    def add(self, snapshot: Snapshot) -> None:
        """Take in the samples of drivers that are new in a snapshot; old ones give way.

        A snapshot of another layout empties the window first: its sensors are others.

        Raises:
            StructureError: no driver has such sensors, or they have different units.
        """
        if snapshot.layout is not self._layout:
            self._layout = snapshot.layout
            self._layout.unit(self.type_name)
            self._kept = [deque() for _ in self._layout.parts(self.type_name)]
            self._periods_ns = [0] * len(self._kept)
        oldest_ns = int(snapshot.acquired_ns.max()) - _SPARE * (self.length + 1) * self._step_ns
        for number, (driver, _) in enumerate(self._layout.parts(self.type_name)):
            sample, kept = snapshot.samples[driver], self._kept[number]
            self._periods_ns[number] = sample.period_ns
            if not kept or sample.acquired_ns > kept[-1].acquired_ns:
                fresh = sample.fresh(self.type_name, at_ns=sample.acquired_ns)
                kept.append(_Kept(sample.acquired_ns, sample.physical(self.type_name), fresh))
            while len(kept) > 1 and kept[0].acquired_ns < oldest_ns:
                kept.popleft()

    def rows(self, end_ns: int | None = None) -> TimedRows:
        """Return the rows of the window: of each driver the sample nearest in time.

        Args:
            end_ns: time of the last row, CLOCK_MONOTONIC ns; default: the newest time that all drivers have reached,
                except silent ones.

        Raises:
            ConfigurationError: nothing was added so far.
        """
        if not self._kept:
            raise ConfigurationError("a window without samples: add a snapshot first")
        last_ns = self._reached_ns() if end_ns is None else end_ns
        times_ns = last_ns - np.rint(np.arange(self.length - 1, -1, -1) * self._step_ns).astype(np.int64)
        parts = [self._part(number, times_ns) for number in range(len(self._kept))]
        physical, mask, off_s = (np.concatenate([part[of] for part in parts], axis=1) for of in range(3))
        return TimedRows(times_ns, physical, mask, off_s)

    def _reached_ns(self) -> int:
        newest_ns = [kept[-1].acquired_ns for kept in self._kept]
        limits = (max(newest_ns) - age_limit_ns(period_ns) for period_ns in self._periods_ns)
        return min(newest for newest, limit in zip(newest_ns, limits, strict=True) if newest >= limit)

    def _part(self, number: int, times_ns: npt.NDArray[np.int64]) -> tuple[npt.NDArray[Any], ...]:
        kept = list(self._kept[number])
        acquired_ns = np.array([each.acquired_ns for each in kept], np.int64)
        after = np.minimum(np.searchsorted(acquired_ns, times_ns), len(kept) - 1)
        before = np.maximum(after - 1, 0)
        is_nearer = times_ns - acquired_ns[before] <= acquired_ns[after] - times_ns
        nearest = np.where(is_nearer, before, after)
        off_ns = acquired_ns[nearest] - times_ns
        is_near = np.abs(off_ns) <= max(self._periods_ns[number], self._step_ns)
        physical = np.stack([each.physical for each in kept])[nearest]
        fresh = np.stack([each.fresh for each in kept])[nearest]
        return physical, fresh & is_near[:, np.newaxis], (off_ns / NS_PER_S)[:, np.newaxis]

    def __repr__(self) -> str:
        return f"<TimeWindow of {self.type_name}: {self.length} rows of {self._step_ns / NS_PER_S:g} s>"
