"""Write CSV and Parquet folders: a line or row for each sample."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from skinware.conversion.arrays import description
from skinware.conversion.tables import (
    COLUMNS,
    FRAMES,
    PHYSICAL,
    ArrayFormat,
    Output,
    Table,
    TableSource,
    check_distinct,
    outputs,
    pyarrow,
    sensor_table,
)
from skinware.realtime import NS_PER_S


class Leaf(NamedTuple):
    """Plain numbers in the rows of an array.

    Attributes:
        path: names of the fields that lead to them; empty: the rows are plain.
        dtype: of them: no structure.
    """

    path: tuple[str, ...]
    shape: tuple[int, ...]
    dtype: np.dtype[Any]

    @property
    def size(self) -> int:
        return math.prod(self.shape)

    def of(self, rows: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Return the numbers of m rows, (m, size), as a view where that is possible."""
        for field in self.path:
            rows = rows[field]
        return rows.reshape(len(rows), self.size)

    def name(self, array: str) -> str:
        return ".".join([array, *self.path])


def leaves(each: ArrayFormat) -> list[Leaf]:
    found = [Leaf((), each.shape, each.dtype)]
    while any(leaf.dtype.names is not None for leaf in found):
        found = [inner for leaf in found for inner in _opened(leaf)]
    return [leaf for leaf in found if leaf.size and leaf.dtype.itemsize]


def _opened(leaf: Leaf) -> list[Leaf]:
    if leaf.dtype.names is None:
        return [leaf]
    fields = leaf.dtype.fields
    assert fields is not None  # noqa: S101, it has names
    opened = []
    for name in leaf.dtype.names:
        base, shape = fields[name][0].base, fields[name][0].shape
        opened.append(Leaf((*leaf.path, name), (*leaf.shape, *shape), base))
    return opened


_STATES = ("patch_state", "bus_state", "bus_reason", "bus_load")
_OF_DRIVERS = {COLUMNS + name for name in ("values", "status", "module_time_ns", "group_time_ns", *_STATES)}
"""Columns of a driver in text files; counters and histograms would fill most of the file."""


def write_csv(source: TableSource, folder: Path) -> None:
    folder.mkdir()
    for table in source.tables:
        sensors = sensor_table(table)
        if sensors:
            sensors["uid"] = np.array([f"{uid:#x}" for uid in sensors["uid"].tolist()])
            _write_lines(folder / f"{table.name}.sensors.csv", sensors)
        with ExitStack() as open_files:
            _write_csv_table(table, folder, open_files, source.start_ns)


def csv_without(_: TableSource) -> list[str]:
    return ["counters, histograms and events are left out: csv does not hold them"]


def _write_csv_table(table: Table, folder: Path, open_files: ExitStack, start_ns: int) -> None:
    left_out = () if table.structure is None else {COLUMNS + name for name in table.origin.columns} - _OF_DRIVERS
    wanted = [output for output in outputs(table) if output.name not in left_out]
    of_frames = [output for output in wanted if output.name.startswith(FRAMES)]
    check_distinct(["frames", "sensors", *map(_file_part, wanted[len(of_frames) :])], "CSV", table)
    texts = [
        _Text(open_files, folder / f"{table.name}.{_file_part(output)}.csv", _labels(table, output), output)
        for output in wanted
        if not output.name.startswith(FRAMES)
    ]
    frames = open_files.enter_context((folder / f"{table.name}.frames.csv").open("w", encoding="utf-8", newline=""))
    frames.write(_line(["time_s", *(output.name.removeprefix(FRAMES) for output in of_frames)]))
    needed = tuple(dict.fromkeys(name for output in wanted for name in output.needs))
    for block in table.blocks(needed):
        times = [f"{time_ns / NS_PER_S:.9f}" for time_ns in (block["frames/time_ns"] - start_ns).tolist()]
        rows = zip(times, *(output.of(block).tolist() for output in of_frames), strict=True)
        frames.writelines(_line(row) for row in rows)
        for text in texts:
            text.add(times, text.output.of(block))


def _file_part(output: Output) -> str:
    """Return the part of a file name for an array: ``values``, or the type of physical values."""
    name = output.name.removeprefix(COLUMNS).removeprefix(PHYSICAL)
    return "".join(letter if letter.isalnum() or letter in "_-" else "_" for letter in name)


