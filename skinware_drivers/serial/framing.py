"""From a stream of bytes to frames: what every framing has in common. No input or output here.

A :class:`Framing` is a declaration: how frames lie in a stream, and which part of them is the body. Its
:class:`Framer` is fed whatever arrives, in pieces of any size, and gives back the frames that are complete.

* How the stream is cut into pieces never changes what is found, nor the counters.
* Wire input never raises. Every byte is accounted for:
  ``bytes_in == frame_bytes + idle_bytes + skipped_bytes + framer.pending``.
* What is held back is bounded by the longest frame of the declaration.

Few bytes are looked through frame by frame in plain Python, many with numpy for all frames together: what pays
is told by ``MANY_BYTES``. Both ways find the same frames.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import Literal

import numpy as np
import numpy.typing as npt

from skinware_drivers.counters import FramerCounters
from skinware_drivers.serial.gather import Bytes, Indices, copy_rows

MANY_BYTES = 2048
"""From here on numpy is faster than plain Python, also when neither is in the processor's caches."""


@dataclass(frozen=True)
class Field:
    """A whole number in the header of a frame.

    Attributes:
        offset: first byte.
        size: 1, 2 or 4 bytes.
        order: byte order.
        mask: bits of it that count.
    """

    offset: int
    size: Literal[1, 2, 4] = 1
    order: Literal["little", "big"] = "little"
    mask: int = 0xFFFF_FFFF

    @property
    def end(self) -> int:
        """One past its last byte."""
        return self.offset + self.size

    def of(self, frame: bytes, start: int = 0) -> int:
        """Its value in the frame that begins at ``start``."""
        if self.size == 1:
            return frame[start + self.offset] & self.mask
        return int.from_bytes(frame[start + self.offset : start + self.end], self.order) & self.mask

    def of_many(self, data: Bytes, start: Indices) -> Indices:
        """(n,) int64: its value in the frames that begin at each start."""
        value = np.zeros(len(start), np.int64)
        places = range(self.offset, self.end)
        for place in places if self.order == "big" else reversed(places):
            value = value << 8 | data[start + place]
        return value & self.mask

    def put(self, frame: bytearray, value: int) -> None:
        """Write its value into the frame; the bits outside the mask stay.

        Raises:
            ValueError: the value does not fit.
        """
        mask = self.mask & (1 << 8 * self.size) - 1
        if value & ~mask:
            raise ValueError(f"{value} does not fit into a field of {self.size} bytes with mask {mask:#x}")
        kept = int.from_bytes(frame[self.offset : self.end], self.order) & ~mask
        frame[self.offset : self.end] = (kept | value).to_bytes(self.size, self.order)


@dataclass(frozen=True)
class Framed:
    """Frames that were found, in the order of the stream.

    Attributes:
        data: the bytes that the bodies lie in; behind the last body it goes on for the length of the longest.
        start: (n,) int64, where each body begins in ``data``.
        length: (n,) int64, bytes of each body.
        identifier: (n,) int64.
        end: (n,) int64, bytes of the stream up to the end of the frame.
    """

    data: Bytes
    start: Indices
    length: Indices
    identifier: Indices
    end: Indices

    def __len__(self) -> int:
        return len(self.start)

    def __getitem__(self, part: slice | npt.NDArray[np.bool_]) -> Framed:
        return Framed(self.data, self.start[part], self.length[part], self.identifier[part], self.end[part])

    def copy_to(self, wire: npt.NDArray[np.void]) -> None:
        """Fill (n,) rows of a batch; their payloads are long enough."""
        wire["identifier"] = self.identifier
        wire["length"] = self.length
        copy_rows(self.data, self.start, self.length, wire["payload"])

    def bodies(self) -> list[bytes]:
        """The body of every frame."""
        return [self.data[a : a + n].tobytes() for a, n in zip(self.start.tolist(), self.length.tolist(), strict=True)]

    @classmethod
    def of_bodies(cls, bodies: Sequence[bytes], identifier: Sequence[int], end: Sequence[int]) -> Framed:
        """Frames that were found one by one."""
        sizes = [len(body) for body in bodies]
        data = np.frombuffer(b"".join((*bodies, bytes(max(sizes)))), np.uint8)
        table = np.array([[0, *accumulate(sizes[:-1])], sizes, identifier, end], np.int64)
        return cls(data, *table)


