"""Write recordings as a learning set, planned from times and then written a few rows at a time."""

from __future__ import annotations

import contextlib
import json
import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from skinware.conversion.converting import Converted, begun_beside, new_target
from skinware.conversion.learning.dataset import DatasetWriter
from skinware.conversion.learning.features import (
    IMAGE,
    Batch,
    Feature,
    Frames,
    JoinedFeature,
    SkinFeatures,
    joined_rows,
)
from skinware.conversion.learning.forms import SetForm
from skinware.conversion.learning.timing import Episode, Planner, TimedTable
from skinware.conversion.learning.wanted import Interval, Joined, LearningSet, intervals_of_marks
from skinware.conversion.tables import RecordedSource, Selection, Table, TableSource, pyarrow, sensor_table
from skinware.errors import ConfigurationError
from skinware.realtime import NS_PER_S
from skinware.structure import Structure

LEARNING_FORMATS = {"lerobot": "-lerobot"}
"""Suffix of the folders of each format."""

_MISSING = 1.5
"""Values are interpolated between samples that are at most so many periods apart."""
_BATCH_BYTES = 16 << 20
_BYTES_PER_SENSOR = 4 + 1 + 4
"""Bytes of a sensor's value, status and raw value."""


def convert_to_learning_set(
    paths: Sequence[Path],
    target: Path | None,
    wanted: LearningSet,
    selection: Selection | None = None,
    *,
    start_s: float = 0.0,
    end_s: float | None = None,
    is_stopped: Callable[[], bool] = lambda: False,
) -> Converted:
    """Write a LeRobot dataset (format v3.0) of recordings.

    Args:
        paths: recordings; they are only read.
        target: the new folder, which must not exist; None: beside the first recording.
        selection: the drivers and sensors to convert; None: all.
        start_s: begin at this time in each recording, s since it began.
        end_s: end before this time; None: at the end of each recording.
        is_stopped: called now and then; True ends it with :class:`KeyboardInterrupt` and leaves no folder.

    Raises:
        BadRecording: a file is not a recording, or of a newer version, or cannot be read.
        ConfigurationError: what is asked for is not there, or not at that time, or not one dataset.
        MissingExtra: a package of the extra ``convert`` is not installed.
        OSError: a file cannot be read, or the new one cannot be written.
    """
    pyarrow()
    target = new_target(paths[0], target, LEARNING_FORMATS["lerobot"])
    joined = [Joined(join) for join in wanted.joins]

    def open_one(path: Path) -> TableSource:
        return RecordedSource(path, start_s, end_s, selection, is_stopped)

    notes: list[str] = []
    frames: Counter[str] = Counter()
    with contextlib.closing(_Recordings(paths, open_one)) as recordings:
        episodes = _episodes(recordings, wanted, joined, notes)
        with begun_beside(target) as begun:
            notes += _Set(recordings, wanted, joined, episodes).write(begun)
        for episode in episodes:
            frames.update(dict.fromkeys(episode.frames, len(episode)))
    return Converted(target, frames, notes, len(episodes))


class _Recordings:
    """Recordings, of which one is open at a time: what a large skin is made of takes 20 MB in each."""

    def __init__(self, paths: Sequence[Path], open_one: Callable[[Path], TableSource]) -> None:
        self.paths, self._open_one = paths, open_one
        self._opened: tuple[int, TableSource] | None = None

    def source(self, number: int) -> TableSource:
        if self._opened is None or self._opened[0] != number:
            self.close()
            self._opened = number, self._open_one(self.paths[number])
        return self._opened[1]

    def table(self, number: int, name: str) -> Table:
        (found,) = (table for table in self.source(number).tables if table.name == name)
        return found

    def close(self) -> None:
        if self._opened is not None:
            (_, source), self._opened = self._opened, None
            source.close()


def _episodes(
    recordings: _Recordings, wanted: LearningSet, joined: Sequence[Joined], notes: list[str]
) -> list[Episode]:
    asked = _intervals(recordings.paths, wanted)
    episodes: list[Episode] = []
    structures: list[Structure] = []
    drivers: frozenset[str] | None = None
    for number, path in enumerate(recordings.paths):
        if wanted.intervals and not asked[number]:
            notes.append(f"{path}: no episode is in it")
            continue
        source = recordings.source(number)
        times = [(each, each.times_ns(source, is_only=len(recordings.paths) == 1)) for each in joined]
        planner = Planner(number, source, wanted, times, structures)
        if wanted.by_marks:
            asked[number] = intervals_of_marks(source, planner.end_s)
        if drivers not in (None, planner.drivers):
            there_are = ", ".join(sorted(planner.drivers))
            raise ConfigurationError(f"{source.path}: other drivers than the first recording ({there_are}): name some")
        drivers = planner.drivers
        for episode in planner.episodes(asked[number], wanted.task or path.stem):
            episodes.append(episode)
            if episode.piece.structures != episodes[0].piece.structures:
                when_s = (int(episode.times_ns[0]) - source.start_ns) / NS_PER_S
                raise ConfigurationError(
                    f"{path}: a driver has another structure from {when_s:.3f} s on than before: make another set of it"
                )
        notes += [*source.problems, *planner.notes]
        left_out = sorted({table.service for table in source.tables if table.structure is None})
        notes += [f"{source.path}: {name} is left out: it has no sensors" for name in left_out]
    return episodes


