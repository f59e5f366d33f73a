"""What was recorded, as tables: of each service arrays with a row for each frame, read in pieces."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from skinware.errors import ConfigurationError
from skinware.realtime import NS_PER_S
from skinware.structure import Structure
from skinware.transfer.generation import Generation

FRAMES, COLUMNS, PHYSICAL = "frames/", "columns/", "physical/"
"""What names of arrays begin with: of what every frame has, of columns of the service, of values in their unit."""

TIME = "frames/time_ns"
OF_FRAMES = {
    TIME: np.dtype("<i8"),
    "frames/generation": np.dtype("<u8"),
    "frames/sequence": np.dtype("<u8"),
    "frames/acquired_ns": np.dtype("<i8"),
    "frames/published_ns": np.dtype("<i8"),
    "frames/flags": np.dtype("<u8"),
}
"""``time_ns``: when it was published, ns since 1970, on the axis of the recording; the others as those of a frame."""

Block = dict[str, npt.NDArray[Any]]
"""m rows of some arrays, by name."""


class Span(NamedTuple):
    """A part of the time of a recording.

    Attributes:
        begin_ns, end_ns: on the axis of the recording; the end is not in it.
    """

    begin_ns: int
    end_ns: int

    @staticmethod
    def of(recording_begin_ns: int, start_s: float, end_s: float | None) -> Span:
        """From seconds since a recording began; None: to its end."""
        begin_ns = recording_begin_ns + round(start_s * NS_PER_S)
        return Span(begin_ns, 1 << 63 if end_s is None else recording_begin_ns + round(end_s * NS_PER_S))

    def has(self, time_ns: int) -> bool:
        return self.begin_ns <= time_ns < self.end_ns

    def rows_of(self, block: Block) -> Block:
        wanted = np.flatnonzero((block[TIME] >= self.begin_ns) & (block[TIME] < min(self.end_ns, (1 << 63) - 1)))
        rows = slice(int(wanted[0]), int(wanted[-1]) + 1) if len(wanted) else slice(0)
        return {name: array[rows] for name, array in block.items()}


class ArrayFormat(NamedTuple):
    """What a row of an array is.

    Attributes:
        shape: of a row; () where it is one number.
        dtype: of its numbers.
    """

    shape: tuple[int, ...]
    dtype: np.dtype[Any]

    @property
    def row_bytes(self) -> int:
        return self.dtype.itemsize * math.prod(self.shape)


class Table(ABC):
    """The frames of one service for as long as its columns and tables stayed the same.

    Args:
        name: of the table: that of the service; with ``@2`` if it is the second part of what was recorded of it.
        service: name of the service.
        generations: whose frames are in it, by number; with the same columns and tables.

    Attributes:
        name, service, generations: as given.
    """

    def __init__(self, name: str, service: str, generations: Sequence[Generation]) -> None:
        self.name, self.service = name, service
        self.generations: tuple[Generation, ...] = tuple(generations)

    @abstractmethod
    def blocks(self, names: Collection[str]) -> Iterator[Block]:
        """Some of the arrays, a few rows at a time; every pass gives the same.

        Raises:
            BadRecording: they cannot be read.
            OSError: likewise.
        """

    @property
    def origin(self) -> Generation:
        return self.generations[0]

    @property
    def structure(self) -> Structure | None:
        """Of a driver; None of other services."""
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


class Source(Protocol):
    """A file that is converted."""

    path: Path
    start_ns: int
    tables: Sequence[Table]

    @property
    def events(self) -> list[dict[str, Any]]:
        """What happened to services, each with ``log_time_ns``, on the axis of the recording."""

    @property
    def clock(self) -> list[dict[str, Any]]:
        """The clocks of the machine at the same moments, likewise."""

    @property
    def problems(self) -> list[str]:
        """What is wrong with the file, as far as it was read, and what of it is in no table; a line each."""

    def close(self) -> None:
        """Let go of the file. Idempotent."""


class DerivedSource:
    """A source whose tables are made of those of another; everything else is that one's.

    Args:
        source: the other one.
        tables: of this one.
    """

    def __init__(self, source: Source, tables: Sequence[Table]) -> None:
        self._source = source
        self.path: Path = source.path
        self.start_ns: int = source.start_ns
        self.tables: Sequence[Table] = tables

    @property
    def events(self) -> list[dict[str, Any]]:
        """See :class:`Source`."""
        return self._source.events

    @property
    def clock(self) -> list[dict[str, Any]]:
        return self._source.clock

    @property
    def problems(self) -> list[str]:
        return self._source.problems

    def close(self) -> None:
        self._source.close()


@dataclass(frozen=True)
class Output:
    """An array as it is written: one of the table's, or made of them.

    Attributes:
        name: of it.
        format: of a row.
        unit: of its numbers, for people.
        needs: names of the table's arrays that it is made of.
        of: makes it of a block of them.
    """

    name: str
    format: ArrayFormat
    unit: str
    needs: tuple[str, ...]
    of: Callable[[Block], npt.NDArray[Any]]


def outputs(table: Table) -> list[Output]:
    """All arrays of a table, and for each type of sensors ``physical/TYPE``: values in the type's unit."""
    found = [Output(name, each, _unit(table, name), (name,), _itself(name)) for name, each in table.arrays.items()]
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
    """Refuse arrays of a table that would have one name in a file.

    Raises:
        ConfigurationError: two are the same.
    """
    for name, count in Counter(names).items():
        if count > 1:
            raise cannot_hold(format_name, table, f"two columns that are both {name!r} there")


