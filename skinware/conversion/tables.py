"""Read recordings as tables: arrays with a row for each sample of a service, a few rows at a time."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from importlib import import_module
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from skinware._columns import as_index
from skinware.errors import BadRecording, ConfigurationError, MissingExtra
from skinware.realtime import NS_PER_S
from skinware.recording.reading import Recording
from skinware.recording.tracks import Track
from skinware.structure import Structure
from skinware.tactile.regions import SensorChoice, unknown
from skinware.transfer.generation import PER_SENSOR, Generation

FRAMES, COLUMNS, PHYSICAL = "frames/", "columns/", "physical/"
"""Prefixes of array names: headers of samples, columns of the service, values in their unit."""

TIME = "frames/time_ns"
OF_FRAMES = {
    TIME: np.dtype("<i8"),
    "frames/generation": np.dtype("<u8"),
    "frames/sequence": np.dtype("<u8"),
    "frames/acquired_ns": np.dtype("<i8"),
    "frames/published_ns": np.dtype("<i8"),
    "frames/flags": np.dtype("<u8"),
}
"""``time_ns``: time of publication, ns since 1970, on the axis of the recording; the others as in a sample."""

Block = dict[str, npt.NDArray[Any]]
"""m rows of arrays, by name."""


def package(name: str, what: str, *, extra: str = "convert") -> Any:
    try:
        return import_module(name)
    except ImportError:
        raise MissingExtra.of(what, f"skinware[{extra}]") from None


def pyarrow() -> Any:
    """Return the package pyarrow with its module ``parquet``, or raise MissingExtra."""
    package("pyarrow.parquet", "Parquet")
    return package("pyarrow", "Parquet")


class ArrayFormat(NamedTuple):
    """The format of a row.

    Attributes:
        shape: () for one number.
    """

    shape: tuple[int, ...]
    dtype: np.dtype[Any]

    @property
    def row_bytes(self) -> int:
        return self.dtype.itemsize * math.prod(self.shape)


class Table(ABC):
    """The samples of one service as long as its columns and tables stayed the same.

    Args:
        name: of the table: the service's, with ``@2`` for its second part.
        generations: of its samples, by number; all have the same columns and tables.
    """

    def __init__(self, name: str, service: str, generations: Sequence[Generation]) -> None:
        self.name, self.service = name, service
        self.generations: tuple[Generation, ...] = tuple(generations)

    @abstractmethod
    def blocks(self, names: Collection[str]) -> Iterator[Block]:
        """Yield rows of some arrays, a few at a time; each call begins again with the first."""

    @property
    def origin(self) -> Generation:
        return self.generations[0]

    @property
    def structure(self) -> Structure | None:
        """The structure of a driver; None for other services."""
        return self.origin.context if isinstance(self.origin.context, Structure) else None

    @cached_property
    def arrays(self) -> dict[str, ArrayFormat]:
        formats = {name: ArrayFormat((), dtype) for name, dtype in OF_FRAMES.items()}
        for name, (shape, dtype, _) in self.origin.columns.items():
            formats[COLUMNS + name] = ArrayFormat(shape, dtype)
        return {name: each for name, each in formats.items() if each.row_bytes}

    @cached_property
    def sensor_names(self) -> list[str]:
        return [] if self.structure is None else sensor_names(self.structure)


def sensor_names(structure: Structure) -> list[str]:
    names = np.zeros(structure.n_sensors, object)
    for sensor_type in structure.types:
        names[structure.index(sensor_type.name)] = structure.sensor_names(sensor_type.name)
    return [str(name) for name in names]


class TableSource(Protocol):
    path: Path
    start_ns: int
    tables: Sequence[Table]

    @property
    def events(self) -> list[dict[str, Any]]:
        """Events of services, each with ``log_time_ns`` on the axis of the recording."""

    @property
    def clock(self) -> list[dict[str, Any]]:
        """Readings of the machine's clocks, each with ``log_time_ns``."""

    @property
    def problems(self) -> list[str]:
        """A line for each fault found in the file so far, and for each thing that no table has."""

    def close(self) -> None:
        """Close the file. Idempotent."""


@dataclass(frozen=True)
class Output:
    """An array to write: one of a table's, or computed from them.

    Attributes:
        needs: names of the table's arrays that it is computed from.
        of: computes it from a block of these.
    """

    name: str
    format: ArrayFormat
    unit: str
    needs: tuple[str, ...]
    of: Callable[[Block], npt.NDArray[Any]]