def _intervals(paths: Sequence[Path], wanted: LearningSet) -> list[list[Interval]]:
    asked: list[list[Interval]] = [[] for _ in paths]
    for interval in wanted.intervals:
        if not interval.file and len(paths) > 1:
            raise ConfigurationError(
                f"the episode {interval} does not name its recording: list episodes in a CSV file with the column file"
            )
        found = [
            number for number, path in enumerate(paths) if not interval.file or interval.file in (str(path), path.name)
        ]
        if len(found) != 1:
            raise ConfigurationError(
                f"the episode {interval} is of {interval.file!r}: that is not the name of one of the recordings"
            )
        asked[found[0]].append(interval)
    return asked


class _Set:
    def __init__(
        self, recordings: _Recordings, wanted: LearningSet, joined: Sequence[Joined], episodes: Sequence[Episode]
    ) -> None:
        self._recordings, self._wanted, self._episodes = recordings, wanted, episodes
        self._reach = int(wanted.resample == "linear")
        first = episodes[0]
        self._tables = {name: first.piece.tables[name] for name in sorted(first.piece.tables)}
        self._windows = {name: self._window(name) for name in self._tables}
        self._skins: dict[str, SkinFeatures] = {}
        self._sensors: dict[str, dict[str, npt.NDArray[Any]]] = {}
        for name, timed in self._tables.items():
            table = recordings.table(first.recording, timed.name)
            names, window = table.sensor_names, self._windows[name]
            longest_ns = round(_MISSING * NS_PER_S / timed.rate_hz) if self._reach and timed.rate_hz else 0
            self._skins[name] = SkinFeatures(name, timed.structure, names, window, timed.period_ns, longest_ns)
            self._sensors[name] = sensor_table(table)
        self._joined = [JoinedFeature(each) for each in joined]
        self._features: dict[str, Feature] = {}
        of_joined = {each.name: each.description for each in self._joined}
        for described in (*(skin.descriptions for skin in self._skins.values()), of_joined):
            for name, feature in described.items():
                if name in self._features:
                    raise ConfigurationError(f"two features are both {name!r}")
                self._features[name] = feature
        self._form: SetForm | None = None
        if wanted.form != "tactile":
            self._form = SetForm(wanted, {name: timed.structure for name, timed in self._tables.items()})
            self._features = self._form.described(self._features)

    def write(self, folder: Path) -> list[str]:
        lengths, video = [len(each) for each in self._episodes], self._wanted.video
        writer = DatasetWriter(folder, self._wanted.fps, self._features, lengths, video=video)
        try:
            readers: dict[TimedTable, Frames] = {}
            for episode in self._episodes:
                readers = {
                    timed: readers.get(timed)
                    or Frames(
                        self._recordings.table(episode.recording, timed.name),
                        timed.recorded_ns,
                        self._windows[name] + self._reach,
                    )
                    for name, timed in episode.piece.tables.items()
                }
                writer.add_episode(episode.task, len(episode), self._batches(episode, readers))
            writer.finish()
        finally:
            writer.close()
        self._write_beside(folder / "meta" / "skin")
        counts = {name: skin.interpolated for name, skin in self._skins.items() if self._reach}
        return [f"{name}: {count} of {sum(lengths)} rows are interpolated" for name, count in counts.items()]

    def _window(self, name: str) -> int:
        windows = {episode.piece.tables[name].window(self._wanted) for episode in self._episodes}
        if len(windows) > 1:
            raise ConfigurationError(f"{name} was recorded at different rates: say how many frames a row has: --window")
        return windows.pop()

    def _batches(self, episode: Episode, readers: Mapping[TimedTable, Frames]) -> Iterator[Batch]:
        row_bytes = sum(
            timed.structure.n_sensors * self._windows[name] * _BYTES_PER_SENSOR for name, timed in self._tables.items()
        )
        row_bytes += sum(math.prod(each.shape) for each in self._features.values() if each.dtype == IMAGE)
        step = max(1, _BATCH_BYTES // row_bytes)
        for first in range(0, len(episode), step):
            part = slice(first, first + step)
            batch: Batch = {}
            for name, skin in self._skins.items():
                newest = episode.frames[name][part]
                wanted = newest[:, np.newaxis] + np.arange(1 - self._windows[name], 1 + self._reach)
                wanted = np.minimum(wanted, len(episode.piece.tables[name].times_ns) - 1)
                numbers, of_rows = np.unique(wanted, return_inverse=True)
                frames = readers[episode.piece.tables[name]].take(numbers)
                batch |= skin.rows(frames, of_rows.reshape(wanted.shape), episode.times_ns[part])
            batch |= joined_rows(self._joined, episode.joined, part)
            yield batch if self._form is None else self._form.rows(batch)

    def _write_beside(self, folder: Path) -> None:
        """Write what LeRobot's format lacks: the places of sensors, and the time of each episode."""
        arrow = pyarrow()
        folder.mkdir()
        for name, sensors in self._sensors.items():
            arrow.parquet.write_table(arrow.table(sensors), folder / f"{name.replace('/', '_')}.sensors.parquet")
        of_all = {"resample": self._wanted.resample}
        times = [
            {"episode": number, "file": self._recordings.paths[each.recording].name, "start_ns": int(each.times_ns[0])}
            | of_all
            for number, each in enumerate(self._episodes)
        ]
        (folder / "episodes.json").write_text(json.dumps(times, indent=1) + "\n", encoding="utf-8")
