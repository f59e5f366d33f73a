"""The moments of a recording, forward and back, and what there was at any of them."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Collection, Iterable, Mapping
from concurrent.futures import Executor, Future
from itertools import accumulate
from typing import NamedTuple, Protocol

from skinware.recording.mcap_reading import ChunkPlace
from skinware.transfer.collecting import CLOSED, DEAD
from skinware.transfer.generation import RecordedSample

GONE = (CLOSED, DEAD)
_KEPT_CHUNKS = 3


class Moment(NamedTuple):
    """A frame, or what happened to a service.

    Attributes:
        time_s: since the recording began.
        service: its name.
        frame: it; None of an event.
        event: ``paused``, ``live``, ``closed`` or ``dead``; empty of a frame.
    """

    time_s: float
    service: str
    frame: RecordedSample | None
    event: str = ""


class MomentSource(Protocol):
    """Where moments come from: a recording."""

    @property
    def places(self) -> list[ChunkPlace]:
        """Its chunks, in order."""

    def time_s(self, time_ns: int) -> float:
        """The time of a message, s since the recording began."""

    def may_have(self, place: ChunkPlace, services: Collection[str], *, events: bool = True) -> bool:
        """Whether there may be frames of some services in a chunk, or events."""

    def moments_in(self, place: ChunkPlace, services: Collection[str]) -> list[Moment]:
        """The moments of some services in a chunk, by time; none if it is damaged."""


class Timeline:
    """A place between two moments of some services, which moves.

    Args:
        recording: whose.
        services: their names.
        ahead: decodes the chunk after the one at hand meanwhile, for who must not wait for it.
    """

    def __init__(self, recording: MomentSource, services: Iterable[str], ahead: Executor | None = None) -> None:
        self._recording, self.services = recording, tuple(services)
        self._places = [place for place in recording.places if recording.may_have(place, self.services)]
        self._ends_s = list(accumulate((recording.time_s(place.end_ns) for place in self._places), max))
        self._ahead = ahead
        self._coming: tuple[int, Future[list[Moment]] | None] = -1, None
        self._kept: dict[int, list[Moment]] = {}
        self._chunk = self._at = 0

    def seek(self, time_s: float) -> None:
        """Go to right before the first moment that is not before a time, s since the recording began."""
        self._chunk = bisect_left(self._ends_s, time_s)
        self._at = bisect_left(self._moments(self._chunk), time_s, key=lambda moment: moment.time_s)

    def next(self) -> Moment | None:
        """Go over the next moment; None at the end."""
        while self._chunk < len(self._places):
            moments = self._moments(self._chunk)
            if self._at < len(moments):
                self._at += 1
                return moments[self._at - 1]
            self._chunk, self._at = self._chunk + 1, 0
        return None

    def back(self) -> Moment | None:
        """Go back over the moment before; None at the beginning."""
        while not self._at:
            if not self._chunk:
                return None
            self._chunk -= 1
            self._at = len(self._moments(self._chunk))
        self._at -= 1
        return self._moments(self._chunk)[self._at]

    def so_far(self, services: Collection[str]) -> dict[str, list[Moment]]:
        """What some services were like: the newest frame of each, and what happened to it since, in order.

        Those that had not begun are left out.
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
        """When each service was there first, as exactly as chunks tell, s since the recording began."""
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
            self._prepare(chunk + 1)
        self._kept[chunk] = moments
        if len(self._kept) > _KEPT_CHUNKS:
            del self._kept[next(iter(self._kept))]
        return moments

    def _decoded(self, chunk: int) -> list[Moment]:
        return self._recording.moments_in(self._places[chunk], self.services)

    def _prepare(self, chunk: int) -> None:
        if self._ahead is not None and chunk < len(self._places) and chunk not in self._kept:
            self._coming = chunk, self._ahead.submit(self._decoded, chunk)
