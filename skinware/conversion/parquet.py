"""Parquet: a folder of tables, of each service one with a row for each frame, written and read in groups of rows."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from skinware.conversion._packages import pyarrow
from skinware.conversion.description import described, heads_of
from skinware.conversion.leaves import Leaf, leaves
from skinware.conversion.stored import StoredArrays, StoredSource
from skinware.conversion.tables import (
    ArrayFormat,
    Output,
    Source,
    Table,
    check_distinct,
    outputs,
    sensor_table,
)
from skinware.errors import BadRecording

DESCRIPTION = "recording.json"
_GROUP_BYTES = 32 << 20


def write_parquet(source: Source, folder: Path) -> None:
    """Write a source into a folder, which is made.

    Raises:
        MissingExtra: pyarrow is not installed.
        OSError: it cannot be written.
    """
    arrow = pyarrow()
    folder.mkdir()
    units = []
    for table in source.tables:
        made = outputs(table)
        _write_frames(arrow, table, made, folder / f"{table.name}.parquet")
        sensors = sensor_table(table)
        if sensors:
            arrow.parquet.write_table(arrow.table(sensors), folder / f"{table.name}.sensors.parquet")
        heads = arrow.array([row.tobytes() for row in heads_of(table)], arrow.binary())
        arrow.parquet.write_table(arrow.table({"head": heads}), folder / f"{table.name}.generations.parquet")
        units.append({output.name: output.unit for output in made if output.unit})
    (folder / DESCRIPTION).write_bytes(described(source, units).to_json())


def _write_frames(arrow: Any, table: Table, made: Sequence[Output], path: Path) -> None:
    """The rows of a table; a column for each leaf of its arrays, a list for each frame where there are several."""
    columns = [(output, leaf) for output in made for leaf in leaves(output.format)]
    check_distinct([leaf.name(output.name) for output, leaf in columns], "Parquet", table)
    fields = [
        arrow.field(leaf.name(output.name), _type(arrow, leaf), False, {"unit": output.unit} if output.unit else None)
        for output, leaf in columns
    ]
    schema = arrow.schema(fields)
    rows_in_group = max(1, _GROUP_BYTES // sum(output.format.row_bytes for output in made))
    needed = tuple(dict.fromkeys(name for output in made for name in output.needs))
    with arrow.parquet.ParquetWriter(path, schema, compression="zstd") as writer:
        waiting, count = [], 0
        for block in table.blocks(needed):
            arrays = [_column(arrow, leaf, output.of(block)) for output, leaf in columns]
            waiting.append(arrow.record_batch(arrays, schema=schema))
            count += len(arrays[0])
            if count >= rows_in_group:
                writer.write_table(arrow.Table.from_batches(waiting), row_group_size=count)
                waiting, count = [], 0
        if waiting:
            writer.write_table(arrow.Table.from_batches(waiting), row_group_size=count)


def _is_plain(leaf: Leaf) -> bool:
    """Whether the numbers are ones that Parquet has; others are written as bytes."""
    return leaf.dtype.kind in "iu" or (leaf.dtype.kind == "f" and leaf.dtype.itemsize in (4, 8))


def _type(arrow: Any, leaf: Leaf) -> Any:
    item = arrow.from_numpy_dtype(leaf.dtype) if _is_plain(leaf) else arrow.binary(leaf.dtype.itemsize)
    return arrow.list_(arrow.field("item", item, False), leaf.size) if leaf.shape else item


def _column(arrow: Any, leaf: Leaf, rows: npt.NDArray[Any]) -> Any:
    numbers = np.ascontiguousarray(leaf.of(rows)).reshape(-1)
    if _is_plain(leaf):
        items = arrow.array(numbers)
    else:
        items = arrow.FixedSizeBinaryArray.from_buffers(
            arrow.binary(leaf.dtype.itemsize), len(numbers), [None, arrow.py_buffer(numbers.tobytes())]
        )
    return arrow.FixedSizeListArray.from_arrays(items, type=_type(arrow, leaf)) if leaf.shape else items


class ParquetSource(StoredSource):
    """A folder that :func:`write_parquet` wrote, as a source; see :class:`skinware.conversion.stored.StoredSource`.

    Raises:
        MissingExtra: pyarrow is not installed; besides what is said there.
    """

    def __init__(self, path: Path, start_s: float, end_s: float | None) -> None:
        pyarrow()
        self._files: list[Any] = []
        super().__init__(path, start_s, end_s)

    def close(self) -> None:
        for file in self._files:
            file.close()

    def _description(self) -> bytes:
        try:
            return (self.path / DESCRIPTION).read_bytes()
        except FileNotFoundError:
            raise BadRecording(f"{self.path}: not arrays of a recording (no {DESCRIPTION})") from None

    def _heads(self, table: str) -> npt.NDArray[Any]:
        rows = self._opened(f"{table}.generations.parquet").read().column("head").to_pylist()
        return (
            np.array([np.frombuffer(row, np.uint8) for row in rows]) if len(set(map(len, rows))) == 1 else np.zeros(0)
        )

    def _arrays(self, table: str) -> StoredArrays:
        return _Arrays(self._opened(f"{table}.parquet"), self.path)

    def _opened(self, name: str) -> Any:
        arrow = pyarrow()
        try:
            file = arrow.parquet.ParquetFile(self.path / name)
        except FileNotFoundError:
            raise BadRecording(f"{self.path / name}: missing") from None
        except (arrow.ArrowException, OSError) as error:
            raise BadRecording(f"{self.path / name}: not Parquet, or damaged ({_line(error)})") from None
        self._files.append(file)
        return file


class _Arrays:
    """The arrays of one table in its file."""

    def __init__(self, file: Any, path: Path) -> None:
        self._file, self._path = file, path

    def rows_of(self, name: str, each: ArrayFormat) -> int | None:
        """See :class:`skinware.conversion.stored.StoredArrays`."""
        arrow, schema = pyarrow(), self._file.schema_arrow
        for leaf in leaves(each):
            column = schema.get_field_index(leaf.name(name))
            if column < 0 or schema.field(column).type != _type(arrow, leaf):
                return None
        rows: int = self._file.metadata.num_rows
        return rows

    def pieces(self, formats: Mapping[str, ArrayFormat], rows: int) -> Iterator[Mapping[str, npt.NDArray[Any]]]:
        arrow = pyarrow()
        columns = [leaf.name(name) for name, each in formats.items() for leaf in leaves(each)]
        try:
            for batch in self._file.iter_batches(rows, columns=columns):
                yield {name: _rows(batch, name, each) for name, each in formats.items()}
        except (arrow.ArrowException, OSError) as error:
            raise BadRecording(f"{self._path}: damaged ({_line(error)})") from None


def _rows(batch: Any, name: str, each: ArrayFormat) -> npt.NDArray[Any]:
    rows = np.zeros((len(batch), *each.shape), each.dtype)
    for leaf in leaves(each):
        items = batch.column(batch.schema.get_field_index(leaf.name(name)))
        if leaf.shape:
            items = items.flatten()
        if _is_plain(leaf):
            numbers = items.to_numpy(zero_copy_only=False)
        else:
            numbers = np.frombuffer(items.buffers()[1], leaf.dtype)[items.offset : items.offset + len(items)]
        leaf.put(numbers, rows)
    return rows


def _line(error: Exception) -> str:
    return str(error).splitlines()[0]
