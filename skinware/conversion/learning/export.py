"""Recordings as a learning set: planned from times, then written a little at a time."""

from __future__ import annotations

import contextlib
import json
import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from skinware.conversion._packages import pyarrow
from skinware.conversion.converting import Converted, Watched, begun_beside, new_target, opened
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
from skinware.conversion.learning.joined import Joined
from skinware.conversion.learning.timing import Episode, Planner, TimedTable
from skinware.conversion.learning.wanted import Interval, LearningSet
from skinware.conversion.selection import Selection
from skinware.conversion.tables import Source, sensor_table
from skinware.errors import ConfigurationError
from skinware.realtime import NS_PER_S

LEARNING_FORMATS = {"lerobot": "-lerobot"}
"""Suffix of the folders of each format."""

_BATCH_BYTES = 16 << 20
_BYTES_PER_SENSOR = 4 + 1 + 4
"""Of values, status, and what they are made of."""


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
        paths: recordings, or files that were made of some; they are only read.
        target: the new folder, at which nothing may be; None: beside the first recording.
        wanted: how it is made.
        selection: which drivers, and which of their sensors; None: all.
        start_s: where to begin in each recording, s since it began.
        end_s: where to end, likewise; None: at its end.
        is_stopped: asked now and then; True ends it with :class:`KeyboardInterrupt`, and nothing is written.

    Raises:
        BadRecording: a file is not a recording, or of a newer version, or cannot be read.
        ConfigurationError: what is asked for is not there, or not at that time, or not one dataset.
        MissingExtra: a package of the extra ``convert`` is not installed.
        OSError: a file cannot be read, or the new one cannot be written.
    """
    pyarrow()
    target = new_target(paths[0], target, LEARNING_FORMATS["lerobot"])
    joined = [Joined(join) for join in wanted.joins]
    with contextlib.ExitStack() as stack:
        sources: list[Source] = []
        for path in paths:
            whole = stack.enter_context(contextlib.closing(opened(path, start_s, end_s)))
            sources.append(Watched((selection or Selection()).of(whole), is_stopped))
        notes: list[str] = []
        sets = _sets(sources, wanted, joined, notes)
        frames: Counter[str] = Counter()
        with begun_beside(target) as begun:
            for number, episodes in enumerate(sets, 1):
                folder = begun / str(number) if wanted.each_structure else begun
                _Set(sources, wanted, joined, episodes).write(folder)
                for episode in episodes:
                    frames.update(dict.fromkeys(episode.frames, len(episode)))
        notes = [*(problem for source in sources for problem in source.problems), *notes]
        return Converted(target, frames, notes, sum(map(len, sets)))


def _sets(
    sources: Sequence[Source], wanted: LearningSet, joined: Sequence[Joined], notes: list[str]
) -> list[list[Episode]]:
    """The episodes of each dataset: those whose drivers have the same structures."""
    asked = _intervals(sources, wanted)
    sets: list[list[Episode]] = []
    drivers: frozenset[str] | None = None
    for number, source in enumerate(sources):
        if wanted.intervals and not asked[number]:
            notes.append(f"{source.path}: no episode is in it")
            continue
        times = [(each, each.times_ns(source, is_only=len(sources) == 1)) for each in joined]
        planner = Planner(number, source, wanted, times)
        if drivers not in (None, planner.drivers):
            there_are = ", ".join(sorted(planner.drivers))
            raise ConfigurationError(f"{source.path}: other drivers than the first recording ({there_are}): name some")
        drivers = planner.drivers
        for episode in planner.episodes(asked[number], wanted.task or source.path.stem):
            for others in sets:
                if others[0].piece.structures == episode.piece.structures:
                    others.append(episode)
                    break
            else:
                sets.append([episode])
        notes += planner.notes
        left_out = sorted({table.service for table in source.tables if table.structure is None})
        notes += [f"{source.path}: {name} is left out: it has no sensors" for name in left_out]
    if len(sets) > 1 and not wanted.each_structure:
        first = sources[sets[1][0].recording]
        when_s = (int(sets[1][0].times_ns[0]) - first.start_ns) / NS_PER_S
        raise ConfigurationError(
            f"{first.path}: a driver has another structure from {when_s:.3f} s on than before: --each-structure"
        )
    return sets


def _intervals(sources: Sequence[Source], wanted: LearningSet) -> list[list[Interval]]:
    """The intervals that are asked for of each recording."""
    asked: list[list[Interval]] = [[] for _ in sources]
    for interval in wanted.intervals:
        if not interval.file and len(sources) > 1:
            raise ConfigurationError(
                f"the episode {interval} does not tell of which recording: give them in a CSV file with the column file"
            )
        found = [
            number
            for number, source in enumerate(sources)
            if not interval.file or interval.file in (str(source.path), source.path.name)
        ]
        if len(found) != 1:
            raise ConfigurationError(
                f"the episode {interval} is of {interval.file!r}: that is not the name of one of the recordings"
            )
        asked[found[0]].append(interval)
    return asked


class _Set:
    """A dataset that is written.

    Args:
        sources: the recordings.
        wanted: how it is made.
        joined: what is joined.
        episodes: of it, by recording and time.
    """

    def __init__(
        self, sources: Sequence[Source], wanted: LearningSet, joined: Sequence[Joined], episodes: Sequence[Episode]
    ) -> None:
        self._sources, self._wanted, self._episodes = sources, wanted, episodes
        self._tables = {name: episodes[0].piece.tables[name] for name in sorted(episodes[0].piece.tables)}
        self._windows = {name: self._window(name) for name in self._tables}
        self._skins = {
            name: SkinFeatures(
                name,
                timed.structure,
                timed.table.sensor_names,
                self._windows[name],
                timed.table.origin.period_ns,
            )
            for name, timed in self._tables.items()
        }
        self._joined = [JoinedFeature(each) for each in joined]
        self._features: dict[str, Feature] = {}
        for described in (*(skin.descriptions for skin in self._skins.values()), self._joined_descriptions()):
            for name, feature in described.items():
                if name in self._features:
                    raise ConfigurationError(f"two features are both {name!r}")
                self._features[name] = feature

    def write(self, folder: Path) -> None:
        """Write it into a folder, which is made."""
        writer = DatasetWriter(folder, self._wanted.fps, self._features, [len(each) for each in self._episodes])
        try:
            readers: dict[TimedTable, Frames] = {}
            for episode in self._episodes:
                readers = {
                    timed: readers.get(timed) or Frames(timed.table, self._windows[name])
                    for name, timed in episode.piece.tables.items()
                }
                writer.add_episode(episode.task, len(episode), self._batches(episode, readers))
            writer.finish()
        finally:
            writer.close()
        self._write_beside(folder / "meta" / "skin")

    def _window(self, name: str) -> int:
        """Of how many frames of a driver rows have the values."""
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
                wanted = newest[:, np.newaxis] + np.arange(1 - self._windows[name], 1)
                numbers, of_rows = np.unique(wanted, return_inverse=True)
                frames = readers[episode.piece.tables[name]].take(numbers)
                batch |= skin.rows(frames, of_rows.reshape(wanted.shape), episode.times_ns[part])
            yield batch | joined_rows(self._joined, episode.joined, part)

    def _joined_descriptions(self) -> dict[str, Feature]:
        return {each.name: each.description for each in self._joined}

    def _write_beside(self, folder: Path) -> None:
        """What LeRobot does not know: where sensors are, and when each episode was."""
        arrow = pyarrow()
        folder.mkdir()
        for name, timed in self._tables.items():
            path = folder / f"{name.replace('/', '_')}.sensors.parquet"
            arrow.parquet.write_table(arrow.table(sensor_table(timed.table)), path)
        told = [
            {"episode": number, "file": self._sources[each.recording].path.name, "start_ns": int(each.times_ns[0])}
            for number, each in enumerate(self._episodes)
        ]
        (folder / "episodes.json").write_text(json.dumps(told, indent=1) + "\n", encoding="utf-8")
