"""From a stream of bytes to frames: the common part of all framings. No input or output here.

A :class:`Framing` declares how frames lie in a stream, and which part of them is the body. Its :class:`Framer` is fed
the bytes that arrive, in pieces of any size, and returns the frames that are complete.

* The cuts between pieces change neither the frames that are found nor the counters.
* Wire input never raises. Every byte is counted:
  ``bytes_in == frame_bytes + idle_bytes + skipped_bytes + framer.pending``.
* The bytes held back are bounded by the longest frame of the declaration.

Frames are found one by one: docs/decisions/0009 says why.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from skinware.errors import ConfigurationError
from skinware_drivers.counters import FramerCounters


@dataclass(frozen=True)
class Field:
    """A whole number in the header of a frame.

    Attributes:
        offset: first byte.
        size: 1, 2 or 4 bytes.
        order: byte order.
        mask: the bits that count.

    Raises:
        ConfigurationError: another size or order.
    """

    offset: int
    size: Literal[1, 2, 4] = 1
    order: Literal["little", "big"] = "little"
    mask: int = 0xFFFF_FFFF

    def __post_init__(self) -> None:
        if self.size not in (1, 2, 4):
            raise ConfigurationError(f"Field at {self.offset}: size = {self.size!r}: give 1, 2 or 4 bytes")
        if self.order not in ("little", "big"):
            raise ConfigurationError(f"Field at {self.offset}: order = {self.order!r}: give little or big")

    @property
    def end(self) -> int:
        """One past its last byte."""
        return self.offset + self.size

    def of(self, frame: bytes, start: int = 0) -> int:
        """Return the value in the frame that begins at ``start``."""
        if self.size == 1:
            return frame[start + self.offset] & self.mask
        return int.from_bytes(frame[start + self.offset : start + self.end], self.order) & self.mask

    def put(self, frame: bytearray, value: int) -> None:
        """Write a value into the frame; the bits outside the mask stay.

        Raises:
            ValueError: the value does not fit.
        """
        mask = self.mask & (1 << 8 * self.size) - 1
        if value & ~mask:
            raise ValueError(f"{value} does not fit into a field of {self.size} bytes with mask {mask:#x}")
        kept = int.from_bytes(frame[self.offset : self.end], self.order) & ~mask
        frame[self.offset : self.end] = (kept | value).to_bytes(self.size, self.order)


class Framed(NamedTuple):
    """A frame found in a stream.

    Attributes:
        identifier: number that distinguishes kinds of frames; 0 if the framing has none.
        end: bytes of the stream up to the end of the frame.
    """

    identifier: int
    body: bytes
    end: int


Splitting = Callable[[int, bytes], Iterable[tuple[int, bytes]]]
"""(identifier, body) of a frame -> (identifier, body) of each frame that it becomes."""


def fill_rows(wire: npt.NDArray[np.void], frames: Sequence[Framed]) -> None:
    """Fill (n,) rows of a batch with frames whose bodies fit into their payloads."""
    width = wire["payload"].shape[1]
    wire["identifier"] = [frame.identifier for frame in frames]
    wire["length"] = [len(frame.body) for frame in frames]
    payloads = b"".join([frame.body.ljust(width, b"\0") for frame in frames])
    wire["payload"] = np.frombuffer(payloads, np.uint8).reshape(len(frames), width)


class Encoding(ABC):
    """The way in which commands are sent."""

    @abstractmethod
    def encode(self, identifier: int, payload: bytes) -> bytes:
        """Return a frame as it is sent.

        Raises:
            ValueError: there is no such frame; the message says why.
        """


class Framing(Encoding):
    """The arrangement of frames in a stream of bytes.

    Attributes:
        maximum_body: bytes of the longest body.
    """

    maximum_body: int

    @abstractmethod
    def framer(self) -> Framer:
        """Return a framer for a stream, from its beginning."""


class ReceivedFraming(Framing):
    """The framing of a stream that is only read."""

    def encode(self, identifier: int, payload: bytes) -> bytes:
        """Refuse to make a frame."""
        raise ValueError(f"frames of this device are only read ({identifier:#x}, {len(payload)} bytes)")


class Framer(ABC):
    """Finds the frames of one stream.

    Attributes:
        counters: counts of bytes and frames; framers that follow each other on one line can share them.
        splitting: what each frame becomes, with the end of the whole; the counters count whole frames.
        is_lost: no more frames can be found, so that the bus must be opened again; False for most framings.
    """

    def __init__(self) -> None:
        self.counters: FramerCounters = FramerCounters()
        self.splitting: Splitting | None = None
        self.is_lost: bool = False
        self._rest = b""
        self._before = 0  # bytes of the stream before the rest
        self._wanted = 0  # bytes without which the rest cannot be judged

    @property
    def position(self) -> int:
        """Bytes of the stream so far."""
        return self._before + len(self._rest)

    @property
    def rest(self) -> bytes:
        """The bytes that may still become part of a frame."""
        return self._rest

    @property
    def pending(self) -> int:
        """The number of those bytes."""
        return len(self._rest)

    def asked(self) -> None:  # noqa: B027  (most framings do not depend on questions)
        """Note that the host sends a question: bytes held back are no part of the answer."""

    def feed(self, chunk: bytes) -> list[Framed]:
        """Take the next bytes of the stream and return the frames that they complete, in order."""
        self.counters.bytes_in += len(chunk)
        stream = self._rest + chunk if self._rest else chunk
        if len(stream) < self._wanted:
            self._rest = stream
            return []
        self._wanted = 0
        found, done = self._find(stream)
        self._rest = stream[done:]
        self._before += done
        self.counters.frames += len(found)
        return self._split(found)

    def _split(self, found: list[Framed]) -> list[Framed]:
        if self.splitting is None:
            return found
        split = self.splitting
        return [Framed(*part, frame.end) for frame in found for part in split(frame.identifier, frame.body)]

    @abstractmethod
    def _find(self, stream: bytes) -> tuple[list[Framed], int]:
        """Return the frames of a stream, and the number of bytes that are judged (and counted)."""


@dataclass(frozen=True)
class Unframed(Framing):
    """Bytes as they come, for consoles and emulators, and for commands that are sent as they are.

    Bytes received together are one frame, or several if they are more than ``maximum_body``: here, and only here,
    frames depend on how the stream is cut into pieces.
    """

    maximum_body: int = 64

    def framer(self) -> Framer:
        return _Pieces(self.maximum_body)

    def encode(self, identifier: int, payload: bytes) -> bytes:  # noqa: ARG002
        """Return the payload."""
        return payload


class _Pieces(Framer):
    def __init__(self, size: int) -> None:
        super().__init__()
        self._size = size

    def _find(self, stream: bytes) -> tuple[list[Framed], int]:
        self.counters.frame_bytes += len(stream)
        pieces = [stream[at : at + self._size] for at in range(0, len(stream), self._size)]
        ends = accumulate(map(len, pieces), initial=self._before)
        next(ends)
        return [Framed(0, piece, end) for piece, end in zip(pieces, ends, strict=True)], len(stream)


def begun(stream: bytes, beginning: bytes) -> int:
    """Return how many bytes at the end of a stream may be part of the beginning of a frame."""
    return next((n for n in range(len(beginning) - 1, 0, -1) if stream.endswith(beginning[:n])), 0)


def check_body(identifier: int, payload: bytes, field: Field | None, minimum: int, maximum: int) -> None:
    """Refuse a frame that cannot be sent.

    Raises:
        ValueError: the payload is too short or too long, or frames cannot carry the identifier.
    """
    if not minimum <= len(payload) <= maximum:
        raise ValueError(f"a payload of {len(payload)} bytes; frames of this device have {minimum} to {maximum}")
    if identifier & ~(0 if field is None else field.mask & (1 << 8 * field.size) - 1):
        raise ValueError(f"frames of this device cannot carry the identifier {identifier:#x}")
