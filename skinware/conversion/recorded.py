"""A recording as a source of tables."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from skinware.conversion.tables import COLUMNS, Block, Span, Table
from skinware.realtime import NS_PER_S
from skinware.recording.reading import Recording
from skinware.recording.tracks import Track


class RecordedTable(Table):
    """A part of what was recorded of a service."""

    def __init__(self, name: str, part: Track, recording: Recording, span: Span) -> None:
        super().__init__(name, part.name, part.generations)
        self._part, self._start_ns, self._span = part, recording.start_ns, span

    def blocks(self, names: Collection[str]) -> Iterator[Block]:
        """See :class:`Table`."""
        columns = [name.removeprefix(COLUMNS) for name in names if name.startswith(COLUMNS)]
        start_s = (self._span.begin_ns - self._start_ns) / NS_PER_S
        end_s = (self._span.end_ns - self._start_ns) / NS_PER_S
        for series in self._part.blocks(columns, start_s=start_s, end_s=end_s):
            if len(series):
                yield {
                    "frames/time_ns": self._start_ns + np.rint(series.time_s * NS_PER_S).astype(np.int64),
                    "frames/generation": series.generation,
                    "frames/sequence": series.sequence,
                    "frames/acquired_ns": series.acquired_ns,
                    "frames/published_ns": series.published_ns,
                    "frames/flags": series.flags,
                    **{COLUMNS + name: series.column(name) for name in columns},
                }


class RecordedSource:
    """A recording.

    Args:
        path: of the file.
        start_s, end_s: what part of its time, s since it began; None: to its end.

    Raises:
        BadRecording: it is not one, or of a newer version.
        OSError: it cannot be read.
    """

    def __init__(self, path: Path, start_s: float, end_s: float | None) -> None:
        self.path = path
        self._recording = Recording(path)
        self.start_ns: int = self._recording.start_ns
        self._span = Span.of(self.start_ns, start_s, end_s)
        self.tables: Sequence[Table] = [
            table for name in self._recording.services for table in self._tables_of(self._recording[name])
        ]

    def _tables_of(self, track: Track) -> list[Table]:
        parts = track.parts
        if not parts:
            self._recording.note(f"frames of {track.name!r} left out: what they are made of is lost")
        names = [track.name if not number else f"{track.name}@{number + 1}" for number in range(len(parts))]
        return [RecordedTable(*each, self._recording, self._span) for each in zip(names, parts, strict=True)]

    @property
    def events(self) -> list[dict[str, Any]]:
        """See :class:`skinware.conversion.tables.Source`."""
        return self._in_span(self._recording.events)

    @property
    def clock(self) -> list[dict[str, Any]]:
        return self._in_span(self._recording.clock)

    @property
    def problems(self) -> list[str]:
        cut = [] if self._recording.is_whole else ["cut off or damaged: converted as far as it is whole"]
        wires = ["what went over wires is left out: candump and pcapng have it"] * bool(self._recording.wires)
        return [f"{self.path}: {problem}" for problem in [*cut, *self._recording.problems, *wires]]

    def close(self) -> None:
        self._recording.close()

    def _in_span(self, told: list[dict[str, Any]]) -> list[dict[str, Any]]:
        timed = []
        for each in told:
            time_ns = self.start_ns + round(each.pop("time_s") * NS_PER_S)
            if self._span.has(time_ns):
                timed.append({**each, "log_time_ns": time_ns})
        return timed
