"""Plan the episodes of a learning set from times alone: which sample belongs to which row."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import numpy.typing as npt

from skinware.conversion.learning.wanted import Interval, Joined, LearningSet, Match, matched
from skinware.conversion.tables import TIME, Table, TableSource
from skinware.errors import BadRecording, ConfigurationError
from skinware.realtime import NS_PER_S
from skinware.structure import Structure

_FPS_TOLERANCE = 0.02
_MISSING = 1.5
"""Tolerance of a camera's rate; a distance of two images, in periods, above which one is missing."""
_CLOCK_ERROR_NS = 100_000_000
"""Error of the clocks' difference in a recorder that was held up; a larger step means that a clock was set."""

Times = npt.NDArray[np.int64]


class TimedTable:
    """The times of a driver's samples, as long as its structure stayed the same.

    Attributes:
        period_ns: the driver's nominal period, 0 if it has none.
        recorded_ns: (f,) time of publication of each sample, wall clock, as recorded.
        times_ns: (f,) the same, never going back.
    """

    def __init__(self, table: Table, structure: Structure) -> None:
        self.name, self.structure, self.period_ns = table.name, structure, table.origin.period_ns
        blocks = [np.zeros(0, np.int64), *(block[TIME] for block in table.blocks([TIME]))]
        self.recorded_ns: Times = np.concatenate(blocks)
        self.times_ns: Times = np.maximum.accumulate(self.recorded_ns)
        if (self.times_ns - self.recorded_ns > _CLOCK_ERROR_NS).any():
            raise BadRecording(f"{table.name}: the clock was set back while it was recorded: choose a part by its time")

    @property
    def rate_hz(self) -> float:
        """Nominal samples a second, or else as recorded; 0 for fewer than two samples."""
        if self.period_ns:
            return NS_PER_S / self.period_ns
        periods = np.diff(self.times_ns)
        return NS_PER_S / max(float(np.median(periods)), 1.0) if len(periods) else 0.0

    def window(self, wanted: LearningSet) -> int:
        return wanted.window or max(1, int(np.ceil(self.rate_hz / wanted.fps - 1e-3)))

    def runs(self, gap_s: float | None) -> Iterator[tuple[int, int]]:
        """Yield the numbers of the first sample of each run without a gap, and of the sample after it."""
        limit_ns = (1 << 62) if gap_s is None else round(gap_s * NS_PER_S)
        cuts = np.flatnonzero(np.diff(self.times_ns) > limit_ns) + 1
        edges = [0, *cuts.tolist(), len(self.times_ns)]
        yield from pairwise(edges)


@dataclass(frozen=True)
class Stretch:
    """A time in which all drivers ran, each with one structure.

    Attributes:
        begin_ns, end_ns: wall clock, both in it.
    """

    begin_ns: int
    end_ns: int
    tables: Mapping[str, TimedTable]

    @property
    def structures(self) -> tuple[Structure, ...]:
        return tuple(self.tables[name].structure for name in sorted(self.tables))


@dataclass(frozen=True)
class Episode:
    """Rows of a learning set that follow each other.

    Attributes:
        times_ns: (t,) of each row, wall clock.
        frames: by driver, (t,) number of each row's sample, or of the one before the row.
    """

    recording: int
    task: str
    times_ns: Times
    piece: Stretch
    frames: Mapping[str, Times]
    joined: Mapping[str, Times]

    def __len__(self) -> int:
        return len(self.times_ns)