_NONE = np.zeros(0, np.int64)
NOTHING = Framed(np.zeros(0, np.uint8), _NONE, _NONE, _NONE, _NONE)
"""No frame at all."""


class Encoding(ABC):
    """How commands are sent."""

    @abstractmethod
    def encode(self, identifier: int, payload: bytes) -> bytes:
        """A frame as it is sent.

        Raises:
            ValueError: there is no such frame; the message says why.
        """


class Framing(Encoding):
    """How frames lie in a stream of bytes.

    Attributes:
        maximum_body: bytes of the longest body.
    """

    maximum_body: int

    @abstractmethod
    def framer(self) -> Framer:
        """Something to feed a stream to, from its very beginning."""


class Framer(ABC):
    """Finds the frames of one stream.

    Attributes:
        counters: what it has seen; several that follow each other on one line can be given the same.
    """

    def __init__(self) -> None:
        self.counters: FramerCounters = FramerCounters()
        self._rest = b""
        self._before = 0  # bytes of the stream before the rest
        self._wanted = 0  # the rest cannot be decided before it has so many bytes

    @property
    def position(self) -> int:
        """Bytes of the stream so far."""
        return self._before + len(self._rest)

    @property
    def pending(self) -> int:
        """Bytes that may still become part of a frame."""
        return len(self._rest)

    def feed(self, chunk: bytes) -> Framed:
        """Take the next bytes of the stream; gives the frames that they complete."""
        self.counters.bytes_in += len(chunk)
        stream = self._rest + chunk if self._rest else chunk
        if len(stream) < self._wanted:
            self._rest = stream
            return NOTHING
        self._wanted = 0
        found, done = self._find_many(stream) if len(stream) >= MANY_BYTES else self._find_few(stream)
        self._rest = stream[done:]
        self._before += done
        self.counters.frames += len(found)
        return found

    @abstractmethod
    def _find_few(self, stream: bytes) -> tuple[Framed, int]:
        """The frames of a stream, one by one, and how many of its bytes are done with (and counted)."""

    @abstractmethod
    def _find_many(self, stream: bytes) -> tuple[Framed, int]:
        """The same, all at once."""


@dataclass(frozen=True)
class Unframed(Framing):
    """Bytes as they come, for consoles and emulators; and for commands that are sent as they are.

    What was received at once is one frame, or several if it is longer than ``maximum_body``: here, and only here,
    frames depend on how the stream was cut into pieces.
    """

    maximum_body: int = 64

    def framer(self) -> Framer:
        """Pieces as they come."""
        return _Pieces(self.maximum_body)

    def encode(self, identifier: int, payload: bytes) -> bytes:  # noqa: ARG002
        """The payload itself."""
        return payload


class _Pieces(Framer):
    def __init__(self, size: int) -> None:
        super().__init__()
        self._size = size

    def _find_few(self, stream: bytes) -> tuple[Framed, int]:
        self.counters.frame_bytes += len(stream)
        pieces = [stream[at : at + self._size] for at in range(0, len(stream), self._size)]
        ends = [self._before + min(at + self._size, len(stream)) for at in range(0, len(stream), self._size)]
        return Framed.of_bodies(pieces, [0] * len(pieces), ends) if pieces else NOTHING, len(stream)

    _find_many = _find_few


def check_body(identifier: int, payload: bytes, field: Field | None, minimum: int, maximum: int) -> None:
    """Refuse what cannot be sent.

    Raises:
        ValueError: the payload is too short or too long, or the identifier is not what frames can carry.
    """
    if not minimum <= len(payload) <= maximum:
        raise ValueError(f"a payload of {len(payload)} bytes; frames of this device have {minimum} to {maximum}")
    if identifier & ~(0 if field is None else field.mask & (1 << 8 * field.size) - 1):
        raise ValueError(f"frames of this device cannot carry the identifier {identifier:#x}")
