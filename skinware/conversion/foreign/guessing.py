"""Guess a map for foreign data from names, shapes and first rows, with a comment for each guess."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import msgspec
import numpy as np
import numpy.typing as npt

from skinware.conversion.foreign.mapping import FORMAT, UNITS_NS, VERSION, ModuleMap
from skinware.conversion.foreign.source import DUMP, ColumnSource, Rows, first_rows
from skinware.errors import ConfigurationError
from skinware.realtime import NS_PER_S

_TIMES = re.compile(
    r"(.*[_.\s])?(time|t|timestamp|stamp|unix|date|datetime|zeit|tempo|temps|tiempo)([_.\s(\[]*(s|sec|seconds|ms|us|ns|nsec)[)\]]?)?",
    re.I,
)
_UNIT_OF_TIME = re.compile(r"[_.\s(\[](ms|us|ns|nsec|s|sec|seconds)[)\]]?$", re.I)
_NO_TAXELS = re.compile(
    r"index|sequence|^seq$|counter|^count|joint|encoder|motor|action|state|velocit|effort|torque|orient|quat|pose"
    r"|covariance|height|width|step|layout|offset|label|episode|frame|rgb|depth|image_raw|slip|(^|[._])id$|^column_0$",
    re.I,
)
_TOUCH = re.compile(r"tact|taxel|touch|skin|press", re.I)
_TAXELS = re.compile(r"biotac|tact|taxel|touch|skin|press|force|shear|sens|temp|acc|gyro|mag|prox|hall|fsr", re.I)
_TYPES = {
    r"temp": ("temperature", ""),
    r"acc": ("acceleration_{}", ""),
    r"gyro|angular": ("angular_rate_{}", ""),
    r"mag|hall": ("magnetic_field_{}", ""),
    r"prox": ("proximity", ""),
    r"shear": ("shear_{}", "xy"),
    r"force|wrench": ("force_{}", ""),
}
_PLACES = re.compile(r"posit|place|coord|xyz|points", re.I)
_UNITS = re.compile(r"[_.\s(\[](kpa|mpa|pa|mn|n|mt|ut|gauss|degc|g|mm|v|mv)[)\]]?$", re.I)
_UNIT_NAMES = {"kpa": "kPa", "mpa": "MPa", "pa": "Pa", "mn": "mN", "n": "N", "mt": "mT", "ut": "uT", "degc": "degC"}
_AXIS = re.compile(r"(^|[_.\s])([xyz])(?=$|[_.\s\d])|(?<=[a-z])([XYZ])$")
_NUMBER = re.compile(r"\d+")
_SHOWN = 60
"""Characters of a reason in a message."""
_WHOLE = 1 << 31
_MANY = 4
"""Columns whose names differ in numbers and axes alone: so many are taxels, whatever they are called."""
_GENERIC = ("", "taxel", "taxels", "sensor", "s", "t", "value", "values", "data", "column", "tactile")


class _Guess(NamedTuple):
    map: ModuleMap
    taxels: int
    why: str


def guess(source: ColumnSource) -> str:
    """Return the text of a map.

    Raises:
        ConfigurationError: nothing in the source looks like taxels.
        OSError: it cannot be read.
    """
    tables = {table: first_rows(source, table) for table in source.tables}
    times = {table: _time_of(rows, source) for table, rows in tables.items()}
    if len(tables) > 1 and any(times.values()):  # arrays of other lengths are places and the like
        chosen = [table for table in tables if times[table]]
    else:
        chosen = sorted(tables, key=lambda table: -len(next(iter(tables[table].values()), ())))[:1]
    by_name = [table for table in chosen if any(_is_named(name) for name in (table, *tables[table]))]
    others = [table for table in chosen if by_name and table not in by_name]
    chosen = by_name or chosen
    lines = [
        f"# Guessed from {source.path.name}: check each line, above all units, types and names.",
        f'format = "{FORMAT}"',
        f"version = {VERSION}",
    ]
    place = source.path.resolve()
    name = "" if len(chosen) > 1 else place.parent.name if place.name == DUMP else place.stem
    found = [_driver(source, table, tables, times[table], name or table) for table in chosen]
    if not any(found):
        raise ConfigurationError(f"{source.path}: nothing looks like taxels; {_overview(source, tables)}")
    for each in found:
        lines += each
    lines += [f"# not taken for taxels: the table {table}" for table in others]
    lines += [f"# left out: {name} ({why})" for name, why in source.left_out.items()]
    return "\n".join(lines) + "\n"


def _is_named(name: str) -> bool:
    return bool(_TOUCH.search(name) or (_TAXELS.search(name) and not _NO_TAXELS.search(name)))


def _overview(source: ColumnSource, tables: Mapping[str, Rows]) -> str:
    in_tables = [f"{name} ({table})" if table else name for table, rows in tables.items() for name in rows]
    others = [f"{name} ({why[:_SHOWN]})" for name, why in source.left_out.items()]
    shown = [", ".join([*each[:_MANY], *["..."] * (len(each) > _MANY)]) for each in (in_tables, others)]
    return f"columns of numbers: {shown[0] or 'none'}" + (f"; others: {shown[1]}" if others else "")


def _driver(source: ColumnSource, table: str, tables: Mapping[str, Rows], time: str, driver: str) -> list[str]:
    rows = tables[table]
    names = [name for name in rows if name != time and name not in source.times]
    beside = {f"{name}_status" for name in names} | {
        f"{name.rpartition('.')[0]}.age" for name in names if "tactile" in name
    }
    possible = [
        name
        for name in names
        if (_TOUCH.search(name) or not _NO_TAXELS.search(name)) and not _TIMES.fullmatch(name) and name not in beside
    ]
    pattern = {name: _NUMBER.sub("#", _AXIS.sub("", name)) for name in possible}
    alike = Counter(pattern.values())
    wanted = [name for name in possible if _TAXELS.search(name) or alike[pattern[name]] >= _MANY] or possible
    places = [name for name in names if name.lower() in ("x", "y", "z")]
    has_places = len(places) == 3 and rows[places[0]].ndim == 2
    wanted = [name for name in wanted if not (has_places and name in places)]
    driver = re.sub(r"[^a-z0-9]+", "-", driver.lower()).strip("-")[:32] or "imported"
    modules = list(_modules({name: rows[name] for name in wanted}, driver))
    if not modules:
        return []
    whole = {len(each): [name] for other in tables if other != table for name, each in tables[other].items()
             if each.shape[1:] == (3,) and _PLACES.search(name)}  # fmt: skip
    lines = ["", "[[driver]]", f"name = {_text(driver)}"]
    lines += [f"table = {_text(table)}"] if table else []
    lines += _time_lines(rows, time, source)
    values = [rows[name] for name in wanted]
    is_whole = all(bool(np.all((each == np.rint(each)) & (np.abs(each) < _WHOLE) | np.isnan(each))) for each in values)
    dtypes = {each.dtype.name for each in values}
    dtype = next(iter(dtypes)) if dtypes <= {"uint8"} or dtypes <= {"int16"} or dtypes <= {"uint16"} else "int32"
    dtype, why = (dtype, "whole numbers") if is_whole else ("float32", "fractions or large numbers")
    lines += [f"dtype = {_text(dtype)}  # {why} in the first rows"]
    for module, count, why in modules:
        lines += ["", "[[driver.module]]", f"# {why}"]
        guessed = {name: getattr(module, name) for name in ("patch", "module", "type", "unit", "kind", "columns")}
        lines += [f"{name} = {_text(value)}" for name, value in guessed.items() if value or name != "kind"]
        if named := places if has_places else whole.get(count):
            lines += ["# these look like places in metres", f"positions = {_text(named)}"]
    others = [name for name in names if name not in wanted and not (has_places and name in places)]
    return [*lines, *(["", f"# not taken for taxels: {', '.join(others)}"] if others else [])]


# -- time ---------------------------------------------------------------------------------------------------------


def _time_of(rows: Rows, source: ColumnSource) -> str:
    """Return the name of the column of times; empty: none looks like it."""
    named = [name for name in rows if (_TIMES.fullmatch(name) or name in source.times) and _rises(rows[name])]
    preferred = ("time_s", "header.stamp", "stamp", "time")
    named.sort(key=lambda name: preferred.index(name) if name in preferred else len(preferred))
    fractions = [
        name
        for name, each in rows.items()
        if _rises(each) and not _NO_TAXELS.search(name.replace("column_0", "")) and (each != np.rint(each)).any()
    ]
    return next(iter([*named, *fractions[:1]]), "")


def _rises(column: npt.NDArray[Any]) -> bool:
    numbers = column.reshape(len(column), -1)
    is_one = numbers.shape[1] == 1 and len(numbers) > 1
    return is_one and bool((numbers[1:] >= numbers[:-1]).all() and numbers[-1, 0] > numbers[0, 0])


def _time_lines(rows: Rows, time: str, source: ColumnSource) -> list[str]:
    if not time:
        refused = next((f" ({name}: {why})" for name, why in source.left_out.items() if _TIMES.fullmatch(name)), "")
        return [f"rate_hz = 100  # MADE UP: no column rises like a time{refused}"]
    numbers = rows[time].ravel().astype(np.float64)
    said, step = _UNIT_OF_TIME.search(time), float(np.median(np.diff(numbers))) or float(np.ptp(numbers)) / len(numbers)
    if time in source.times:
        unit, why = "ns", "times as such"
    elif said:
        unit, why = {"sec": "s", "seconds": "s", "nsec": "ns"}.get(said[1].lower(), said[1].lower()), "its name says so"
    elif numbers[-1] > 1e8:
        unit = next(unit for unit, least in (("ns", 1e17), ("us", 1e14), ("ms", 1e11), ("s", 0)) if numbers[-1] > least)
        why = "as large as a time since 1970"
    else:
        unit = next(unit for unit, least in (("ns", 1e5), ("us", 500), ("ms", 1), ("s", 0)) if step >= least)
        why = f"steps of {step:g}"
    how = "its name" if _TIMES.fullmatch(time) else "it rises, and no name says time"
    rate_hz = NS_PER_S / (step * UNITS_NS[unit])
    return [
        f"time = {_text(time)}  # {how}",
        f"time_unit = {_text(unit)}  # {why}",
        f"rate_hz = {min(rate_hz, 100_000):.4g}  # most of the first rows",
    ]


# -- taxels -------------------------------------------------------------------------------------------------------


def _modules(columns: Rows, driver: str) -> Iterator[_Guess]:
    singles: dict[str, list[str]] = {}
    for name, rows in columns.items():
        if rows.ndim == 1:
            singles.setdefault(_NUMBER.sub("#", name), []).append(name)
        else:
            yield from _arrays(name, rows.shape[1:], driver)
    for pattern, names in singles.items():
        yield from _numbered(pattern, names, driver)


def _arrays(name: str, shape: Sequence[int], driver: str) -> Iterator[_Guess]:
    """Yield the modules of an array: its last two axes are rows and columns, or its last one x, y and z."""
    patch = _label(name) or driver
    has_axes = shape[-1] == 3 and (len(shape) > 1 or re.search(r"force|mag|acc|gyro|shear", name, re.I) is not None)
    inner = shape[:-1] if has_axes else shape
    outer, matrix = (inner[:-2], inner[-2:]) if len(inner) > 1 else ((), ())
    kind = "x".join(map(str, matrix)) if matrix and 1 not in matrix else ""
    for place in np.ndindex(*outer):
        for axis in range(3) if has_axes else (None,):
            parts = [*map(str, place), *([":"] * (len(inner) - len(place))), *([] if axis is None else [str(axis)])]
            column = name if not place and axis is None else f"{name}[{', '.join(parts)}]"
            type_name, unit, why = _type_of(name, "" if axis is None else "xyz"[axis])
            module = " ".join(map(str, place))
            why = f"an array of {' x '.join(map(str, shape))}; {why}"
            count = int(np.prod(inner[len(outer) :]))
            yield _Guess(ModuleMap(patch, (column,), module, type_name, unit, kind=kind), count, why)


def _numbered(pattern: str, names: Sequence[str], driver: str) -> Iterator[_Guess]:
    numbers = {name: tuple(_NUMBER.findall(name)) for name in names}
    axis = _AXIS.search(pattern)
    type_name, unit, why = _type_of(pattern, (axis[2] or axis[3]).lower() if axis else "")
    bare = _AXIS.sub("", pattern) if axis else pattern
    label = _label(_UNITS.sub("", bare).split("#")[0])
    patch = driver if label.lower() in _GENERIC else label
    groups: dict[tuple[str, ...], list[str]] = {}
    depth = pattern.count("#")
    outer = depth - 2 if depth > 2 or (depth == 2 and _is_grid(numbers.values())) else max(0, depth - 1)
    for name, found in numbers.items():
        groups.setdefault(found[:outer], []).append(name)
    for place, group in groups.items():
        rest = [numbers[name][outer:] for name in group]
        sizes = [len(set(each)) for each in zip(*rest, strict=True)]
        is_grid = len(sizes) == 2 and _is_grid(rest)
        kind = "x".join(map(str, sizes)) if is_grid else ""
        said = "one column" if len(group) == 1 else f"{len(group)} columns that differ in their numbers"
        columns = tuple(_ranges(pattern, group, numbers))
        module = ModuleMap(patch, columns, " ".join(place), type_name, unit, kind=kind)
        yield _Guess(module, len(group), f"{said}; {why}")


def _is_grid(numbers: Any) -> bool:
    """Return whether pairs of numbers are all places of rows and columns."""
    pairs = list(numbers)
    rows, columns = (len(set(each)) for each in zip(*pairs, strict=True))
    return rows > 1 and columns > 1 and rows * columns == len(pairs)


def _ranges(pattern: str, group: Sequence[str], numbers: Mapping[str, tuple[str, ...]]) -> list[str]:
    """Return columns in short, as ``taxel_{0..11}``, if they are that in this order; else all their names."""
    short, spelled = pattern, [""]
    for each in zip(*(numbers[name] for name in group), strict=True):
        first, last = each[0], each[-1]
        spelled = [f"{one}\0{n:0{len(first)}d}" for one in spelled for n in range(int(first), int(last) + 1)]
        short = short.replace("#", first if first == last else f"{{{first}..{last}}}", 1)
    return [short] if spelled == ["\0".join(("", *numbers[name])) for name in group] else list(group)


def _type_of(name: str, axis: str) -> tuple[str, str, str]:
    said = _UNITS.search(_NUMBER.sub("", name).rstrip("_. #"))
    unit = _UNIT_NAMES.get(said[1].lower(), said[1].lower()) if said else "counts"
    for words, (type_name, axes) in _TYPES.items():
        if re.search(words, name, re.I):
            if type_name == "temperature" and re.search(r"[_.\s(\[]c[)\]]?$", name, re.I):
                unit = "degC"
            letter = axis if axis and axis in (axes or "xyz") else ("z" if not axes else "x")
            return type_name.format(letter), unit, f"{type_name.format(letter)} by its name"
    if axis:
        return f"force_{axis}", unit, f"the {axis} of three axes"
    return "pressure", unit, "pressure, as no name says anything else"


def _label(text: str) -> str:
    return re.sub(r"[\W_]+", " ", text.replace("observation.", "")).strip()[:32]


def _text(value: object) -> str:
    return msgspec.json.encode(value).decode()