class Planner:
    """Makes episodes of one recording.

    Args:
        structures: of the recordings before; those of this one are added. Equal ones are kept once: they can be large.

    Attributes:
        notes: a line for each thing that was left out.
    """

    def __init__(
        self,
        number: int,
        source: TableSource,
        wanted: LearningSet,
        joined: Sequence[tuple[Joined, Times]],
        structures: list[Structure],
    ) -> None:
        self._number, self._path, self._start_ns = number, source.path, source.start_ns
        self._wanted, self._joined = wanted, joined
        self._drivers: dict[str, list[TimedTable]] = {}
        for table in source.tables:
            if table.structure is not None:
                structure = next((each for each in structures if each == table.structure), table.structure)
                timed = TimedTable(table, structure)
                if len(timed.times_ns):
                    if structure is table.structure:
                        structures.append(structure)
                    self._drivers.setdefault(table.service, []).append(timed)
        if not self._drivers:
            raise ConfigurationError(f"{self._path}: no frames of a driver are in it: nothing to learn from")
        self.notes: list[str] = list(self._slow_drivers())

    @property
    def drivers(self) -> frozenset[str]:
        return frozenset(self._drivers)

    @property
    def end_s(self) -> float:
        """Time of the last sample of a driver, s since the recording began."""
        return self._seconds(max(int(timed.times_ns[-1]) for tables in self._drivers.values() for timed in tables))

    def episodes(self, intervals: Sequence[Interval], task: str) -> list[Episode]:
        """Return the episodes in some intervals, in order; without intervals those of the whole recording."""
        pieces = list(self._pieces())
        if not intervals:
            found = [self._episode(piece, piece.begin_ns, piece.end_ns, task) for piece in pieces]
            self._check_whole(pieces, "it")
            return [episode for episode in found if episode is not None] or self._nothing("in it")
        ordered = sorted(intervals)
        for one, other in pairwise(ordered):
            if other.start_s < one.end_s:
                raise ConfigurationError(f"{self._path}: the episodes {one} and {other} overlap")
        return [episode for interval in ordered for episode in self._in_interval(pieces, interval, task)]

    # -- pieces ---------------------------------------------------------------------------------------------------

    def _pieces(self) -> Iterator[Stretch]:
        pieces = [Stretch(0, 1 << 62, {})]
        for name, tables in self._drivers.items():
            pieces = [
                Stretch(max(piece.begin_ns, begin_ns), min(piece.end_ns, end_ns), {**piece.tables, name: timed})
                for piece in pieces
                for timed in tables
                for begin_ns, end_ns in self._spans(timed)
                if max(piece.begin_ns, begin_ns) <= min(piece.end_ns, end_ns)
            ]
        yield from sorted(pieces, key=lambda piece: piece.begin_ns)

    def _spans(self, timed: TimedTable) -> Iterator[tuple[int, int]]:
        """Yield the times of the first row with a whole window, and of the last one, of each run."""
        more = timed.window(self._wanted) - 1
        for first, end in timed.runs(self._wanted.gap_s):
            if first + more < end:
                yield int(timed.times_ns[first + more]), int(timed.times_ns[end - 1])

    def _check_whole(self, pieces: Sequence[Stretch], where: str) -> None:
        changed = [piece for before, piece in pairwise(pieces) if piece.structures != before.structures]
        if changed:
            when = ", ".join(f"{self._seconds(piece.begin_ns):.3f} s" for piece in changed)
            raise ConfigurationError(
                f"{self._path}: the structure of a driver changes in {where}, at {when}: choose a part by its time"
            )

    # -- episodes -------------------------------------------------------------------------------------------------

    def _in_interval(self, pieces: Sequence[Stretch], interval: Interval, task: str) -> list[Episode]:
        begin_ns, end_ns = self._moment(interval.start_s), self._moment(interval.end_s) - 1
        inside = [piece for piece in pieces if piece.begin_ns <= end_ns and piece.end_ns >= begin_ns]
        self._check_whole(inside, f"the episode {interval}")
        task = interval.task or task
        made = [
            self._episode(piece, max(begin_ns, piece.begin_ns), min(end_ns, piece.end_ns), task) for piece in inside
        ]
        episodes = [episode for episode in made if episode is not None]
        if not episodes:
            return self._nothing(f"in the episode {interval}")
        period_ns = NS_PER_S / self._wanted.fps
        late_ns = int(episodes[0].times_ns[0]) - begin_ns
        early_ns = end_ns - int(episodes[-1].times_ns[-1])
        if late_ns > period_ns or early_ns > 2 * period_ns:
            self.notes.append(
                f"{self._path}: the episode {interval} begins {max(late_ns, 0) / NS_PER_S:.3f} s later and ends"
                f" {max(early_ns, 0) / NS_PER_S:.3f} s earlier: not all of it was recorded"
            )
        return episodes

    def _episode(self, piece: Stretch, begin_ns: int, end_ns: int, task: str) -> Episode | None:
        limit_ns = round(self._wanted.limit_s * NS_PER_S)
        for _, times_ns in self._joined:
            begin_ns, end_ns = max(begin_ns, int(times_ns[0])), min(end_ns, int(times_ns[-1]) + limit_ns)
        rows_ns = self._rows(begin_ns, end_ns)
        if not len(rows_ns):
            return None
        match: Match = "nearest" if self._wanted.resample == "nearest" else "previous"
        frames = {name: matched(timed.times_ns, rows_ns, match, 1 << 62) for name, timed in piece.tables.items()}
        joined = {each.name: self._matched(each, times_ns, rows_ns, limit_ns) for each, times_ns in self._joined}
        return Episode(self._number, task, rows_ns, piece, frames, joined)

    def _rows(self, begin_ns: int, end_ns: int) -> Times:
        fps = self._wanted.fps
        if self._wanted.at:
            ((each, times_ns),) = [both for both in self._joined if both[0].name == self._wanted.at]
            times_ns = times_ns[(times_ns >= begin_ns) & (times_ns <= end_ns)]
            self._check_rate(each.path, times_ns)
            return times_ns
        count = (end_ns - begin_ns) * fps // NS_PER_S + 1 if end_ns >= begin_ns else 0
        return begin_ns + (np.arange(count) * NS_PER_S + fps // 2) // fps

    def _check_rate(self, path: Path, times_ns: Times) -> None:
        periods = np.diff(times_ns) * (self._wanted.fps / NS_PER_S)
        if not len(periods):
            return
        rate_hz = self._wanted.fps / max(float(np.median(periods)), 1e-9)
        if abs(rate_hz / self._wanted.fps - 1) > _FPS_TOLERANCE:
            raise ConfigurationError(
                f"{path}: {rate_hz:.4g} times a second, but the set has {self._wanted.fps}: --fps {rate_hz:.0f}"
            )
        missing = np.flatnonzero(periods > _MISSING)
        if len(missing):
            when_s = self._seconds(int(times_ns[missing[0]]))
            raise ConfigurationError(f"{path}: a time is missing after {when_s:.3f} s: end an episode there")

    def _matched(self, each: Joined, times_ns: Times, rows_ns: Times, limit_ns: int) -> Times:
        rows = matched(times_ns, rows_ns, self._wanted.match, limit_ns)
        missing = np.flatnonzero(rows < 0)
        if len(missing):
            where = "at or before" if self._wanted.match == "previous" else "near"
            raise ConfigurationError(
                f"{each.path}: nothing within {self._wanted.limit_s:.3g} s {where} {len(missing)} of {len(rows)} rows,"
                f" the first at {self._seconds(int(rows_ns[missing[0]])):.3f} s of {self._path}: end an episode there,"
                " or --within more"
            )
        return rows

    def _nothing(self, where: str) -> list[Episode]:
        spans = [
            f"{name} from {self._seconds(int(tables[0].times_ns[0])):.3f} to"
            f" {self._seconds(int(tables[-1].times_ns[-1])):.3f} s"
            for name, tables in self._drivers.items()
        ]
        spans += [
            f"{each.path} from {self._seconds(int(times_ns[0])):.3f} to {self._seconds(int(times_ns[-1])):.3f} s"
            for each, times_ns in self._joined
        ]
        raise ConfigurationError(f"{self._path}: no time {where} has all the data asked for: {', '.join(spans)}")

    def _slow_drivers(self) -> Iterator[str]:
        for name, tables in self._drivers.items():
            rate_hz = min((timed.rate_hz for timed in tables if timed.rate_hz), default=0.0)
            if rate_hz and rate_hz < self._wanted.fps / 1.05:
                yield (
                    f"{self._path}: {name} publishes {rate_hz:.4g} frames a second: at {self._wanted.fps} rows a second"
                    " some are there twice"
                )

    def _moment(self, seconds: float) -> int:
        return self._start_ns + round(seconds * NS_PER_S)

    def _seconds(self, time_ns: int) -> float:
        return (time_ns - self._start_ns) / NS_PER_S
