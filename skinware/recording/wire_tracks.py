"""Read the recorded wires of drivers: frames of CAN buses, and bytes of serial lines.

A message holds a sample of the driver's wire service (:mod:`skinware.wire`)::

    header      32 bytes: u8 generation, u8 sequence, i8 published_ns, u8 missed
    pieces      of one bus
"""

from __future__ import annotations

import heapq
import struct
from collections.abc import Iterator
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt

from skinware.limits import LIMITS
from skinware.memory.ring import Sample
from skinware.realtime import NS_PER_S
from skinware.wire import WireItem, read_pieces

if TYPE_CHECKING:
    from skinware.recording.reading import Recording

_HEADER = struct.Struct("<QQqQ")
"""Generation and sequence of the sample, its time of publication, frames or bytes missed on the bus so far."""
_LATEST_S = 1.0
"""A frame is published at most so long after it crossed the wire."""
_WINDOW_NS = 2 * NS_PER_S
"""Received and sent frames within this time are sorted."""

FRAME = np.dtype(
    [
        ("time_ns", "<i8"),
        ("epoch_ns", "<i8"),
        ("identifier", "<u4"),
        ("length", "u1"),
        ("flags", "u1"),
        ("is_sent", "?"),
        ("payload", "u1", (64,)),
    ]
)
"""A CAN frame; the columns are those of :class:`WirePiece` and ``skinware.wire.ROWS``."""


def message_of(frame: Sample) -> bytes:
    """Return the message of a sample of a driver's wire service."""
    used = int(frame.column("used")[()])
    header = _HEADER.pack(frame.generation, frame.sequence, frame.published_ns, int(frame.column("missed")[()]))
    return header + frame.column("pieces")[:used].tobytes()


class WirePiece(NamedTuple):
    """Frames of a CAN bus, or bytes of a serial line, that came or were sent together.

    Attributes:
        is_sent: the driver sent them; False: it received them.
        time_ns: (n,) int64, CLOCK_MONOTONIC of each frame; (1,) for bytes.
        epoch_ns: the same times, ns since 1970.
        frames: (n,) of ``skinware.wire.ROWS``; None for bytes.
        data: the bytes; empty for frames.
    """

    is_sent: bool
    time_ns: npt.NDArray[np.int64]
    epoch_ns: npt.NDArray[np.int64]
    frames: npt.NDArray[np.void] | None
    data: bytes


