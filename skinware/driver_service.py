"""A driver's end and a user's end of one skin: a service whose snapshots are sensor values, with their structure.

Columns of a snapshot: ``values``, ``status``, ``module_time_ns``, ``module_untouched``, ``patch_state``, ``bus_state``,
``bus_reason``, ``bus_since_ns``, ``bus_load``, ``bus_samples``, ``bus_counters``, ``patch_counters``,
``patch_interval_counts``, ``patch_age_counts``, ``latency_ns``, ``data_path``, ``bus_data_path``; and
``group_time_ns`` where a module has several update groups.
Static columns: the structure's tables, ``driver_type`` and the names of the counters.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from skinware.driver_snapshot import DriverSnapshot
from skinware.errors import BadServiceFile, StructureError
from skinware.memory import segments
from skinware.memory.namespace import Namespace
from skinware.memory.statistics import BUCKETS
from skinware.realtime import NS_PER_S
from skinware.service import Schema, ServiceReader, Writer
from skinware.status import SAMPLE, SAMPLES
from skinware.structure import Structure

KIND = "driver"
_REQUIRED = ("values", "status", "module_time_ns", "patch_state", "bus_state")


class DriverWriter(Writer):
    """Publish a skin: its structure and its snapshots.

    Args:
        name: name of the driver in the namespace.
        structure: what the skin is made of.
        driver_type: name of the driver's class (``roboskin``), for people.
        bus_counters: names of the counters that every bus has.
        patch_counters: names of the counters that every patch has.
        sensor_columns: more columns with an entry per sensor: their dtypes by name.
        namespace, slots, rate_hz, group, operations: as for :class:`skinware.service.ServiceWriter`, which also lists
            the errors.
    """

    def __init__(
        self,
        name: str,
        structure: Structure,
        *,
        driver_type: str = "",
        bus_counters: Sequence[str] = (),
        patch_counters: Sequence[str] = (),
        sensor_columns: Mapping[str, npt.DTypeLike] | None = None,
        namespace: Namespace | str | None = None,
        slots: int | None = None,
        rate_hz: float | None = None,
        group: str | None = None,
        operations: Mapping[str, Callable[..., object]] | None = None,
    ) -> None:
        self.structure: Structure = structure
        self._names = (driver_type, tuple(bus_counters), tuple(patch_counters))
        self._sensor_columns = dict(sensor_columns or {})
        super().__init__(
            name,
            namespace,
            schema=self._schema_of(structure),
            static=self._tables_of(structure),
            kind=KIND,
            slots=slots,
            period_ns=round(NS_PER_S / rate_hz) if rate_hz else 0,
            group=group,
            operations=operations or {},
            published_before=None,
        )

    def restructure(self, structure: Structure, *, rate_hz: float | None = None) -> None:
        """Go on with other sensors or another dtype, as a new generation; readers notice it.

        Args:
            structure: the new one. With an equal one readers go over without noticing.
            rate_hz: the nominal rate from now on, if it is another.

        Raises:
            NamespaceError: shared memory is full; the old generation then goes on.
        """
        self._succeed(self._schema_of(structure), self._tables_of(structure), rate_hz)
        self.structure = structure

    def _schema_of(self, structure: Structure) -> Schema:
        _, bus_counters, patch_counters = self._names
        columns = _frame_columns(structure, len(bus_counters), len(patch_counters))
        return Schema.of(columns | {name: (of, structure.n_sensors) for name, of in self._sensor_columns.items()}, "")

    def _tables_of(self, structure: Structure) -> dict[str, npt.NDArray[Any]]:
        driver_type, bus_counters, patch_counters = self._names
        return {
            **structure.to_columns(),
            "driver_type": np.array([driver_type.encode()], "S32"),
            "bus_counter_name": np.array([name.encode() for name in bus_counters], "S24"),
            "patch_counter_name": np.array([name.encode() for name in patch_counters], "S24"),
        }


class DriverReader(ServiceReader[DriverSnapshot]):
    """Reads one driver: a :class:`skinware.service.ServiceReader` that also knows the skin's structure.

    Raises:
        BadServiceFile: the service is not a driver, or its tables contradict each other.
    """

    frame_class = DriverSnapshot
    _tables: tuple[int, Mapping[str, npt.NDArray[Any]]] = 0, {}  # static columns of a generation

    @property
    def structure(self) -> Structure:
        """The structure of the generation that is being read."""
        return cast(Structure, self._ring.context)

    @property
    def driver_type(self) -> str:
        """Name of the driver's class; empty if the driver does not publish it."""
        return "".join(_names(self.static(), "driver_type")[:1])

    def bus_counters(self, frame: DriverSnapshot) -> list[dict[str, int]]:
        """Return the counters of every bus in a snapshot, by name."""
        return self._counters(frame, "bus", len(self.structure.buses))

    def patch_counters(self, frame: DriverSnapshot) -> list[dict[str, int]]:
        """Return the counters of every patch in a snapshot, by name."""
        return self._counters(frame, "patch", self.structure.n_patches)

    def _counters(self, frame: DriverSnapshot, what: str, count: int) -> list[dict[str, int]]:
        if self._tables[0] != self.generation:
            self._tables = self.generation, self.static()
        names, counts = counters_of(frame, self._tables[1], what, count)
        return [dict(zip(names, row, strict=True)) for row in counts.tolist()]

    def _describe(self, attached: segments.Segment) -> Structure:
        if bytes(attached.header["kind"]) != KIND.encode():
            raise BadServiceFile(f"service {self.name!r} is not a driver: it has no sensors")
        return structure_of(attached)


