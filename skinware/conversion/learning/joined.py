"""Join files of joints, actions and cameras to the rows of a learning set by time."""

from __future__ import annotations

import csv
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from skinware.conversion._packages import pyarrow
from skinware.conversion.learning.wanted import Join
from skinware.conversion.tables import TableSource
from skinware.errors import ConfigurationError
from skinware.realtime import NS_PER_S

TIMES = ("time_ns", "unix_s", "monotonic_ns", "time_s")
"""Names of a column of times: wall clock in ns or s since 1970, CLOCK_MONOTONIC of the machine that recorded, s since
the recording began."""
_OF_ONE_RECORDING = ("monotonic_ns", "time_s")
_VIDEOS = (".mp4", ".mkv", ".avi", ".webm", ".mov")

Columns = Mapping[str, npt.NDArray[Any]]


class Joined:
    """Data for a feature: rows of numbers, or paths of images, each with its time.

    Attributes:
        rows: (m, n) float32; (m,) text for paths.

    Raises:
        ConfigurationError: the file has no times, lacks a column, or has something else than numbers or paths.
        MissingExtra: the file is Parquet, and pyarrow is not installed.
        OSError: it cannot be read.
    """

    def __init__(self, join: Join) -> None:
        self.name, self.path = join.feature, join.path
        columns = _read(join.path)
        self._time = self._time_column(columns)
        self._times = columns[self._time]
        if self._times.dtype.kind not in "iuf" or not np.isfinite(self._times.astype(np.float64)).all():
            raise ConfigurationError(f"{self.path}: {self._time} is not numbers")
        if not len(self._times):
            raise ConfigurationError(f"{self.path}: no rows in it")
        chosen = join.columns or tuple(name for name in columns if name not in TIMES)
        for name in chosen:
            if name not in columns:
                raise ConfigurationError(f"{self.path}: no column {name!r}; there are: {', '.join(columns)}")
        self.names, self.rows = self._joined({name: columns[name] for name in chosen})
        if len(self.rows) != len(self._times):
            raise ConfigurationError(f"{self.path}: {len(self.rows)} rows with {len(self._times)} times")
        backward = np.flatnonzero(np.diff(self._times) < 0)
        if len(backward):
            raise ConfigurationError(f"{self.path}: time goes back after row {backward[0] + 1}")

    def times_ns(self, source: TableSource, *, is_only: bool) -> npt.NDArray[np.int64]:
        """Return the time of each row, (m,) ns since 1970, on the axis of the recording.

        Args:
            is_only: it is the only recording.

        Raises:
            ConfigurationError: the times refer to one recording, and there are several; or it lacks readings of clocks.
        """
        if self._time in _OF_ONE_RECORDING and not is_only:
            raise ConfigurationError(
                f"{self.path}: {self._time} is of one recording: with several, give time_ns or unix_s"
            )
        if self._time == "time_ns":
            return self._on_axis(self._times.astype(np.int64), source)
        if self._time == "monotonic_ns":
            return self._times.astype(np.int64) + self._ahead_ns(source)
        if self._time == "unix_s":  # floats have it to a quarter of a microsecond
            since_ns = self._on_axis(np.rint(self._times * 1e6).astype(np.int64) * 1000, source)
        else:
            since_ns = source.start_ns + np.rint(self._times * NS_PER_S).astype(np.int64)
        return since_ns

    def _ahead_ns(self, source: TableSource) -> int:
        """Return the axis of the recording minus CLOCK_MONOTONIC."""
        ahead = [each["log_time_ns"] - each["monotonic_ns"] for each in source.clock if "monotonic_ns" in each]
        if not ahead:
            raise ConfigurationError(f"{source.path}: has no readings of clocks: {self.path} needs time_ns or unix_s")
        return int(ahead[0])

    def _on_axis(self, wall_ns: npt.NDArray[np.int64], source: TableSource) -> npt.NDArray[np.int64]:
        """Return times of the wall clock on the axis of the recording, (m,)."""
        readings = sorted((each["realtime_ns"], each["log_time_ns"]) for each in source.clock if "realtime_ns" in each)
        if not readings:
            return wall_ns
        wall, axis = np.array(readings, np.int64).T
        at = np.maximum(np.searchsorted(wall, wall_ns, side="right") - 1, 0)
        on_axis: npt.NDArray[np.int64] = wall_ns + (axis - wall)[at]
        return on_axis

    def _time_column(self, columns: Columns) -> str:
        found = [name for name in TIMES if name in columns]
        if len(found) != 1:
            raise ConfigurationError(f"{self.path}: one column must have the time, as one of: {', '.join(TIMES)}")
        return found[0]

    def _joined(self, columns: Columns) -> tuple[list[str], npt.NDArray[Any]]:
        if len(columns) == 1:
            (only,) = columns.values()
            if only.ndim == 1 and only.dtype.kind in "UO":
                return list(columns), np.array([self._image(str(text)) for text in only])
        names: list[str] = []
        parts: list[npt.NDArray[np.float32]] = []
        for name, column in columns.items():
            if column.dtype.kind not in "iufb" or column.ndim > 2:
                raise ConfigurationError(f"{self.path}: {name} is not numbers; choose columns: FEATURE=FILE:COLUMN,...")
            rows = column.reshape(len(column), -1).astype(np.float32)
            if not np.isfinite(rows).all():
                row = int(np.flatnonzero(~np.isfinite(rows).all(axis=1))[0])
                raise ConfigurationError(f"{self.path}: {name} is not a finite number in row {row + 1}")
            names += [name] if column.ndim == 1 else [f"{name}[{number}]" for number in range(rows.shape[1])]
            parts.append(rows)
        if not names or len({len(part) for part in parts}) > 1:
            raise ConfigurationError(f"{self.path}: no columns of numbers, or columns of different lengths")
        return names, np.concatenate(parts, axis=1)

    def _image(self, text: str) -> str:
        if text.lower().endswith(_VIDEOS):
            raise ConfigurationError(f"{self.path}: {text}: videos are not joined: give a PNG file for each time")
        return str(self.path.parent / text)


