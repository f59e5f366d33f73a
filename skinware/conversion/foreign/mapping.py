"""Say which columns of foreign data are which taxels: a file in TOML, and the structure that it makes.

::

    format = "skinware-columns"
    version = 1

    [[driver]]
    name = "hand"
    time = "time_s"              # without it, rows come at rate_hz
    time_unit = "s"              # s, ms, us, ns
    rate_hz = 100

    [[driver.module]]
    patch = "index"
    module = "tip"
    type = "pressure"
    unit = "counts"
    columns = ["taxel_{0..11}"]  # or an array: ["forces[:, 2]"]
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import msgspec
import numpy as np
import numpy.typing as npt

from skinware.conversion.foreign.source import ColumnSource, whole
from skinware.errors import ConfigurationError, StructureError
from skinware.geometry import Geometry, Triple
from skinware.sensor_types import CATALOGUE, SensorType
from skinware.structure import Structure
from skinware.text import nearest_name
from skinware.toml_text import TomlText

FORMAT, VERSION = "skinware-columns", 1
UNITS_NS = {"s": 1e9, "ms": 1e6, "us": 1e3, "ns": 1.0}
_MOST_PLACES = 1 << 20
_LENGTHS_M = {"m": 1.0, "cm": 0.01, "mm": 0.001}
_RANGE = re.compile(r"\{(\d+)\.\.(\d+)\}")
_INDEX = re.compile(r"(.+)\[([-\d:, ]+)\]")


class ModuleMap(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Taxels of one type in a module.

    Attributes:
        columns: of the table: ``name``, ``name_{0..11}`` for twelve of them, ``name[:, 2]`` for a part of an array.
        taxels: number of each in the module; empty: 0, 1, 2 ...
        kind: of the module; ``4x6`` makes it a matrix of so many rows and columns.
        positions: three columns with x, y and z of each taxel, or one with all three; their first row counts.
        position_m: the places themselves instead.
    """

    patch: str
    columns: tuple[str, ...]
    module: str = ""
    type: str = "pressure"
    unit: str | None = None
    scale: float = 1.0
    offset: float = 0.0
    minimum: float = -np.inf
    maximum: float = np.inf
    taxels: tuple[Annotated[int, msgspec.Meta(ge=0, lt=1 << 16)], ...] = ()
    kind: str = ""
    positions: tuple[str, ...] = ()
    position_unit: Literal["m", "cm", "mm"] = "m"
    position_m: tuple[Triple, ...] = ()
    frame: str = ""


