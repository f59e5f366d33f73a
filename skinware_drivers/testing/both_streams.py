"""The bytes of serial lines through both ways of finding frames in them, Python and C: whatever differs is a failure.

What they differ in is a fault of Skinware's, and not of the driver whose line shows it.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from copy import deepcopy
from unittest.mock import patch

from skinware.native import Library
from skinware_drivers import native
from skinware_drivers.bus import FrameBatch
from skinware_drivers.counters import BusCounters, FramerCounters
from skinware_drivers.serial import bus
from skinware_drivers.serial.framing import Framing
from skinware_drivers.serial.native_stream import NativeStream, can_compile
from skinware_drivers.serial.stream import PythonStream, Stream
from skinware_drivers.testing.defect import defect


class BothStreams(Stream):
    """A stream whose frames are found twice. What it gives is what Python finds.

    Args:
        in_c: what C is to find the same with; its counters are its own.
        framing: what is on the line.
        payload_size: of bodies, at most.
        counters: of the bus.

    Attributes:
        difference: what they differ in, as it was raised; empty if they do not.
    """

    def __init__(self, in_c: NativeStream, framing: Framing, payload_size: int, counters: BusCounters) -> None:
        super().__init__(counters)
        self._python, self._native = PythonStream(framing, payload_size, counters), in_c
        self.difference = ""

    @property
    def is_behind(self) -> bool:
        return self._python.is_behind or self._native.is_behind

    @property
    def pending(self) -> int:
        return self._python.pending

    def add(self, chunk: bytes, time_ns: int) -> None:
        self._python.add(chunk, time_ns)
        self._native.add(chunk, time_ns)

    def fill(self, batch: FrameBatch, ordinal: int) -> int:
        other, first = deepcopy(batch), batch.stop
        taken = self._python.fill(batch, ordinal)
        found = self._native.fill(other, ordinal)
        rows = slice(first, batch.stop)
        self._compare("finds", (taken, batch.stop), (found, other.stop))
        for name in ("wire", "time_ns", "bus"):
            own, of_c = getattr(batch, name)[rows], getattr(other, name)[rows]
            if own.tobytes() != of_c.tobytes():
                self._compare(name, own.tolist(), of_c.tolist())
        if not self.is_behind:
            self._compare("counts", _counted(self.counters), _counted(self._native.counters))
            self._compare("holds back", self._python.pending, self._native.pending)
        return taken

    def take_damaged(self) -> bytes:
        if self._native.is_behind:
            return b""
        damaged = self._python.take_damaged()
        self._compare("keeps as a sample", damaged, self._native.take_damaged())
        return damaged

    def _compare(self, what: str, of_python: object, of_c: object) -> None:
        if of_python != of_c:
            self.difference = f"{what}: Python {of_python}, C {of_c}"
            defect(self.difference)


def _counted(counters: BusCounters) -> tuple[int | FramerCounters, ...]:
    """What streams count; the rest is the bus'."""
    return counters.frames, counters.errors, counters.refused, counters.framing


@contextmanager
def both_streams() -> Iterator[None]:
    """As long as the ``with`` lasts, lines that are opened find frames in both ways, where C can.

    What differs is raised where it is found, in the driver, and here again.
    """
    library, streams = native.library(), list[Stream]()

    def stream_of(framing: Framing, payload_size: int, counters: BusCounters) -> Stream:
        streams.append(made(library, framing, payload_size, counters))
        return streams[-1]

    with patch.object(bus, "stream_of", stream_of):
        try:
            yield
        finally:
            for stream in streams:
                if isinstance(stream, BothStreams) and stream.difference:
                    defect(stream.difference)


def made(
    library: Library | None,
    framing: Framing,
    payload_size: int,
    counters: BusCounters,
    kind: type[NativeStream] = NativeStream,
) -> Stream:
    """Both streams, or that of Python alone.

    Args:
        library: the code in C, None: there is none.
        framing: what is on the line.
        payload_size: of bodies, at most.
        counters: of the bus.
        kind: of the stream in C.
    """
    if library is None or not can_compile(framing):
        return PythonStream(framing, payload_size, counters)
    in_c = kind(library, framing, payload_size, deepcopy(counters))
    return BothStreams(in_c, framing, payload_size, counters)
