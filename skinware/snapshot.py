"""The newest snapshot of every driver, read as one skin."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from skinware.driver_snapshot import DriverSnapshot
from skinware.errors import ConfigurationError, StructureError
from skinware.realtime import NS_PER_S, now_ns
from skinware.skin_layout import SkinLayout
from skinware.text import nearest_name


@dataclass(frozen=True, eq=False)
class Snapshot:
    """The newest snapshot of every driver. Each snapshot is coherent; for the time between them, see ``spread_s``.

    Attributes:
        layout: which drivers; the same object as long as no driver joins, leaves or changes.
        samples: the snapshot of each driver of ``layout``.
    """

    layout: SkinLayout
    samples: tuple[DriverSnapshot, ...]

    def of(self, driver: str) -> DriverSnapshot:
        """Return the snapshot of one driver.

        Raises:
            StructureError: no such driver in this snapshot; the message lists those there are.
        """
        if driver not in self.layout.drivers:
            raise StructureError(f"no driver {driver!r} in this snapshot{nearest_name(driver, self.layout.drivers)}")
        return self.samples[self.layout.drivers.index(driver)]

    @property
    def acquired_ns(self) -> npt.NDArray[np.int64]:
        """(n_drivers,) int64: time of the newest data of each driver, CLOCK_MONOTONIC ns."""
        return np.array([frame.acquired_ns for frame in self.samples], np.int64)

    @property
    def spread_s(self) -> float:
        """Time between the newest data of the driver furthest ahead and that of the one furthest behind, s."""
        return float(np.ptp(self.acquired_ns)) / NS_PER_S

    # -- by type: the sensors of all drivers that have it, driver by driver ---------------------------------------

    def raw(self, type_name: str) -> npt.NDArray[Any]:
        """Return (n,) raw counts of all sensors of a type, of the narrowest dtype that holds those of every driver.

        Raises:
            StructureError: no driver has such sensors; the same for all that take a type.
        """
        return np.concatenate([frame.raw(type_name) for frame in self._samples_with(type_name)])

    def physical(self, type_name: str) -> npt.NDArray[np.floating[Any]]:
        """Return (n,) float32 values of all sensors of a type, in ``unit(type_name)``; float64 if raw values are int32.

        Raises:
            StructureError: also where drivers have different units; the message says how to choose.
        """
        self.layout.unit(type_name)
        return np.concatenate([frame.physical(type_name) for frame in self._samples_with(type_name)])

    def status_of(self, type_name: str) -> npt.NDArray[np.uint8]:
        """Return (n,) uint8 status of all sensors of a type, bits of :class:`skinware.Status`; see ``fresh``."""
        return np.concatenate([frame.status_of(type_name) for frame in self._samples_with(type_name)])

    def time_ns(self, type_name: str) -> npt.NDArray[np.int64]:
        """Return (n,) int64: time of each sensor's data, of its update group, CLOCK_MONOTONIC ns; 0: never seen."""
        return np.concatenate([frame.time_ns(type_name) for frame in self._samples_with(type_name)])

    def fresh(
        self, type_name: str, *, max_age_s: float | None = None, at_ns: int | None = None
    ) -> npt.NDArray[np.bool_]:
        """Return (n,) bool: which sensors of a type can be trusted now.

        Those have the status 0, their driver lived when its snapshot was taken, and their data is not too old.

        Args:
            type_name: which sensors.
            max_age_s: the age beyond which nothing is fresh. Default: for each driver three of its periods and at
                least 0.2 s; 1 s where it has no period.
            at_ns: the moment at which to look, CLOCK_MONOTONIC ns; default: now.
        """
        at_ns = now_ns() if at_ns is None else at_ns
        samples = self._samples_with(type_name)
        return np.concatenate([frame.fresh(type_name, max_age_s=max_age_s, at_ns=at_ns) for frame in samples])

    def unit(self, type_name: str) -> str:
        """Return unit of ``physical(type_name)``.

        Raises:
            StructureError: also where drivers have different units.
        """
        return self.layout.unit(type_name)

    def patch_of(self, type_name: str) -> npt.NDArray[np.int64]:
        """Return (n,) int64: index into ``layout.patches``, the names of patches, of every sensor of a type."""
        return self.layout.patch_of(type_name)

    def module_of(self, type_name: str) -> npt.NDArray[np.int64]:
        """Return (n,) int64: index into ``layout.modules``, the names of modules, of every sensor of a type."""
        return self.layout.module_of(type_name)

    def _samples_with(self, type_name: str) -> list[DriverSnapshot]:
        return [self.samples[driver] for driver, _ in self.layout.parts(type_name)]


class Window:
    """The last snapshots of one sensor type, for filters and other computations that need past values.

    Add snapshots of one driver (``in_order`` returns every one) or of a skin::

        window = Window("pressure", 100)
        for frame in reader.in_order():
            window.add(frame)
            slow = window.physical.mean(axis=0)

    Args:
        type_name: which sensors.
        length: how many snapshots to keep, N.

    Raises:
        ConfigurationError: a length below 1.
    """

    def __init__(self, type_name: str, length: int) -> None:
        if length < 1:
            raise ConfigurationError(f"a window of {length} samples: give at least 1")
        self.type_name = type_name
        self.length = length
        self._of: object = None
        self._added = 0
        self._time_ns = np.zeros(length, np.int64)
        self._physical: npt.NDArray[Any] = np.zeros((length, 0), np.float32)
        self._fresh = np.zeros((length, 0), bool)

    def add(self, frame: DriverSnapshot | Snapshot) -> None:
        """Take a snapshot in; the oldest gives way.

        A snapshot of another structure or layout empties the window first: its sensors are others.

        Raises:
            StructureError: it has no sensors of the type, or has them in different units.
        """
        physical, fresh = frame.physical(self.type_name), frame.fresh(self.type_name)
        of = frame.layout if isinstance(frame, Snapshot) else frame.structure
        if of is not self._of:
            self._of, self._added = of, 0
            self._physical = np.zeros((self.length, len(physical)), physical.dtype)
            self._fresh = np.zeros(self._physical.shape, bool)
        row = self._added % self.length
        self._time_ns[row] = np.max(frame.acquired_ns)
        self._physical[row], self._fresh[row] = physical, fresh
        self._added += 1

    def __len__(self) -> int:
        """Snapshots in it: N as soon as so many were added."""
        return min(self._added, self.length)

    @property
    def physical(self) -> npt.NDArray[np.floating[Any]]:
        """(len, n) physical values, the oldest snapshot first; a copy."""
        return self._in_order(self._physical)

    @property
    def fresh(self) -> npt.NDArray[np.bool_]:
        """(len, n) bool: which could be trusted when their snapshot was added; a copy."""
        return self._in_order(self._fresh)

    @property
    def time_ns(self) -> npt.NDArray[np.int64]:
        """(len,) int64: time of the newest data of each snapshot, CLOCK_MONOTONIC ns; a copy."""
        return self._in_order(self._time_ns)

    def _in_order(self, rows: npt.NDArray[Any]) -> npt.NDArray[Any]:
        if self._added <= self.length:
            return rows[: self._added].copy()
        return np.roll(rows, -(self._added % self.length), axis=0)

    def __repr__(self) -> str:
        return f"<Window of {self.type_name}: {len(self)} of {self.length} samples>"
