"""One snapshot of a driver: its columns, and what of them belongs to the sensors of a type."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import numpy.typing as npt

from skinware.memory.ring import Sample
from skinware.memory.statistics import BUCKETS
from skinware.realtime import NS_PER_S, now_ns
from skinware.status import SAMPLE, SAMPLES, DataPath, is_fresh
from skinware.structure import Structure


class DriverSnapshot(Sample):
    """One snapshot of a skin. Arrays of a copy may be kept and changed; those of a view are read-only.

    All arrays are coherent: they were published together. Properties are whole columns of the
    snapshot; methods take a sensor type and return the part of its sensors, as those of a skin's snapshot do.
    """

    __slots__ = ()

    @property
    def structure(self) -> Structure:
        """The structure that this snapshot belongs to."""
        return cast(Structure, self.context)

    @property
    def values(self) -> npt.NDArray[Any]:
        """(n_sensors,) of the structure's dtype, raw counts as the hardware sent them."""
        return self.column("values")

    @property
    def status(self) -> npt.NDArray[np.uint8]:
        """(n_sensors,) uint8, bits of :class:`skinware.status.Status`; 0 = good as of the snapshot (see ``fresh``)."""
        return self.column("status")

    @property
    def module_time_ns(self) -> npt.NDArray[np.int64]:
        """(n_modules,) int64, CLOCK_MONOTONIC ns of the oldest data shown for each module; 0 = some never seen."""
        return self.column("module_time_ns")

    @property
    def group_time_ns(self) -> npt.NDArray[np.int64]:
        """(n_groups,) int64, CLOCK_MONOTONIC ns of the oldest data shown for each update group; 0 = never seen."""
        return self.column("group_time_ns" if "group_time_ns" in self._columns else "module_time_ns")

    @property
    def sensor_time_ns(self) -> npt.NDArray[np.int64]:
        """(n_sensors,) int64: ``group_time_ns`` of the update group of each sensor."""
        return self.group_time_ns[self.structure.sensor_group]

    @property
    def module_untouched(self) -> npt.NDArray[np.bool_]:
        """(n_modules,) bool: modules that have sent nothing but 0 so far: not touched yet, or dead.

        Their values are fresh all the same. All False where the driver does not look for that.
        """
        return self._optional("module_untouched", (self.structure.n_modules,), np.uint8).astype(bool)

    @property
    def patch_state(self) -> npt.NDArray[np.uint8]:
        """(n_patches,) uint8, :class:`skinware.status.PatchState`."""
        return self.column("patch_state")

    @property
    def bus_state(self) -> npt.NDArray[np.uint8]:
        """(n_buses,) uint8, :class:`skinware.status.BusState`."""
        return self.column("bus_state")

    @property
    def bus_reason(self) -> npt.NDArray[np.uint8]:
        """(n_buses,) uint8, :class:`skinware.status.BusReason`; 0 where the driver does not publish it."""
        return self._optional("bus_reason", (len(self.structure.buses),), np.uint8)

    @property
    def bus_since_ns(self) -> npt.NDArray[np.int64]:
        """(n_buses,) int64, CLOCK_MONOTONIC ns since when each bus has had its state and reason; 0: not known."""
        return self._optional("bus_since_ns", (len(self.structure.buses),), np.int64)

    @property
    def bus_load(self) -> npt.NDArray[np.uint16]:
        """(n_buses,) uint16, share of the bus' time in use over the last second, in thousandths, at least 1.

        0: not known; 0xFFFF: not known because of the bus' filters.
        """
        return self._optional("bus_load", (len(self.structure.buses),), np.uint16)

    @property
    def bus_samples(self) -> npt.NDArray[np.void]:
        """(n_buses, SAMPLES) of :data:`skinware.status.SAMPLE`: frames that were not used, the newest few of a kind.

        Places are empty where there are none.
        """
        n_buses = len(self.structure.buses)
        return self._optional("bus_samples", (n_buses, SAMPLES * SAMPLE.itemsize), np.uint8).view(SAMPLE)

    @property
    def patch_interval_counts(self) -> npt.NDArray[np.uint64]:
        """(n_patches, BUCKETS) uint64: histogram of the time between two updates of a module, for every patch.

        The buckets are those of :class:`skinware.memory.statistics.Histogram`; all 0: not published.
        """
        return self._optional("patch_interval_counts", (self.structure.n_patches, BUCKETS), np.uint64)

    @property
    def patch_age_counts(self) -> npt.NDArray[np.uint64]:
        """(n_patches, BUCKETS) uint64: histogram of the age of a module's update when it was published."""
        return self._optional("patch_age_counts", (self.structure.n_patches, BUCKETS), np.uint64)

    @property
    def why(self) -> npt.NDArray[np.uint8]:
        """(n_sensors,) uint8: a :class:`skinware.status.Why` for each; 0 for a driver that is not calmed."""
        return self._optional("why", (self.structure.n_sensors,), np.uint8)

    @property
    def latency_ns(self) -> int:
        """The longest that frames on a bus wait so that more are taken with them, ns; 0: not at all, or not known."""
        return int(self._optional("latency_ns", (1,), np.int64)[0])

    @property
    def data_path(self) -> DataPath:
        """The code that receives the driver's frames; ``MIXED`` where buses differ, see ``bus_data_path``."""
        of_buses = set(self.bus_data_path.tolist()) - {int(DataPath.NOT_TOLD)}
        if not of_buses:
            return DataPath(int(self._optional("data_path", (1,), np.uint8)[0]))
        return DataPath(of_buses.pop()) if len(of_buses) == 1 else DataPath.MIXED

    @property
    def bus_data_path(self) -> npt.NDArray[np.uint8]:
        """(n_buses,) uint8, :class:`skinware.status.DataPath`: what reads each bus; 0 where it is not known."""
        return self._optional("bus_data_path", (len(self.structure.buses),), np.uint8)

    def _optional(self, name: str, shape: tuple[int, ...], dtype: npt.DTypeLike) -> npt.NDArray[Any]:
        return self.column(name).reshape(shape) if name in self._columns else np.zeros(shape, dtype)

    # -- by type ------------------------------------------------------------------------------------------------

    def raw(self, type_name: str) -> npt.NDArray[Any]:
        """Return (n,) of the structure's dtype: raw counts of a type's sensors, in the order of ``structure.index``.

        Raises:
            StructureError: no such type here; the same for all that take a type.
        """
        return self.values[self.structure.span(type_name)]

    def physical(self, type_name: str) -> npt.NDArray[np.floating[Any]]:
        """Return (n,) float32: values of all sensors of a type, in its unit; float64 where raw values are int32."""
        return self.structure.physical(self.values, type_name)

    def physical_values(self) -> npt.NDArray[np.float32]:
        """Return (n_sensors,) float32: values of all sensors, each in the unit of its type."""
        return self.structure.physical_values(self.values).astype(np.float32, copy=False)

    def status_of(self, type_name: str) -> npt.NDArray[np.uint8]:
        """Return (n,) uint8: status of all sensors of a type."""
        return self.status[self.structure.span(type_name)]

    def time_ns(self, type_name: str) -> npt.NDArray[np.int64]:
        """Return (n,) int64: ``group_time_ns`` of the update group of each sensor of a type."""
        structure = self.structure
        return self.group_time_ns[structure.sensor_group[structure.span(type_name)]]

    def fresh(
        self, type_name: str, *, max_age_s: float | None = None, at_ns: int | None = None
    ) -> npt.NDArray[np.bool_]:
        """Return (n,) bool: which sensors of a type can be trusted now.

        Those have the status 0, their driver lived when the snapshot was taken, and their data is not too old.

        Args:
            type_name: which sensors.
            max_age_s: the age beyond which nothing is fresh. Default: three periods of each sensor (of its update
                group, or else of the driver) and at least 0.2 s; 1 s where there is no period.
            at_ns: the moment at which to look, CLOCK_MONOTONIC ns; default: now.
        """
        limits_ns = self.structure.age_limits_ns(self.period_ns)
        return is_fresh(
            self.status_of(type_name),
            self.time_ns(type_name),
            at_ns=now_ns() if at_ns is None else at_ns,
            max_age_ns=(
                limits_ns[self.structure.span(type_name)] if max_age_s is None else round(max_age_s * NS_PER_S)
            ),
            alive=not self.stale,
        )
