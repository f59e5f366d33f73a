"""Go through the moments of a recording, forward and back, and find the state at any of them."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Collection, Iterable, Mapping
from concurrent.futures import Executor, Future
from itertools import accumulate
from typing import TYPE_CHECKING, NamedTuple

from skinware.transfer.collecting import CLOSED, DEAD
from skinware.transfer.generation import RecordedSample

if TYPE_CHECKING:
    from skinware.recording.reading import Recording

GONE = (CLOSED, DEAD)
_KEPT_CHUNKS = 3


class Moment(NamedTuple):
    """A sample, or an event of a service.

    Attributes:
        time_s: since the recording began.
        event: ``paused``, ``live``, ``closed`` or ``dead``; empty for a sample.
    """

    time_s: float
    service: str
    frame: RecordedSample | None
    event: str = ""


class Timeline:
    """A position between two moments of some services; ``ahead`` decodes the next chunk in the background."""

    def __init__(self, recording: Recording, services: Iterable[str], ahead: Executor | None = None) -> None:
        self._recording, self.services = recording, tuple(services)
        self._places = [place for place in recording.places if recording.may_have(place, self.services)]
        self._ends_s = list(accumulate((recording.time_s(place.end_ns) for place in self._places), max))
        self._ahead = ahead
        self._coming: tuple[int, Future[list[Moment]] | None] = -1, None
        self._kept: dict[int, list[Moment]] = {}
        self._chunk = self._at = 0

    def seek(self, time_s: float) -> None:
        """Go before the first moment at or after a time, s since the recording began."""
        self._chunk = bisect_left(self._ends_s, time_s)
        self._at = bisect_left(self._moments(self._chunk), time_s, key=lambda moment: moment.time_s)

    def next(self) -> Moment | None:
        while self._chunk < len(self._places):
            moments = self._moments(self._chunk)
            if self._at < len(moments):
                self._at += 1
                return moments[self._at - 1]
            self._chunk, self._at = self._chunk + 1, 0
        return None

    def back(self) -> Moment | None:
        while not self._at:
            if not self._chunk:
                return None
            self._chunk -= 1
            self._at = len(self._moments(self._chunk))
        self._at -= 1
        return self._moments(self._chunk)[self._at]

    def so_far(self, services: Collection[str]) -> dict[str, list[Moment]]:
        """Return the newest sample of each service and the events after it, in order.

        Services that had not begun are left out.
        """
        found: dict[str, list[Moment]] = {name: [] for name in services}
        wanted = set(services)
        for chunk in range(min(self._chunk, len(self._places) - 1), -1, -1):
            if not wanted:
                break
            if not self._recording.may_have(self._places[chunk], wanted):
                continue
            if chunk == self._chunk:
                moments = self._moments(chunk)[: self._at]
            else:
                moments = self._recording.moments_in(self._places[chunk], wanted)
            for moment in reversed(moments):
                if moment.service in wanted:
                    found[moment.service].insert(0, moment)
                    if moment.frame is not None:
                        wanted.discard(moment.service)
        return {name: moments for name, moments in found.items() if name not in wanted}

    def first_s(self) -> Mapping[str, float]:
        """Return the start of the first chunk that has samples of each service, s since the recording began."""
        first: dict[str, float] = {}
        for place in self._places:
            for name in self.services:
                if name not in first and self._recording.may_have(place, [name], events=False):
                    first[name] = self._recording.time_s(place.start_ns)
            if len(first) == len(self.services):
                break
        return first

    def _moments(self, chunk: int) -> list[Moment]:
        if chunk >= len(self._places):
            return []
        moments = self._kept.pop(chunk, None)
        if moments is None:
            number, coming = self._coming
            moments = coming.result() if coming is not None and number == chunk else self._decoded(chunk)
            following = chunk + 1
            if self._ahead is not None and following < len(self._places) and following not in self._kept:
                self._coming = following, self._ahead.submit(self._decoded, following)
        self._kept[chunk] = moments
        if len(self._kept) > _KEPT_CHUNKS:
            del self._kept[next(iter(self._kept))]
        return moments

    def _decoded(self, chunk: int) -> list[Moment]:
        return self._recording.moments_in(self._places[chunk], self.services)