def outputs(table: Table) -> list[Output]:
    """Return all arrays of a table, and ``physical/TYPE``, values in its unit, for each sensor type."""
    found = [Output(name, each, _unit(table, name), (name,), itemgetter(name)) for name, each in table.arrays.items()]
    structure = table.structure
    if structure is not None:
        values = COLUMNS + "values"
        for sensor_type in structure.types:
            nothing = structure.physical(np.zeros((0, structure.n_sensors), structure.dtype), sensor_type.name)
            if nothing.shape[1]:
                each = ArrayFormat((nothing.shape[1],), nothing.dtype)
                physical = _physical(structure, sensor_type.name)
                found.append(Output(PHYSICAL + sensor_type.name, each, sensor_type.unit, (values,), physical))
    return found


def cannot_hold(format_name: str, table: Table, what: str) -> ConfigurationError:
    service = repr(table.service)
    return ConfigurationError(
        f"{format_name} cannot hold {what} of {service}: choose another format, or leave {service} out"
    )


def check_distinct(names: Sequence[str], format_name: str, table: Table) -> None:
    """Refuse arrays of a table that would have one name in a file."""
    for name, count in Counter(names).items():
        if count > 1:
            raise cannot_hold(format_name, table, f"two columns that are both {name!r} there")


def sensor_table(table: Table) -> dict[str, npt.NDArray[Any]]:
    """Return columns (n,) that describe the n sensors of a driver, in the order of its values.

    Unknown places are NaN; without any place these columns are left out.
    """
    structure = table.structure
    if structure is None:
        return {}
    row_of = {sensor_type.id: row for row, sensor_type in enumerate(structure.types)}
    rows = np.array([row_of[type_id] for type_id in structure.sensor_type.tolist()])
    columns: dict[str, npt.NDArray[Any]] = {"name": np.array(table.sensor_names)}
    for name in ("name", "unit", "scale", "offset", "minimum", "maximum"):
        of_types = np.array([getattr(sensor_type, name) for sensor_type in structure.types])
        columns["type" if name == "name" else name] = of_types[rows]
    module = structure.sensor_module.astype(np.int64)
    patch = structure.sensor_patch.astype(np.int64)
    columns |= {
        "uid": structure.sensor_uid,
        "module": np.array(structure.module_names)[module],
        "module_number": module,
        "patch": np.array(structure.patch_names)[patch],
        "patch_number": patch,
        "bus": np.array(structure.buses)[structure.patch_bus.astype(np.int64)][patch],
    }
    if structure.geometry is not None:
        geometry = structure.geometry
        columns["frame"] = geometry.frame.astype(str)
        for axis, letter in enumerate("xyz"):
            columns[f"{letter}_m"] = geometry.position_m[:, axis]
            columns[f"normal_{letter}"] = geometry.normal[:, axis]
        columns["radius_m"] = geometry.radius_m
    return columns


def _unit(table: Table, name: str) -> str:
    if name.startswith(FRAMES):
        return "ns" if name.endswith("_ns") else ""
    column = name.removeprefix(COLUMNS)
    return table.origin.schema.columns[column].unit or ("ns" if column.endswith("_ns") else "")


def _physical(structure: Structure, type_name: str) -> Callable[[Block], npt.NDArray[Any]]:
    return lambda block: structure.physical(block[COLUMNS + "values"], type_name)


@dataclass(frozen=True)
class Selection:
    """The services to convert, by name (empty: all), and their sensors; a choice leaves out services without any."""

    services: Collection[str] = ()
    sensors: SensorChoice = field(default_factory=SensorChoice)


