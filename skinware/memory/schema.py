"""Describe the columns of a service: dtypes with fields, shapes, units.

The file's column table knows plain numbers and bytes only. More stands in a static column ``schema``,
as JSON: ``{"description": TEXT, "columns": {NAME: {"dtype": D, "shape": [...], "unit": TEXT, "description": TEXT}},
"tables": {NAME: D}}``, the tables being static columns whose rows are structures, with D a dtype code (``"<f8"``) or a
list of ``[name, D]`` or ``[name, D, shape]`` for a structure, as numpy's ``.npy`` format has it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

from skinware.errors import BadServiceFile, ConfigurationError
from skinware.memory.file_layout import FileLayout

STATIC_NAME = "schema"
_MAX_BYTES = 1 << 16


@dataclass(frozen=True)
class Column:
    """One named array of a sample.

    Attributes:
        dtype: numbers, fixed-length bytes, or a structure of them; anything that ``np.dtype`` takes.
        shape: of the array in every sample.
        unit: of the numbers, for people.
        description: for people.
    """

    dtype: np.dtype[Any]
    shape: tuple[int, ...]
    unit: str = ""
    description: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "dtype", np.dtype(self.dtype))
        object.__setattr__(self, "shape", _shape(self.shape))


@dataclass(frozen=True)
class Schema:
    """All columns of a service's samples.

    Attributes:
        columns: by name.
        description: of the service, for people.
        tables: dtypes of those static tables whose rows are structures, by name; only of a service that is read.
    """

    columns: Mapping[str, Column] = field(default_factory=dict)
    description: str = ""
    tables: Mapping[str, np.dtype[Any]] = field(default_factory=dict)

    @staticmethod
    def of(columns: Mapping[str, Column | tuple[npt.DTypeLike, int | tuple[int, ...]]], description: str) -> Schema:
        """Return a schema from what a person wrote; refuse dtypes and shapes that cannot be shared."""
        made: dict[str, Column] = {}
        for name, given in columns.items():
            column = given if isinstance(given, Column) else Column(np.dtype(given[0]), _shape(given[1]))
            if column.dtype.hasobject or column.dtype.itemsize == 0 or any(n < 0 for n in column.shape):
                raise ConfigurationError(
                    f"column {name!r} of {column.dtype} and shape {column.shape}: give numbers, fixed-length bytes or"
                    " structures of them (Python objects cannot be shared), and a shape of numbers from 0 on"
                )
            made[name] = column
        return Schema(made, description)

    def for_layout(self) -> dict[str, tuple[npt.DTypeLike, int]]:
        """(dtype, count) of every column, as the column table has it."""
        return {name: (_table_dtype(c.dtype), math.prod(c.shape)) for name, c in self.columns.items()}

    def for_file(self, static: Mapping[str, npt.NDArray[Any]]) -> dict[str, npt.NDArray[Any]]:
        """Return the static column that says what the column table cannot, if that cannot say everything."""
        descr = np.lib.format.dtype_to_descr
        tables = {name: descr(table.dtype) for name, table in static.items() if table.dtype.names is not None}
        if not (self.description or tables) and all(
            c.dtype == _table_dtype(c.dtype) and len(c.shape) == 1 and not c.unit and not c.description
            for c in self.columns.values()
        ):
            return {}
        columns = {
            name: {"dtype": descr(c.dtype), "shape": c.shape, "unit": c.unit, "description": c.description}
            for name, c in self.columns.items()
        }
        text = msgspec.json.encode({"description": self.description, "columns": columns, "tables": tables})
        if len(text) > _MAX_BYTES:
            raise ConfigurationError(f"the schema takes {len(text)} bytes; at most {_MAX_BYTES}: shorten its texts")
        return {STATIC_NAME: np.frombuffer(text, np.uint8)}


class _ColumnText(msgspec.Struct):
    dtype: Any
    shape: tuple[int, ...]
    unit: str = ""
    description: str = ""


class _SchemaText(msgspec.Struct):
    columns: dict[str, _ColumnText]
    description: str = ""
    tables: dict[str, Any] = {}


def from_file(layout: FileLayout, static: Mapping[str, npt.NDArray[Any]], path: str) -> Schema:
    """Return the schema of an attached file, if it can be read and agrees with the column table."""
    columns = {c.name: Column(c.dtype, (c.count,)) for c in layout.slot}
    if STATIC_NAME not in static:
        return Schema(columns)
    size = static[STATIC_NAME].nbytes
    if size > _MAX_BYTES:
        raise BadServiceFile(f"{path}: a schema of {size} bytes; at most {_MAX_BYTES}; not attached")
    try:
        text = msgspec.json.decode(static[STATIC_NAME].tobytes(), type=_SchemaText)
        told = {
            name: Column(np.lib.format.descr_to_dtype(_tuples(c.dtype)), c.shape, c.unit, c.description)
            for name, c in text.columns.items()
        }
        tables = {name: np.lib.format.descr_to_dtype(_tuples(descr)) for name, descr in text.tables.items()}
    except Exception as error:  # noqa: BLE001, whatever numpy makes of nonsense
        raise BadServiceFile(f"{path}: its schema cannot be read ({error}); not attached") from None
    for name, column in told.items():
        plain = columns.get(name)
        if (
            plain is None
            or column.dtype.hasobject
            or any(n < 0 for n in column.shape)
            or column.dtype.itemsize * math.prod(column.shape) != plain.dtype.itemsize * math.prod(plain.shape)
        ):
            raise BadServiceFile(f"{path}: its schema contradicts its column table at {name!r}; not attached")
    plain_tables = {c.name: c.dtype for c in layout.static}
    for name, dtype in tables.items():
        if name not in plain_tables or dtype.hasobject or dtype.itemsize != plain_tables[name].itemsize:
            raise BadServiceFile(f"{path}: its schema contradicts its column table at {name!r}; not attached")
    return Schema({**columns, **told}, text.description, tables)


def _shape(given: int | tuple[int, ...]) -> tuple[int, ...]:
    return (given,) if isinstance(given, int) else tuple(given)


def _table_dtype(dtype: np.dtype[Any]) -> np.dtype[Any]:
    """Return the dtype itself where the column table knows it; otherwise as many bytes."""
    return dtype if dtype.names is None and dtype.subdtype is None else np.dtype(f"V{dtype.itemsize}")


def _tuples(descr: Any) -> Any:
    """Make tuples of the lists of JSON, as numpy needs them."""
    if not isinstance(descr, list):
        return descr
    fields = []
    for name, of, *shape in descr:
        title_and_name = tuple(name) if isinstance(name, list) else name
        fields.append((title_and_name, _tuples(of), *map(tuple, shape)))
    return fields