class DriverMap(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A table that becomes a driver.

    Attributes:
        table: its name, where a source has several; empty: the first with that time.
        time: the column of the time of each row; empty: rows come at ``rate_hz``.
        rate_hz: nominal rows a second; 0: not known.
    """

    name: str
    module: Annotated[tuple[ModuleMap, ...], msgspec.Meta(min_length=1)]
    table: str = ""
    time: str = ""
    time_unit: Literal["s", "ms", "us", "ns"] = "s"
    rate_hz: Annotated[float, msgspec.Meta(ge=0, le=100_000)] = 0.0
    dtype: Literal["uint8", "int16", "uint16", "int32", "float32"] = "float32"


class _MapFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    format: str
    version: int
    driver: Annotated[tuple[DriverMap, ...], msgspec.Meta(min_length=1)]


class Pick(NamedTuple):
    column: str
    numbers: npt.NDArray[np.int64]


class MappedDriver(NamedTuple):
    """A driver of a map, held against its source.

    Attributes:
        picks: the numbers of a row that are its values.
    """

    map: DriverMap
    structure: Structure
    picks: tuple[Pick, ...]


def read_map(path: Path, source: ColumnSource) -> list[MappedDriver]:
    text = TomlText(path)
    drivers = text.of_format("map of columns", FORMAT, VERSION, _MapFile).driver
    return [_mapped(each, source, text, number) for number, each in enumerate(drivers)]


def _mapped(driver: DriverMap, source: ColumnSource, text: TomlText, number: int) -> MappedDriver:
    def refuse(what: str, *keys: str | int) -> ConfigurationError:
        return ConfigurationError(f"{text.place(('driver', number, *keys))}: {what}")

    if not driver.table and driver.time:
        having = (name for name, columns in source.tables.items() if driver.time in columns)
        driver = msgspec.structs.replace(driver, table=next(having, ""))
    if driver.table not in source.tables:
        hint = nearest_name(driver.table, source.tables)
        raise refuse(f"{source.path} has no table {driver.table!r}{hint}", "table")
    columns = source.tables[driver.table]
    if driver.time and columns.get(driver.time) not in ((), (1,)):
        raise refuse(_no_column(driver.time, source, driver.table), "time")
    if not driver.time and not driver.rate_hz:
        raise refuse("neither time nor rate_hz: when was a row?")
    picks: list[list[Pick]] = []
    for place, module in enumerate(driver.module):
        try:
            picks.append([pick for name in module.columns for pick in _picks(name, columns)])
        except KeyError as error:
            raise refuse(_no_column(error.args[0], source, driver.table), "module", place, "columns") from None
        except (IndexError, ValueError) as error:
            raise refuse(str(error), "module", place, "columns") from None
    try:
        return MappedDriver(driver, _structure(driver, picks, source), tuple(pick for each in picks for pick in each))
    except StructureError as error:
        raise refuse(str(error)) from None


def _no_column(name: str, source: ColumnSource, table: str) -> str:
    why = source.left_out.get(name)
    hint = f": {why}" if why else nearest_name(name, source.tables[table])
    return f"no column of numbers {name!r} in {source.path}{hint}"


def _picks(text: str, columns: Mapping[str, tuple[int, ...]]) -> Iterator[Pick]:
    """Yield the numbers that an entry of ``columns`` means, or raise KeyError, IndexError or ValueError."""
    ranges = [(first, int(last)) for first, last in _RANGE.findall(text)]
    pattern = _RANGE.sub("\0", text)
    for numbers in product(*(range(int(first), last + 1) for first, last in ranges)):
        name = pattern
        for value, (first, _) in zip(numbers, ranges, strict=True):
            name = name.replace("\0", f"{value:0{len(first)}d}", 1)
        part = None if name in columns else _INDEX.fullmatch(name)
        column = part[1] if part else name
        shape = columns[column]
        every = np.arange(int(np.prod(shape, dtype=np.int64))).reshape(shape)
        yield Pick(column, np.ravel(every[tuple(_place(each) for each in part[2].split(","))] if part else every))


def _place(text: str) -> int | slice:
    bounds = [int(bound) if bound.strip() else None for bound in text.split(":")]
    return bounds[0] if len(bounds) == 1 and bounds[0] is not None else slice(*bounds)


def _structure(driver: DriverMap, picks: list[list[Pick]], source: ColumnSource) -> Structure:
    types: dict[str, SensorType] = {}
    modules = list(dict.fromkeys((each.patch, each.module) for each in driver.module))
    patches = list(dict.fromkeys(patch for patch, _ in modules))
    kinds = {(each.patch, each.module): each.kind.encode() for each in driver.module if each.kind}
    uids, type_ids, of_module, positions, frames, names = [], [], [], [], [], []
    for each, chosen in zip(driver.module, picks, strict=True):
        made = _type(each)
        if types.setdefault(each.type, made) != made:
            raise StructureError(f"{each.type} has two units or ranges: make two drivers, or two types, of it")
        count, module = sum(len(pick.numbers) for pick in chosen), modules.index((each.patch, each.module))
        if each.taxels and len(each.taxels) != count:
            raise StructureError(f"{len(each.taxels)} taxels for the {count} numbers of {', '.join(each.columns)}")
        uids += [module << 16 | taxel for taxel in each.taxels or range(count)]
        type_ids += [made.id] * count
        of_module += [module] * count
        names += [each.type] * count
        places = _positions(each, driver.table, source, count)
        positions.append(places)
        frames += [(each.frame or source.frames.get(driver.table, "")) * bool(np.isfinite(places).all())] * count
    known, uid = np.concatenate(positions), np.array(uids, np.uint64)
    geometry = replace(Geometry.unknown(names, uid), frame=np.array(frames, object), position_m=known)
    return Structure(
        types=types.values(),
        buses=[source.path.name],
        patch_name=[patch.encode() for patch in patches],
        patch_bus=[0] * len(patches),
        module_patch=[patches.index(patch) for patch, _ in modules],
        module_kind=[kinds.get(module, b"") for module in modules],
        module_name=[name.encode() for _, name in modules],
        sensor_uid=uid,
        sensor_type=type_ids,
        sensor_module=of_module,
        dtype=driver.dtype,
        geometry=geometry if np.isfinite(known).any() else None,
    )


def _type(each: ModuleMap) -> SensorType:
    known = CATALOGUE.get(each.type)
    if known is None:
        raise StructureError(f"no sensor type {each.type!r}{nearest_name(each.type, CATALOGUE)}")
    return known.measured(
        unit=each.unit, scale=each.scale, offset=each.offset, minimum=each.minimum, maximum=each.maximum
    )


def _positions(each: ModuleMap, table: str, source: ColumnSource, count: int) -> npt.NDArray[np.float64]:
    """Return (count, 3), m; NaN where the map has no places."""
    if not each.positions:
        found = np.array(each.position_m or [(np.nan,) * 3] * count, np.float64).reshape(-1, 3)
    else:
        axes = [_place_column(source, table, name) for name in each.positions]
        found = (
            axes[0].reshape(-1, 3)
            if len(axes) == 1 and not axes[0].size % 3
            else np.stack([axis.ravel() for axis in axes], axis=-1)
        ) * _LENGTHS_M[each.position_unit]
    if found.shape != (count, 3):
        raise StructureError(f"{len(found)} places for the {count} taxels of {', '.join(each.columns)}")
    return found


def _place_column(source: ColumnSource, table: str, name: str) -> npt.NDArray[np.float64]:
    """Return the first row of a column of the table, or the whole of one of another table."""
    if name in source.tables[table]:
        return whole(source, table, [name], 1)[name][:1].astype(np.float64)
    for other, columns in source.tables.items():
        if name in columns:
            return whole(source, other, [name], _MOST_PLACES)[name].astype(np.float64)
    raise StructureError(_no_column(name, source, table))