class WireTrack:
    """The frames or bytes of one bus of a driver, as the driver received and sent them.

    Args:
        recording: the source of its chunks.
        driver: name of the driver.
        bus: name of the bus.
        channel: number of its channel.

    Attributes:
        driver, bus: as above.
    """

    def __init__(self, recording: Recording, driver: str, bus: str, channel: int) -> None:
        self._recording = recording
        self.driver: str = driver
        self.bus: str = bus
        self.channel: int = channel

    @property
    def missed(self) -> int:
        """Frames or bytes that the driver received and had no room to publish.

        Losses before the driver are in its ``bus_counters``.
        """
        missed: dict[int, int] = {}
        for generation, count, _, _ in self._batches(0.0, None):
            missed[generation] = max(missed.get(generation, 0), count)
        return sum(missed.values())

    def pieces(self, *, start_s: float = 0.0, end_s: float | None = None) -> Iterator[WirePiece]:
        """Yield all pieces as they came; damaged ones are left out and named in the recording's ``problems``.

        Args:
            start_s: begin at this time, s since the recording began.
            end_s: end before this time; None: after the last piece.
        """
        first_ns = self._recording.start_ns + round(start_s * NS_PER_S) if start_s else None
        end_ns = None if end_s is None else self._recording.start_ns + round(end_s * NS_PER_S)
        for _, _, offset_ns, data in self._batches(start_s, end_s):
            pieces, is_whole = read_pieces(data)
            if not is_whole:
                self._recording.note(f"wire of {self.bus}: damaged frames or bytes left out")
            for piece in pieces:
                epoch_ns = piece.time_ns + offset_ns
                wanted = np.ones(len(epoch_ns), bool)
                if first_ns is not None:
                    wanted &= epoch_ns >= first_ns
                if end_ns is not None:
                    wanted &= epoch_ns < end_ns
                if wanted.all():
                    yield WirePiece(piece.is_sent, piece.time_ns, epoch_ns, piece.frames, piece.data)
                elif piece.frames is not None and wanted.any():
                    frames = piece.frames[wanted]
                    yield WirePiece(piece.is_sent, piece.time_ns[wanted], epoch_ns[wanted], frames, b"")

    @property
    def is_serial(self) -> bool:
        """Whether the bus is a serial line; False if nothing was recorded."""
        first = next(self.pieces(), None)
        return first is not None and first.frames is None

    def items(self, *, start_s: float = 0.0, end_s: float | None = None) -> Iterator[WireItem]:
        """Yield every frame, or every read and write, by time; arguments as for :meth:`pieces`."""
        waiting: list[tuple[int, int, WireItem]] = []
        order = 0
        for piece in self.pieces(start_s=start_s, end_s=end_s):
            for item in _items(piece):
                heapq.heappush(waiting, (item.time_ns, order, item))
                order += 1
            until_ns = int(piece.time_ns[-1]) - _WINDOW_NS if len(piece.time_ns) else 0
            while waiting and waiting[0][0] < until_ns:
                yield heapq.heappop(waiting)[2]
        while waiting:
            yield heapq.heappop(waiting)[2]

    def frames(self, *, start_s: float = 0.0, end_s: float | None = None) -> npt.NDArray[np.void]:
        """Return (n,) of :data:`FRAME`: all frames of a CAN bus by time; arguments as for :meth:`pieces`."""
        found = [np.zeros(0, FRAME)]
        for piece in self.pieces(start_s=start_s, end_s=end_s):
            if piece.frames is None:
                continue
            rows = np.zeros(len(piece.frames), FRAME)
            rows["time_ns"], rows["epoch_ns"], rows["is_sent"] = piece.time_ns, piece.epoch_ns, piece.is_sent
            for name in ("identifier", "length", "flags"):
                rows[name] = piece.frames[name]
            payload = piece.frames["payload"]
            rows["payload"][:, : payload.shape[1]] = payload
            found.append(rows)
        frames = np.concatenate(found)
        return frames[np.argsort(frames["time_ns"], kind="stable")]

    def _batches(self, start_s: float, end_s: float | None) -> Iterator[tuple[int, int, int, memoryview]]:
        """Yield (generation, missed so far, ns since 1970 minus CLOCK_MONOTONIC, pieces) of every message."""
        until_s = None if end_s is None else end_s + _LATEST_S
        for contents in self._recording.chunks({self.channel}, start_s, until_s):
            for message in contents.messages:
                if message.channel_id != self.channel:
                    continue
                if len(message.data) < _HEADER.size:
                    self._recording.note(f"wire of {self.bus}: a message is shorter than its header")
                    continue
                generation, _, published_ns, missed = _HEADER.unpack_from(message.data)
                if not (LIMITS.is_time(message.time_ns) and LIMITS.is_time(published_ns)):
                    self._recording.note(f"wire of {self.bus}: a message has a time that no clock has")
                    continue
                yield generation, missed, message.time_ns - published_ns, message.data[_HEADER.size :]

    def __repr__(self) -> str:
        return f"<WireTrack of {self.bus!r} of {self.driver!r}>"


def _items(piece: WirePiece) -> Iterator[WireItem]:
    times, epochs = piece.time_ns.tolist(), piece.epoch_ns.tolist()
    if piece.frames is None:
        yield WireItem(times[0], epochs[0], piece.is_sent, None, 0, piece.data)
        return
    columns = (piece.frames[name].tolist() for name in ("identifier", "length", "flags"))
    payloads = piece.frames["payload"]
    for place, (time_ns, epoch_ns, identifier, length, flags) in enumerate(zip(times, epochs, *columns, strict=True)):
        data = payloads[place, :length].tobytes()
        yield WireItem(time_ns, epoch_ns, piece.is_sent, identifier, flags, data)