class _Text:
    def __init__(self, open_files: ExitStack, path: Path, labels: Sequence[str], output: Output) -> None:
        self.output = output
        self._leaves = leaves(output.format)
        self._file: IO[str] = open_files.enter_context(path.open("w", encoding="utf-8", newline=""))
        self._file.write(_line(["time_s", *labels]))

    def add(self, times: Sequence[str], rows: npt.NDArray[Any]) -> None:
        parts = [_texts(leaf, rows) for leaf in self._leaves]
        self._file.writelines(",".join(line) + "\n" for line in zip(times, *parts, strict=True))


def _texts(leaf: Leaf, rows: npt.NDArray[Any]) -> list[str]:
    """Return the numbers of a leaf as one text for each of m rows; floats with all the digits that define them."""
    numbers = leaf.of(rows)
    if leaf.dtype.kind in "iu":
        return [",".join(map(str, row)) for row in numbers.tolist()]
    if leaf.dtype.kind == "f":
        item = "%.9g" if leaf.dtype.itemsize <= 4 else "%.17g"
        pattern = ",".join([item] * leaf.size)
        return [pattern % tuple(row) for row in numbers.tolist()]
    if leaf.dtype.kind == "S":
        return [_line(text.decode(errors="replace") for text in row)[:-1] for row in numbers.tolist()]
    return [",".join(bytes(item).hex() for item in row) for row in numbers]


def _labels(table: Table, output: Output) -> list[str]:
    structure = table.structure
    column = output.name.removeprefix(COLUMNS)
    if structure is None:
        return [label for leaf in leaves(output.format) for label in _numbered(leaf, leaf.name(column))]
    if output.name.startswith(PHYSICAL):
        index = structure.index(output.name.removeprefix(PHYSICAL))
        return [f"{uid:#x}" for uid in structure.sensor_uid[index].tolist()]
    names = {each.id: each.name for each in structure.types}
    sensors = zip(structure.sensor_type.tolist(), structure.sensor_uid.tolist(), strict=True)
    if column in ("values", "status"):
        return [f"{names[type_id]} {uid:#x}" for type_id, uid in sensors]
    rows: Sequence[str] = structure.buses
    if column == "module_time_ns":
        rows = structure.module_names
    elif column == "group_time_ns":
        rows = [f"{structure.module_names[module]} group {n}" for n, module in enumerate(structure.group_module)]
    elif column == "patch_state":
        rows = structure.patch_names
    return list(rows)


def _numbered(leaf: Leaf, name: str) -> list[str]:
    """Return a label for each number of a leaf: its name, with an index if there are several."""
    if not leaf.shape:
        return [name]
    return [f"{name}[{','.join(map(str, place))}]" for place in np.ndindex(leaf.shape)]


def _write_lines(path: Path, columns: dict[str, npt.NDArray[Any]]) -> None:
    with path.open("w", encoding="utf-8", newline="") as file:
        file.write(_line(columns))
        file.writelines(_line(row) for row in zip(*(array.tolist() for array in columns.values()), strict=True))


def _line(cells: Iterable[object]) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\r\n").writerow(cells)  # which has \r in quotes too
    return text.getvalue().removesuffix("\r\n") + "\n"


_GROUP_BYTES = 32 << 20


def write_parquet(source: TableSource, folder: Path) -> None:
    arrow = pyarrow()
    folder.mkdir()
    units = []
    for table in source.tables:
        made = outputs(table)
        _write_parquet_table(arrow, table, made, folder / f"{table.name}.parquet")
        sensors = sensor_table(table)
        if sensors:
            arrow.parquet.write_table(arrow.table(sensors), folder / f"{table.name}.sensors.parquet")
        units.append({output.name: output.unit for output in made if output.unit})
    (folder / "recording.json").write_bytes(description(source, units))


def _write_parquet_table(arrow: Any, table: Table, made: Sequence[Output], path: Path) -> None:
    """Write the rows of a table: a column for each leaf of its arrays, with lists where a leaf has several numbers."""
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
    """Return whether Parquet has this type of number; others are written as bytes."""
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
