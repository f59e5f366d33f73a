"""CSV: a folder of texts that anything reads, of each service one with a line for each frame, and more beside it."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from skinware.conversion.leaves import Leaf, leaves
from skinware.conversion.tables import (
    COLUMNS,
    FRAMES,
    PHYSICAL,
    Output,
    Source,
    Table,
    check_distinct,
    outputs,
    sensor_table,
)
from skinware.realtime import NS_PER_S

_OF_DRIVERS = (
    "values", "status", "module_time_ns", "group_time_ns", "patch_state", "bus_state", "bus_reason", "bus_load",
)  # fmt: skip
"""Columns of a driver that a text has; counters and histograms would be most of it."""


def write_csv(source: Source, folder: Path) -> None:
    """Write a source into a folder, which is made.

    Raises:
        OSError: it cannot be written.
    """
    folder.mkdir()
    for table in source.tables:
        sensors = sensor_table(table)
        if sensors:
            sensors["uid"] = np.array([f"{uid:#x}" for uid in sensors["uid"].tolist()])
            _write_lines(folder / f"{table.name}.sensors.csv", sensors)
        with ExitStack() as open_files:
            _write_frames(table, folder, open_files, source.start_ns)


def csv_without(_: Source) -> list[str]:
    return ["counters, histograms and events are left out: csv does not hold them"]


def _write_frames(table: Table, folder: Path, open_files: ExitStack, start_ns: int) -> None:
    wanted = [output for output in outputs(table) if _is_wanted(table, output)]
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


def _is_wanted(table: Table, output: Output) -> bool:
    column = output.name.removeprefix(COLUMNS)
    return table.structure is None or column == output.name or column in _OF_DRIVERS


def _file_part(output: Output) -> str:
    """What the name of a file has of its array: ``values``, or the type of physical values."""
    name = output.name.removeprefix(COLUMNS).removeprefix(PHYSICAL)
    return "".join(letter if letter.isalnum() or letter in "_-" else "_" for letter in name)


class _Text:
    """The file of one array.

    Args:
        open_files: where it is closed.
        path: of the file.
        labels: of its columns.
        output: the array.
    """

    def __init__(self, open_files: ExitStack, path: Path, labels: Sequence[str], output: Output) -> None:
        self.output = output
        self._leaves = leaves(output.format)
        self._file: IO[str] = open_files.enter_context(path.open("w", encoding="utf-8", newline=""))
        self._file.write(_line(["time_s", *labels]))

    def add(self, times: Sequence[str], rows: npt.NDArray[Any]) -> None:
        parts = [_texts(leaf, rows) for leaf in self._leaves]
        self._file.writelines(",".join(line) + "\n" for line in zip(times, *parts, strict=True))


def _texts(leaf: Leaf, rows: npt.NDArray[Any]) -> list[str]:
    """The numbers of a leaf in m rows, a text for each row. Floats have as many digits as tell them exactly."""
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
    """A label for each number of a leaf: its name, with its place where there are several."""
    if not leaf.shape:
        return [name]
    return [f"{name}[{','.join(map(str, place))}]" for place in np.ndindex(leaf.shape)]


def _write_lines(path: Path, columns: dict[str, npt.NDArray[Any]]) -> None:
    with path.open("w", encoding="utf-8", newline="") as file:
        file.write(_line(columns))
        file.writelines(_line(row) for row in zip(*(array.tolist() for array in columns.values()), strict=True))


def _line(cells: Iterable[object]) -> str:
    """A line of cells, in quotes where they would be taken for something else."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\r\n").writerow(cells)  # which has \r in quotes too
    return text.getvalue().removesuffix("\r\n") + "\n"