def sensor_table(table: Table) -> dict[str, npt.NDArray[Any]]:
    """Of each of the n sensors of a driver, in the order of its values, what people and programs want to know of it.

    Texts are numpy's; places are NaN where they are not known, and left out if nobody knows any.
    """
    structure = table.structure
    if structure is None:
        return {}
    row_of = {sensor_type.id: row for row, sensor_type in enumerate(structure.types)}
    rows = np.array([row_of[type_id] for type_id in structure.sensor_type.tolist()])
    told: dict[str, npt.NDArray[Any]] = {"name": np.array(table.sensor_names)}
    for field in ("name", "unit", "scale", "offset", "minimum", "maximum"):
        of_types = np.array([getattr(sensor_type, field) for sensor_type in structure.types])
        told["type" if field == "name" else field] = of_types[rows]
    module = structure.sensor_module.astype(np.int64)
    patch = structure.sensor_patch.astype(np.int64)
    told |= {
        "uid": structure.sensor_uid,
        "module": np.array(structure.module_names)[module],
        "module_number": module,
        "patch": np.array(structure.patch_names)[patch],
        "patch_number": patch,
        "bus": np.array(structure.buses)[structure.patch_bus.astype(np.int64)][patch],
    }
    if structure.geometry is not None:
        geometry = structure.geometry
        told["frame"] = geometry.frame.astype(str)
        for axis, letter in enumerate("xyz"):
            told[f"{letter}_m"] = geometry.position_m[:, axis]
            told[f"normal_{letter}"] = geometry.normal[:, axis]
        told["radius_m"] = geometry.radius_m
    return told


def _unit(table: Table, name: str) -> str:
    if name.startswith(FRAMES):
        return "ns" if name.endswith("_ns") else ""
    column = name.removeprefix(COLUMNS)
    told = table.origin.schema.columns[column].unit
    return told or ("ns" if column.endswith("_ns") else "")


def _itself(name: str) -> Callable[[Block], npt.NDArray[Any]]:
    return lambda block: block[name]


def _physical(structure: Structure, type_name: str) -> Callable[[Block], npt.NDArray[Any]]:
    return lambda block: structure.physical(block[COLUMNS + "values"], type_name)
