"""Read the values that a viewer of recordings plots from their files: every sample, at its time in the recording."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TYPE_CHECKING, Any, NamedTuple

from skinware.errors import SkinwareError
from skinware.realtime import NS_PER_S
from skinware.structure import Structure
from skinware.views.following import Follower, ShownDriver
from skinware.views.looks import Line
from skinware.views.plots import PlotBlock, PlotRows, Values, values_of

if TYPE_CHECKING:
    from skinware.recording import Recording
    from skinware.views.shows import PlayedRecording

_BEFORE_S = 60.0
"""So much of a recording before the moment that is shown can be plotted."""
_AHEAD_S, _SOON_S = 3.0, 1.0
"""So much after it is read too, once less than the second is left."""

Stretch = tuple[float, float]


class _Part(NamedTuple):
    """Lines of one service, and the stretch of its recording to read; ``begins``: without what was read before."""

    played: PlayedRecording
    service: str
    of: str
    lines: dict[int, Line]
    stretch: Stretch
    begins: bool


class RecordedPlots:
    """The lines of one viewer of recordings; ``has_news``: values wait for a turn."""

    missed = 0

    def __init__(self, follower: Follower, played: Sequence[PlayedRecording]) -> None:
        self.has_news = False
        self._follower, self._played = follower, {one.title: one for one in played}
        self._number = self._edition = 0
        self._lines: list[Line] = []
        self._read: dict[Line, Stretch] = {}
        self._blocks: deque[PlotBlock] = deque()
        self._recordings: dict[str, Recording] = {}
        self._reading = ThreadPoolExecutor(1, "skinware plots")
        self._job: Future[None] | None = None
        self._is_over = False

    def choose(self, number: int, lines: list[Line], edition: int) -> None:
        """Send the values of lines of this edition from now on; those of new lines from a minute before."""
        same = edition == self._edition
        self._number, self._lines, self._edition = number, lines, edition
        self._read = {line: stretch for line, stretch in self._read.items() if same and line in lines}

    def take(self) -> None:
        """Read what is missing around the moments that are shown; one job at a time."""
        self.has_news = bool(self._blocks)
        if self._job is not None and self._job.done():
            self._job.result()
            self._job = None
        if self._job is None and self._lines and self._follower.edition == self._edition:
            parts = list(self._missing())
            if parts:
                self._job = self._reading.submit(self._read_parts, parts, self._number)

    def blocks(self) -> list[PlotBlock]:
        found = [self._blocks.popleft() for _ in range(len(self._blocks))]
        self.has_news = False
        return found

    def close(self) -> None:
        self._is_over = True
        self._reading.shutdown()
        for recording in self._recordings.values():
            recording.close()

    def _missing(self) -> Iterator[_Part]:
        parts: dict[tuple[str, str, str, Stretch], _Part] = {}
        for at, line in enumerate(self._lines):
            driver = self._follower.get(line.driver)
            played = None if driver is None else self._played.get(driver.origin.recording or "")
            source = None if driver is None else _source_of(driver, line)
            if played is None or source is None:
                continue
            now_s, duration_s = played.state["time_s"], played.state["duration_s"]
            first_s, last_s = max(0.0, now_s - _BEFORE_S), min(now_s + _AHEAD_S, duration_s)
            known = self._read.get(line)
            if known is not None and known[0] <= first_s and min(now_s + _SOON_S, duration_s) <= known[1]:
                continue
            follows = known is not None and known[0] <= first_s <= known[1]
            stretch = (known[1] if known is not None and follows else first_s, last_s)
            self._read[line] = (known[0] if known is not None and follows else first_s, last_s)
            new = _Part(played, *source, {}, stretch, not follows)
            parts.setdefault((played.title, *source, stretch), new).lines[at] = line
        yield from parts.values()

    def _read_parts(self, parts: Sequence[_Part], number: int) -> None:
        for part in parts:
            if self._is_over:
                return
            drivers = [driver for line in part.lines.values() if (driver := self._follower.get(line.driver))]
            if not drivers:
                continue
            values = values_of(part.of, list(part.lines.values()), drivers[0], self._follower.functions)
            rows = PlotRows()
            try:
                self._read_rows(part, _fits(None if part.of == "contacts" else drivers[0].structure), values, rows)
            except (SkinwareError, OSError):  # the replay reports it
                continue
            self._blocks.append(rows.block(number, part.of, list(part.lines), begins=part.begins))

    def _read_rows(
        self, part: _Part, fits: Callable[[Any], bool], values: Callable[[list[Any]], Values], rows: PlotRows
    ) -> None:
        title, (first_s, last_s) = part.played.title, part.stretch
        recording = self._recordings.get(title)
        if recording is None:
            import skinware.recording

            recording = self._recordings.setdefault(title, skinware.recording.open(part.played.file))
        track, is_end = recording[part.service], last_s >= recording.duration_s
        for contents in recording.chunks({track.channel}, first_s, None if is_end else last_s):
            samples = track.samples_in(contents)
            taken = [(t, s) for t, s in samples if first_s <= t and (is_end or t < last_s) and fits(s)]
            found = values([sample for _, sample in taken]) if taken else ()
            for (time_s, sample), row in zip(taken, found, strict=True):
                rows.add(sample.position, round(time_s * NS_PER_S), row)
            if self._is_over:
                return


def _source_of(driver: ShownDriver, line: Line) -> tuple[str, str] | None:
    """Return the service that has the values of a line, and what it is."""
    if line.contact is None:
        return driver.live.name, "driver" if line.function is None else "function"
    reader = driver.origin.contacts_reader(driver.live.name)
    return None if reader is None else (reader.name, "contacts")


def _fits(structure: Structure | None) -> Callable[[Any], bool]:
    """Return a function of samples: whether they have the sensors of a structure; True without one."""
    known: dict[int, bool] = {}

    def fits(sample: Any) -> bool:
        key = id(sample.context)
        if key not in known:
            known[key] = structure is None or sample.context == structure
        return known[key]

    return fits