def matched(
    times_ns: npt.NDArray[np.int64],
    at_ns: npt.NDArray[np.int64],
    match: Literal["previous", "nearest"],
    limit_ns: int,
) -> npt.NDArray[np.int64]:
    """Return the index of the time that belongs to each moment, (t,); -1: none is near enough.

    Args:
        times_ns: (m,) in order.
        at_ns: (t,) the moments.
        match: the newest time at or before a moment, or the nearest one (the earlier of two).
    """
    found: npt.NDArray[np.int64] = np.searchsorted(times_ns, at_ns, "right") - 1
    if match == "nearest":
        after = np.minimum(found + 1, len(times_ns) - 1)
        before = np.maximum(found, 0)
        is_nearer = np.abs(times_ns[after] - at_ns) < np.abs(at_ns - times_ns[before])
        found = np.where(is_nearer, after, before)
    is_near = (found >= 0) & (np.abs(at_ns - times_ns[np.maximum(found, 0)]) <= limit_ns)
    return np.where(is_near, found, -1)


def _read(path: Path) -> Columns:
    readers: dict[str, Callable[[Path], Columns]] = {".csv": _csv, ".parquet": _parquet, ".npz": _npz}
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise ConfigurationError(f"{path}: join a file that ends in .csv, .parquet or .npz")
    return reader(path)


def _csv(path: Path) -> Columns:
    with path.open(newline="", encoding="utf-8-sig") as stream:
        reader = csv.reader(stream)
        head = next(reader, [])
        rows = []
        for row in reader:
            if len(row) != len(head):
                raise ConfigurationError(f"{path}, line {reader.line_num}: {len(row)} columns instead of {len(head)}")
            rows.append(row)
    return {name: _numbers([row[number] for row in rows]) for number, name in enumerate(head)}


def _numbers(texts: list[str]) -> npt.NDArray[Any]:
    """Return texts as int64, as float64, or else as texts."""
    for convert in (int, float):
        try:
            return np.array([convert(text) for text in texts], np.int64 if convert is int else np.float64)
        except (ValueError, OverflowError):
            continue
    return np.array(texts)


def _parquet(path: Path) -> Columns:
    arrow = pyarrow()
    try:
        with path.open("rb") as stream:  # given a path, pyarrow may close it later
            table = arrow.parquet.read_table(stream)
    except arrow.ArrowException as error:
        raise ConfigurationError(f"{path}: not Parquet, or damaged ({str(error).splitlines()[0]})") from None
    columns = {}
    for name in table.column_names:
        column = table.column(name).combine_chunks()
        if arrow.types.is_list(column.type) or arrow.types.is_fixed_size_list(column.type):
            rows = column.to_pylist()
            if any(row is None or len(row) != len(rows[0] or ()) for row in rows):
                raise ConfigurationError(f"{path}: {name} has rows of different lengths")
            columns[name] = np.array(rows)
        elif column.null_count:
            raise ConfigurationError(f"{path}: {name} is missing in some rows")
        else:
            columns[name] = column.to_numpy(zero_copy_only=False)
    return columns


def _npz(path: Path) -> Columns:
    try:
        with np.load(path, allow_pickle=False) as arrays:
            return dict(arrays)
    except (zipfile.BadZipFile, ValueError, EOFError, TypeError) as error:
        raise ConfigurationError(f"{path}: not an NPZ file, or damaged ({error})") from None
