"""Define a learning set, and join files of joints, actions and cameras to its rows by time."""

from __future__ import annotations

import contextlib
import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from skinware.conversion.foreign import open_source
from skinware.conversion.foreign.source import Rows, whole
from skinware.conversion.tables import TableSource
from skinware.errors import ConfigurationError
from skinware.learning.features import Each
from skinware.realtime import NS_PER_S
from skinware.text import nearest_name

Match = Literal["previous", "nearest"]
_COLUMNS = ("start_s", "end_s", "task", "file")
_END = "end"
RESERVED = ("timestamp", "frame_index", "episode_index", "index", "task_index", "task")
"""Features that every learning set has."""


class Interval(NamedTuple):
    """An episode to make.

    Attributes:
        start_s, end_s: s since the recording began; the end is not in it.
        task: its description; None: that of all episodes.
        file: path or name of its recording; empty: the only one.
    """

    start_s: float
    end_s: float
    task: str | None = None
    file: str = ""

    def __str__(self) -> str:
        return f"{self.start_s:g}..{self.end_s:g}"


class Join(NamedTuple):
    """Columns of a file that become a feature.

    Attributes:
        columns: names; empty: all but the time.
    """

    feature: str
    path: Path
    columns: tuple[str, ...] = ()


@dataclass(frozen=True)
class LearningSet:
    """The definition of a learning set.

    Attributes:
        fps: rows a second.
        task: description of episodes without one; None: the name of the recording.
        window: number of samples of a driver in a row, the newest last; 0: as many as it publishes between two rows.
        intervals: the episodes; empty: each recording is one.
        gap_s: a silence of a driver that ends an episode and begins the next; None: no silence does.
        joins: files of joints, actions and cameras that become features.
        resample: which sample a row has: the newest (``previous``) or the ``nearest`` one, by the times of publication;
            or ``linear``: values between the two around it, unless one is missing between them; a feature
            ``interpolated`` then says the share of the later one, and a status is that of both.
        video: write images as videos, as LeRobot's own encoder does: small, and not exact.
        match: which joined row belongs to a row: the newest at or before its time, or the nearest.
        within_s: greatest distance of a joined row; None: the time between two rows.
        at: name of a joined feature whose times are those of the rows; empty: a row each 1 / fps.
        by_marks: each mark in a recording begins an episode, whose task is its text; a mark ``end`` only ends one.
        form: ``tactile``: values, status and age of each driver; or in a form that stock policies of LeRobot read:
            ``state``: numbers in ``observation.state``, as the robot ``skinware`` has them; ``images``, as the camera
            has them; ``points``: (n, 6) places and forces.
        numbers: of ``state``: sum and largest value of each ``module``, each ``taxel``, or place and force (``point``).
        size: height and width of images.
        value_range: of the darkest and brightest colour; None: of the sensor type.
    """

    fps: int = 30
    task: str | None = None
    window: int = 1
    intervals: Sequence[Interval] = ()
    gap_s: float | None = None
    joins: Sequence[Join] = ()
    resample: Literal["previous", "nearest", "linear"] = "previous"
    video: bool = False
    match: Match = "previous"
    within_s: float | None = None
    at: str = ""
    by_marks: bool = False
    form: Literal["tactile", "state", "images", "points"] = "tactile"
    numbers: Each = "module"
    size: tuple[int, int] = (64, 64)
    colours: Literal["grey", "signed", "log"] = "grey"
    value_range: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        if self.fps < 1 or self.window < 0:
            raise ConfigurationError(f"{self.fps} rows a second, {self.window} frames in each: that is no learning set")
        if self.resample == "linear" and self.window != 1:
            raise ConfigurationError("values between samples have one sample in a row: leave out --window")
        names = [join.feature for join in self.joins]
        for name in names:
            if not name or "/" in name or name in RESERVED or names.count(name) > 1:
                raise ConfigurationError(f"{name!r} cannot be the name of a joined feature, or is there twice")
        if self.by_marks and self.intervals:
            raise ConfigurationError("episodes are either at marks or listed")
        if self.at and self.at not in names:
            raise ConfigurationError(f"rows at the times of {self.at!r}: that is not joined")

    @property
    def limit_s(self) -> float:
        """Greatest distance in time of a joined row."""
        return 1 / self.fps if self.within_s is None else self.within_s


def interval_of(text: str) -> Interval:
    """Return the interval of ``START..END``, s since the recording began.

    Raises:
        ConfigurationError: the text has another form.
    """
    start, _, end = text.partition("..")
    return _interval(start, end, f"episode {text!r}")


def intervals_of_marks(source: TableSource, end_s: float) -> list[Interval]:
    """Return the episodes at the marks of a recording: from each to the next, or to the end.

    Args:
        end_s: time at which it ends, s since it began.
    """
    marks = [
        ((event["log_time_ns"] - source.start_ns) / NS_PER_S, str(event.get("text", "")))
        for event in source.events
        if event.get("event") == "mark"
    ]
    ends = [*(time_s for time_s, _ in marks[1:]), end_s]
    found = [
        Interval(max(0.0, begin_s), until_s, text or None)
        for (begin_s, text), until_s in zip(marks, ends, strict=False)
        if text != _END and until_s > max(0.0, begin_s)
    ]
    if not found:
        raise ConfigurationError(f"{source.path}: no mark in it begins an episode: press m in skin-view")
    return found


