"""Streams for tests: frames, damage, and everything between."""

from __future__ import annotations

import ctypes
from collections.abc import Iterable, Sequence
from dataclasses import astuple
from itertools import pairwise

import numpy as np
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st

from skinware_drivers.bus import FrameBatch
from skinware_drivers.counters import BusCounters
from skinware_drivers.serial.delimited import LINES, Delimited
from skinware_drivers.serial.framing import Framed, Framer, Framing
from skinware_drivers.serial.framings import Recurring, TextMatrix
from skinware_drivers.serial.packets import Packet
from skinware_drivers.serial.stream import NativeStream
from tests.serial.framings import Example
from tests.specification.framers import InPython
from tests.specification.path_tests import made

_ROWS = 3
BUSY = settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])
"""For machines that do other things too."""


def feed(framer: Framer, chunks: Iterable[bytes]) -> list[Framed]:
    """What a framer finds in a stream; holds its books against what came in after every chunk."""
    found: list[Framed] = []
    fed = 0
    for chunk in chunks:
        frames = framer.feed(chunk)
        fed += len(chunk)
        found += frames
        counters = framer.counters
        accounted = counters.frame_bytes + counters.idle_bytes + counters.skipped_bytes
        assert counters.bytes_in == fed == accounted + framer.pending, counters
        assert counters.frames == len(found)
        assert framer.pending <= held_at_most(framer)
    return found


def held_at_most(framer: Framer) -> int:
    """The bound on what a framer may hold back."""
    framing = getattr(framer, "_framing", None)
    if framing is None:  # that of C, whose room the sanitizers see
        return 1 << 62
    if isinstance(framing, Packet):
        return framing.undecided
    if isinstance(framing, Recurring):
        return 3 * (len(framing.marker) + framing.maximum_body) + len(framing.marker)
    if isinstance(framing, TextMatrix):
        return framing.rows * (4 * framing.columns + 2) + 2  # a number and a space each, and the ends of lines
    assert isinstance(framing, Delimited)
    return framing.stuffing.longest(framing.maximum_body + framing.overhead)


def cut(stream: bytes, places: Sequence[int]) -> list[bytes]:
    """A stream in pieces."""
    edges = [0, *sorted({place for place in places if 0 < place < len(stream)}), len(stream)]
    return [stream[a:b] for a, b in pairwise(edges)]


def outcome(framing: Framing, chunks: Sequence[bytes]) -> tuple[list[Framed], tuple[int, ...], int]:
    """Everything that can be seen of a framer after a stream; C sees the same, where it can."""
    in_c = framing.framer()
    framer = InPython(framing).framer() if isinstance(framing, Packet | Delimited) else in_c
    found = feed(framer, chunks)
    if framer is not in_c:
        assert feed(in_c, chunks) == found
        assert (in_c.counters, in_c.pending, in_c.position) == (framer.counters, framer.pending, framer.position)
    compare_with_c(framing, chunks)
    return found, astuple(framer.counters), framer.pending


class TightStream(NativeStream):
    """Sanitizers see every byte that it reads behind those that have come."""

    def fill(self, batch: FrameBatch, ordinal: int) -> int:
        """From memory that ends where they end."""
        stream = self._stream
        room, size = stream.bytes, stream.size
        came = np.frombuffer(ctypes.string_at(room, size), np.uint8).copy()
        stream.bytes = came.ctypes.data
        try:
            return super().fill(batch, ordinal)
        finally:
            stream.bytes = room


def compare_with_c(framing: Framing, chunks: Iterable[bytes], rows: int = _ROWS) -> None:
    """Both ways to find frames, into batches of so many rows, some of which are too short for the longest bodies."""
    for size in (framing.maximum_body, framing.maximum_body // 2):
        batch = FrameBatch(rows, max(8, -(-size // 8) * 8))
        stream = made(framing, size, BusCounters(), TightStream)
        for number, chunk in enumerate(chunk for chunk in chunks if chunk):
            stream.add(chunk, 1000 + number)
            while True:
                batch.clear()
                stream.fill(batch, 3)
                stream.take_damaged()
                if not stream.is_behind:
                    break


def bodies(example: Example) -> st.SearchStrategy[bytes]:
    """Bodies that frames can have, with many of the bytes that mean something on the wire."""
    is_text = isinstance(example.framing, Delimited) and example.framing.stuffing is LINES
    special = [0x20, 0x2C] if is_text else [0, 0x0D, 0x55, 0x7D, 0x7E, 0xAA, 0xC0, 0xDB, 0xFF]
    byte = st.one_of(st.sampled_from(special), st.integers(0x20 if is_text else 0, 0xFF))
    sizes = example.body_sizes()
    short = [size for size in sizes if size <= 40] or [sizes[0]]

    def of_size(size: int) -> st.SearchStrategy[bytes]:
        if size <= 40:
            return st.lists(byte, min_size=size, max_size=size).map(bytes)
        return st.lists(byte, min_size=1, max_size=9).map(lambda part: bytes((part * size)[:size]))

    return st.one_of(st.sampled_from(short), st.sampled_from(sizes)).flatmap(of_size)


def frames(example: Example) -> st.SearchStrategy[tuple[int, bytes, bytes]]:
    """(identifier, body, frame)."""
    parts = st.tuples(st.sampled_from(example.identifiers), bodies(example))
    return parts.map(lambda part: (*part, example.framing.encode(*part)))


def noise(example: Example) -> st.SearchStrategy[bytes]:
    """Bytes that are not meant to be a frame: anything, pieces of frames, and beginnings."""
    framing = example.framing
    some = st.binary(max_size=60)
    pieces = st.tuples(frames(example), st.integers(0, 30), st.integers(0, 200)).map(lambda p: p[0][2][p[1] : p[2]])
    if isinstance(framing, Packet):
        sync = bytes(byte if isinstance(byte, int) else min(byte) for byte in framing.sync)
        return st.one_of(some, pieces, st.tuples(st.just(sync), some).map(b"".join))
    assert isinstance(framing, Delimited)
    delimiter = bytes([framing.stuffing.delimiter])
    return st.one_of(some, pieces, st.integers(1, 4).map(lambda n: n * delimiter))


def streams(example: Example) -> st.SearchStrategy[bytes]:
    """Frames and noise in any order."""
    part = st.one_of(frames(example).map(lambda frame: frame[2]), noise(example))
    return st.lists(part, max_size=12).map(b"".join)