class RecordedTable(Table):
    """A track, or some of its sensors, read as a table, whose samples its source counts."""

    def __init__(
        self, name: str, part: Track, source: RecordedSource, positions: npt.NDArray[np.int64] | None = None
    ) -> None:
        super().__init__(name, part.name, part.generations)
        self._part, self._source, self._index = part, source, None if positions is None else as_index(positions)
        if self._index is not None and positions is not None:
            names = self.sensor_names
            self.generations = tuple(generation.only(self._index) for generation in part.generations)
            self.sensor_names = [names[position] for position in positions.tolist()]

    def blocks(self, names: Collection[str]) -> Iterator[Block]:
        columns = [name.removeprefix(COLUMNS) for name in names if name.startswith(COLUMNS)]
        source = self._source
        source.frames[self.name] = 0
        for series in self._part.blocks(columns, start_s=source.start_s, end_s=source.end_s):
            if source.is_stopped():
                raise KeyboardInterrupt
            if len(series):
                source.frames[self.name] += len(series)
                block = {
                    "frames/time_ns": source.start_ns + np.rint(series.time_s * NS_PER_S).astype(np.int64),
                    "frames/generation": series.generation,
                    "frames/sequence": series.sequence,
                    "frames/acquired_ns": series.acquired_ns,
                    "frames/published_ns": series.published_ns,
                    "frames/flags": series.flags,
                    **{COLUMNS + name: series.column(name) for name in columns},
                }
                if self._index is not None:
                    block |= {
                        COLUMNS + name: block[COLUMNS + name][:, self._index] for name in PER_SENSOR if name in columns
                    }
                yield block


class RecordedSource:
    """A recording, or a part of it.

    Args:
        start_s, end_s: part of its time, s since it began; None: to its end.
        selection: the services and sensors to read; None: all.
        is_stopped: called now and then; True ends a pass over a table with :class:`KeyboardInterrupt`.

    Attributes:
        frames: samples in the last pass over each table, by its name.
    """

    def __init__(
        self,
        path: Path,
        start_s: float = 0.0,
        end_s: float | None = None,
        selection: Selection | None = None,
        is_stopped: Callable[[], bool] = lambda: False,
    ) -> None:
        self.path, self.start_s, self.end_s, self.is_stopped = path, start_s, end_s, is_stopped
        self.frames: Counter[str] = Counter()
        self._recording = Recording(path)
        self.start_ns: int = self._recording.start_ns
        try:
            self.tables: Sequence[Table] = self._chosen(selection or Selection())
        except BaseException:
            self.close()
            raise

    def _chosen(self, selection: Selection) -> list[Table]:
        whole = [table for name in self._recording.services for table in self._tables_of(self._recording[name])]
        if not whole:
            raise BadRecording(f"{self.path}: no frames in it that can be used")
        sensors = selection.sensors
        structures = [table.structure for table, _ in whole if table.structure is not None]
        services = unknown("service", selection.services, [table.service for table, _ in whole])
        for why in (*services, *sensors.unknown(structures)):
            raise ConfigurationError(f"{self.path}: {why}")
        chosen: list[Table] = []
        for table, part in whole:
            if selection.services and table.service not in selection.services:
                continue
            if not sensors:
                chosen.append(table)
            elif table.structure is not None:
                positions = np.flatnonzero(sensors.of(table.service, table.structure))
                chosen += [RecordedTable(table.name, part, self, positions)] if len(positions) else []
        if not chosen:
            raise ConfigurationError(f"{self.path}: no sensor in it is selected")
        self._left_out = {table.service for table, _ in whole} - {table.service for table in chosen}
        return chosen

    def _tables_of(self, track: Track) -> list[tuple[Table, Track]]:
        parts = track.parts
        if not parts:
            self._recording.note(f"samples of {track.name!r} left out: their description is lost")
        names = [track.name if not number else f"{track.name}@{number + 1}" for number in range(len(parts))]
        return [(RecordedTable(name, part, self), part) for name, part in zip(names, parts, strict=True)]

    @property
    def events(self) -> list[dict[str, Any]]:
        return [event for event in self._in_time(self._recording.events) if event.get("service") not in self._left_out]

    @property
    def clock(self) -> list[dict[str, Any]]:
        return self._in_time(self._recording.clock)

    @property
    def problems(self) -> list[str]:
        cut = [] if self._recording.is_whole else ["cut off or damaged: converted as far as it is whole"]
        wires = ["wires are left out: convert them to candump or pcapng"] * bool(self._recording.wires)
        return [f"{self.path}: {problem}" for problem in [*cut, *self._recording.problems, *wires]]

    def close(self) -> None:
        self._recording.close()

    def _in_time(self, readings: list[dict[str, Any]]) -> list[dict[str, Any]]:
        timed = []
        for each in readings:
            time_s = each.pop("time_s")
            if time_s >= self.start_s and (self.end_s is None or time_s < self.end_s):
                timed.append({**each, "log_time_ns": self.start_ns + round(time_s * NS_PER_S)})
        return timed