def read_intervals(path: Path) -> list[Interval]:
    """Read intervals from a CSV file with the columns ``start_s``, ``end_s``, and optionally ``task`` and ``file``.

    Raises:
        ConfigurationError: it has other columns or contents.
        OSError: it cannot be read.
    """
    with path.open(newline="", encoding="utf-8-sig") as stream:
        reader = csv.DictReader(stream)
        head = reader.fieldnames or ()
        unknown = [name for name in head if name not in _COLUMNS]
        if unknown or not {"start_s", "end_s"} <= set(head):
            raise ConfigurationError(f"{path}: its first line must be start_s,end_s and may have task,file: not {head}")
        return [
            _interval(row["start_s"], row["end_s"], f"{path}, line {reader.line_num}")._replace(
                task=row.get("task") or None, file=row.get("file") or ""
            )
            for row in reader
        ]


def join_of(text: str) -> Join:
    """Return the join of ``FEATURE=FILE`` or ``FEATURE=FILE:COLUMN,COLUMN``.

    Raises:
        ConfigurationError: the text has another form.
    """
    feature, is_one, rest = text.partition("=")
    if not is_one or not rest:
        raise ConfigurationError(f"{text!r} is not FEATURE=FILE, as in observation.state=joints.csv")
    path, has_columns, columns = rest.rpartition(":")
    if not has_columns or "/" in columns:  # a colon in a path
        return Join(feature, Path(rest))
    return Join(feature, Path(path), tuple(columns.split(",")))


def _interval(start: str | None, end: str | None, where: str) -> Interval:
    try:
        start_s, end_s = float(start or ""), float(end or "")
    except ValueError:
        start_s = end_s = math.nan
    if not 0 <= start_s < end_s < math.inf:
        raise ConfigurationError(f"{where} is not START..END in seconds, the end after the start")
    return Interval(start_s, end_s)


TIMES = ("time_ns", "unix_s", "monotonic_ns", "time_s")
"""Names of a column of times: wall clock in ns or s since 1970, CLOCK_MONOTONIC of the machine that recorded, s since
the recording began."""
_OF_ONE_RECORDING = ("monotonic_ns", "time_s")
_VIDEOS = (".mp4", ".mkv", ".avi", ".webm", ".mov")


class Joined:
    """Data for a feature: rows of numbers, or paths of images, each with its time.

    Attributes:
        rows: (m, n) float32; (m,) text for paths.
    """

    def __init__(self, join: Join) -> None:
        self.name, self.path = join.feature, join.path
        with contextlib.closing(open_source(join.path)) as source:
            timed = [(table, name) for table, names in source.tables.items() for name in TIMES if name in names]
            if len(timed) != 1:
                raise ConfigurationError(f"{self.path}: one column must have the time, as one of: {', '.join(TIMES)}")
            [(table, self._time)] = timed
            known = [*source.tables[table], *source.left_out]
            chosen = join.columns or tuple(name for name in known if name != self._time)
            for name in chosen:
                if name not in known:
                    raise ConfigurationError(f"{self.path}: no column {name!r}{nearest_name(name, known)}")
            columns = whole(source, table, [self._time, *chosen])
        self._times = columns.pop(self._time).ravel()
        if not np.isfinite(self._times.astype(np.float64)).all():
            raise ConfigurationError(f"{self.path}: {self._time} is not numbers")
        self.names, self.rows = self._joined(columns)
        backward = np.flatnonzero(np.diff(self._times) < 0)
        if len(backward):
            raise ConfigurationError(f"{self.path}: time goes back after row {backward[0] + 1}")

    def times_ns(self, source: TableSource, *, is_only: bool) -> npt.NDArray[np.int64]:
        """Return the time of each row, (m,) ns since 1970, on the axis of the recording."""
        if self._time in _OF_ONE_RECORDING and not is_only:
            raise ConfigurationError(
                f"{self.path}: {self._time} is of one recording: with several, give time_ns or unix_s"
            )
        if self._time == "time_ns":
            return self._on_axis(self._times.astype(np.int64), source)
        if self._time == "monotonic_ns":
            ahead = [each["log_time_ns"] - each["monotonic_ns"] for each in source.clock if "monotonic_ns" in each]
            if not ahead:
                raise ConfigurationError(
                    f"{source.path}: has no readings of clocks: {self.path} needs time_ns or unix_s"
                )
            return self._times.astype(np.int64) + int(ahead[0])
        if self._time == "unix_s":  # floats have it to a quarter of a microsecond
            since_ns = self._on_axis(np.rint(self._times * 1e6).astype(np.int64) * 1000, source)
        else:
            since_ns = source.start_ns + np.rint(self._times * NS_PER_S).astype(np.int64)
        return since_ns

    def _on_axis(self, wall_ns: npt.NDArray[np.int64], source: TableSource) -> npt.NDArray[np.int64]:
        """Return times of the wall clock on the axis of the recording, (m,)."""
        readings = sorted((each["realtime_ns"], each["log_time_ns"]) for each in source.clock if "realtime_ns" in each)
        if not readings:
            return wall_ns
        wall, axis = np.array(readings, np.int64).T
        at = np.maximum(np.searchsorted(wall, wall_ns, side="right") - 1, 0)
        on_axis: npt.NDArray[np.int64] = wall_ns + (axis - wall)[at]
        return on_axis

    def _joined(self, columns: Rows) -> tuple[list[str], npt.NDArray[Any]]:
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
        if not names:
            raise ConfigurationError(f"{self.path}: no columns of numbers")
        return names, np.concatenate(parts, axis=1)

    def _image(self, text: str) -> str:
        if text.lower().endswith(_VIDEOS):
            raise ConfigurationError(f"{self.path}: {text}: videos are not joined: give a PNG file for each time")
        return str(self.path.parent / text)


def matched(
    times_ns: npt.NDArray[np.int64],
    at_ns: npt.NDArray[np.int64],
    match: Match,
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
