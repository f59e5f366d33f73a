"""Turn the bytes of a line into rows of a batch: framed, split, with the time of their last byte."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from skinware_drivers.bus import FrameBatch
from skinware_drivers.counters import BusCounters
from skinware_drivers.serial.framing import Framed, Framer, Framing, Splitting, fill_rows


class Part(NamedTuple):
    """A part of a body that becomes a frame.

    Attributes:
        identifier: of that frame.
        start: first byte in the body.
        stop: one past the last.
    """

    identifier: int
    start: int
    stop: int


@dataclass(frozen=True)
class Split(Framing):
    """Frames of another framing that is not split, each split into several with the time and the end of the whole.

    Attributes:
        whole: how frames lie in the stream, and how commands are sent.
        splitting: returns the parts of a frame; must not raise, whatever it is given.
    """

    whole: Framing
    splitting: Splitting
    maximum_body: int = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "maximum_body", self.whole.maximum_body)

    def framer(self) -> Framer:
        framer = self.whole.framer()
        framer.splitting = self.splitting
        return framer

    def encode(self, identifier: int, payload: bytes) -> bytes:
        return self.whole.encode(identifier, payload)


def by_length(known: Mapping[tuple[int, int], Sequence[Part]]) -> Splitting:
    """Return a splitting of frames of known identifiers and lengths of body; others stay whole."""

    def split(identifier: int, body: bytes) -> Iterable[tuple[int, bytes]]:
        parts = known.get((identifier, len(body)))
        if parts is None:
            return [(identifier, body)]
        return [(part.identifier, body[part.start : part.stop]) for part in parts]

    return split


CHUNK = 1 << 16
"""Bytes of a chunk, at most."""


class Stream(ABC):
    """The bytes of a line from when it is opened, or gets another framing, until it is closed or gets the next.

    Attributes:
        counters: of the bus; they go on from one stream to the next.
        is_lost: no more frames can be found, so that the bus must be opened again.
    """

    def __init__(self, counters: BusCounters) -> None:
        self.counters = counters
        self.is_lost = False

    @property
    @abstractmethod
    def is_behind(self) -> bool:
        """Whether the bytes so far may have more frames; until they have none, no bytes are added."""

    @property
    @abstractmethod
    def pending(self) -> int:
        """Bytes that may still become part of a frame."""

    def asked(self) -> None:  # noqa: B027  (most framings do not depend on questions)
        """Note that the host sends a question."""

    @abstractmethod
    def add(self, chunk: bytes, time_ns: int) -> None:
        """Add at most ``CHUNK`` bytes that were read at this time, CLOCK_MONOTONIC ns."""

    @abstractmethod
    def fill(self, batch: FrameBatch, ordinal: int) -> int:
        """Append frames to a batch, as many as fit; return their number."""

    @abstractmethod
    def take_damaged(self) -> bytes:
        """Return the last chunk, once, if it had damaged frames and no good one."""


class PythonStream(Stream):
    """A stream whose frames a framer finds."""

    def __init__(self, framing: Framing, payload_size: int, counters: BusCounters) -> None:
        super().__init__(counters)
        self._payload_size = payload_size
        self._framer = framing.framer()
        self._framer.counters = counters.framing
        self._reads: list[tuple[int, int]] = []
        self._backlog: list[tuple[list[Framed], npt.NDArray[np.int64]]] = []
        self._damaged = b""

    @property
    def is_behind(self) -> bool:
        return bool(self._backlog)

    @property
    def pending(self) -> int:
        return self._framer.pending

    def asked(self) -> None:
        self._framer.asked()
        self.is_lost = self._framer.is_lost

    def add(self, chunk: bytes, time_ns: int) -> None:
        framer, counters = self._framer, self.counters.framing
        known = framer.position
        damaged = counters.checksum_errors + counters.refused
        framed = framer.feed(chunk)
        damaged = counters.checksum_errors + counters.refused - damaged
        self.counters.errors += damaged
        self._damaged = chunk if damaged and not framed else b""
        self._reads.append((framer.position, time_ns))
        fitting = [frame for frame in framed if len(frame.body) <= self._payload_size]
        self.counters.refused += len(framed) - len(fitting)
        if fitting:
            time_of = np.full(len(fitting), time_ns)
            if fitting[0].end <= known:  # frames were held back behind a false beginning
                ends, times = zip(*self._reads, strict=True)
                time_of = np.array(times)[np.searchsorted(ends, [frame.end for frame in fitting])]
            self._backlog.append((fitting, time_of))
        # keep the times of the bytes that are still held back
        undecided = framer.position - framer.pending
        if not framer.pending:
            self._reads.clear()
        while self._reads and self._reads[0][0] <= undecided:
            self._reads.pop(0)

    def fill(self, batch: FrameBatch, ordinal: int) -> int:
        taken = 0
        while self._backlog and batch.free:
            framed, time_ns = self._backlog[0]
            count = min(len(framed), batch.free)
            rows = slice(batch.stop, batch.stop + count)
            fill_rows(batch.wire[rows], framed[:count])
            batch.time_ns[rows], batch.bus[rows] = time_ns[:count], ordinal
            batch.stop += count
            taken += count
            if count == len(framed):
                self._backlog.pop(0)
            else:
                self._backlog[0] = framed[count:], time_ns[count:]
        self.counters.frames += taken
        return taken

    def take_damaged(self) -> bytes:
        damaged, self._damaged = self._damaged, b""
        return damaged