def recorded_head(name: str, structure: Structure, *, driver_type: str, period_ns: int) -> bytes:
    """Return the head of a driver's generation that no driver made, with the columns that every driver has.

    Args:
        period_ns: nominal time between two snapshots; 0: none.

    Raises:
        ConfigurationError: the format cannot hold the structure.
    """
    columns = {column: of for column, of in _frame_columns(structure, 0, 0).items() if column in _REQUIRED}
    static = {**structure.to_columns(), "driver_type": np.array([driver_type.encode()], "S32")}
    return segments.head_of(name, Schema.of(columns, ""), static, kind=KIND, period_ns=period_ns)


def counters_of(
    frame: DriverSnapshot, tables: Mapping[str, npt.NDArray[Any]], what: str, count: int
) -> tuple[list[str], npt.NDArray[np.uint64]]:
    """Return names and (count, names) numbers of the counters of each ``bus`` or ``patch``, if there are any."""
    names = _names(tables, f"{what}_counter_name")
    try:
        return names, frame.column(f"{what}_counters").reshape(count, len(names))
    except KeyError:
        return [], np.zeros((count, 0), np.uint64)


def structure_of(segment: segments.Segment) -> Structure:
    """Return the structure of a generation of a driver.

    Raises:
        BadServiceFile: its tables contradict each other or its columns.
    """
    columns = {column.name: column for column in segment.layout.slot}
    tables = segment.static_columns()
    try:
        structure = Structure.from_columns(tables, columns["values"].dtype)
        _names(tables, "driver_type")
        counters = [len(_names(tables, f"{what}_counter_name")) for what in ("bus", "patch")]
        expected = {"group_time_ns": ("<i8", structure.n_groups), **_frame_columns(structure, *counters)}
        for name, (dtype, count) in expected.items():
            is_required = name in _REQUIRED or (name == "group_time_ns" and not structure.groups_are_modules)
            if name not in columns and not is_required:
                continue
            column = columns[name]
            if column.count != count or column.dtype != dtype:
                found = f"{column.count} {name} of {column.dtype}"
                raise StructureError(f"{found} where the structure has {count} of {np.dtype(dtype)}")
    except (ValueError, TypeError, LookupError, OverflowError) as error:  # StructureError is a ValueError
        raise BadServiceFile(f"{segment.path}: {error}; not attached") from None
    return structure


def _frame_columns(
    structure: Structure, n_bus_counters: int, n_patch_counters: int
) -> dict[str, tuple[npt.DTypeLike, int]]:
    n_buses, n_patches = len(structure.buses), structure.n_patches
    return {
        "values": (structure.dtype, structure.n_sensors),
        "status": ("u1", structure.n_sensors),
        "module_time_ns": ("<i8", structure.n_modules),
        **({} if structure.groups_are_modules else {"group_time_ns": ("<i8", structure.n_groups)}),
        "module_untouched": ("u1", structure.n_modules),
        "patch_state": ("u1", n_patches),
        "bus_state": ("u1", n_buses),
        "bus_reason": ("u1", n_buses),
        "bus_since_ns": ("<i8", n_buses),
        "bus_load": ("<u2", n_buses),
        "bus_samples": ("u1", n_buses * SAMPLES * SAMPLE.itemsize),
        "bus_counters": ("<u8", n_buses * n_bus_counters),
        "patch_counters": ("<u8", n_patches * n_patch_counters),
        "patch_interval_counts": ("<u8", n_patches * BUCKETS),
        "patch_age_counts": ("<u8", n_patches * BUCKETS),
        "latency_ns": ("<i8", 1),
        "data_path": ("u1", 1),
        "bus_data_path": ("u1", n_buses),
    }


def _names(tables: Mapping[str, npt.NDArray[Any]], table: str) -> list[str]:
    return [bytes(text).decode() for text in tables.get(table, ())]
