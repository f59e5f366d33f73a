"""Define a learning set, from texts of a command line and CSV files."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

from skinware.errors import ConfigurationError

_COLUMNS = ("start_s", "end_s", "task", "file")
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
        feature: name of the feature.
        path: of the file.
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
        match: which joined row belongs to a row: the newest at or before its time, or the nearest.
        within_s: greatest distance of a joined row; None: the time between two rows.
        at: name of a joined feature whose times are those of the rows; empty: a row each 1 / fps.
        each_structure: write a set for each structure of the drivers, in folders; False: refuse several structures.
    """

    fps: int = 30
    task: str | None = None
    window: int = 1
    intervals: Sequence[Interval] = ()
    gap_s: float | None = None
    joins: Sequence[Join] = ()
    match: Literal["previous", "nearest"] = "previous"
    within_s: float | None = None
    at: str = ""
    each_structure: bool = False

    def __post_init__(self) -> None:
        if self.fps < 1 or self.window < 0:
            raise ConfigurationError(f"{self.fps} rows a second, {self.window} frames in each: that is no learning set")
        names = [join.feature for join in self.joins]
        for name in names:
            if not name or "/" in name or name in RESERVED or names.count(name) > 1:
                raise ConfigurationError(f"{name!r} cannot be the name of a joined feature, or is there twice")
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
