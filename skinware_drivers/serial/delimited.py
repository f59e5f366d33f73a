"""Frames that end with a delimiter: lines, COBS, SLIP, and the stuffing of HDLC and PPP."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import accumulate, pairwise

from skinware.errors import ConfigurationError
from skinware_drivers.serial.checksums import Checksum
from skinware_drivers.serial.framing import Field, Framed, Framer, Framing, check_body
from skinware_drivers.serial.stuffing import Stuffing


@dataclass(frozen=True)
class Delimited(Framing):
    """Frames that end with a delimiter: header, body and checksum, stuffed.

    The rest of a damaged frame ends at the next delimiter, and the frame after it is found.

    Attributes:
        stuffing: ``LINES``, ``COBS``, ``SLIP`` or ``HDLC``.
        maximum_body: bytes of the longest body. Bodies that are longer are skipped.
        minimum_body: bytes of the shortest. 0: empty lines are frames.
        checksum: of header and body, at the end.
        identifier: number in the header that tells kinds of frame apart.
        header: bytes before the body; default: up to the end of ``identifier``.
        trusts_first: what arrives before the first delimiter is a frame if it looks like one. Default: only with a
            checksum; without one it may as well be the end of a frame.

    Raises:
        ConfigurationError: the identifier is not in the header, or the lengths are impossible.
    """

    stuffing: Stuffing
    maximum_body: int
    minimum_body: int = 1
    checksum: Checksum | None = None
    identifier: Field | None = None
    header: int | None = None
    trusts_first: bool | None = None

    def __post_init__(self) -> None:
        if not 0 <= self.minimum_body <= self.maximum_body:
            raise ConfigurationError(f"bodies of {self.minimum_body} to {self.maximum_body} bytes cannot be")
        if self.identifier is not None and self.identifier.end > self.body_start:
            raise ConfigurationError(f"the identifier is not within the header of {self.body_start} bytes")

    @property
    def body_start(self) -> int:
        """Bytes before the body."""
        if self.header is not None:
            return self.header
        return self.identifier.end if self.identifier is not None else 0

    @property
    def overhead(self) -> int:
        """Bytes of header and checksum."""
        return self.body_start + (self.checksum.size if self.checksum is not None else 0)

    @property
    def is_first_trusted(self) -> bool:
        """Whether what arrives before the first delimiter may be a frame."""
        return self.checksum is not None if self.trusts_first is None else self.trusts_first

    def framer(self) -> Framer:
        """Something to feed a stream to."""
        return DelimitedFramer(self)

    def encode(self, identifier: int, payload: bytes) -> bytes:
        """A frame as it is sent; the header is zero except for the identifier.

        Raises:
            ValueError: there is no such frame.
        """
        check_body(identifier, payload, self.identifier, self.minimum_body, self.maximum_body)
        header = bytearray(self.body_start)
        if self.identifier is not None:
            self.identifier.put(header, identifier)
        content = bytes(header) + payload
        if self.checksum is not None:
            content += self.checksum.to_bytes(content)
        return self.stuffing.encode(content)


class DelimitedFramer(Framer):
    """Finds the frames of a stream with delimiters."""

    def __init__(self, framing: Delimited) -> None:
        super().__init__()
        self._framing = framing
        self._shortest = framing.minimum_body + framing.overhead
        self._longest = framing.maximum_body + framing.overhead
        self._longest_segment = framing.stuffing.longest(self._longest)
        self._delimiter = bytes([framing.stuffing.delimiter])
        self._decode = framing.stuffing.decode
        self._checksum_size = framing.checksum.size if framing.checksum is not None else 0
        self._discarding = not framing.is_first_trusted  # everything up to the next delimiter

    def _find(self, stream: bytes) -> tuple[list[Framed], int]:
        *segments, rest = stream.split(self._delimiter)
        ends = list(accumulate([len(segment) + 1 for segment in segments], initial=self._before))
        if self._discarding and segments:
            self._discarding = False
            self.counters.skipped_bytes += len(segments[0]) + 1
            del segments[0], ends[0]
        first, field = self._framing.body_start, self._framing.identifier
        found: list[Framed] = []
        for segment, (begin, end) in zip(segments, pairwise(ends), strict=True):
            content = self._content(segment)
            if content is not None:
                self.counters.frame_bytes += end - begin
                found.append(Framed(0 if field is None else field.of(content), content[first:], end))
        return found, len(stream) - self._keep(len(rest))

    def _content(self, segment: bytes) -> bytes | None:
        """Header and body of a segment; None, and counted, if it is no frame."""
        content = self._decode(segment) if len(segment) <= self._longest_segment else None
        if content is not None and self._shortest <= len(content) <= self._longest:
            checksum = self._framing.checksum
            if checksum is None:
                return content
            size = self._checksum_size
            covered = content[:-size]
            if checksum.of(covered) == int.from_bytes(content[-size:], checksum.order):
                return covered
            self.counters.checksum_errors += 1
        elif content == b"":
            self.counters.idle_bytes += len(segment) + 1
            return None
        else:
            self.counters.refused += 1
        self.counters.skipped_bytes += len(segment) + 1
        return None

    def _keep(self, rest: int) -> int:
        """How many of the bytes behind the last delimiter are kept; none of a frame that is too long already."""
        if not self._discarding and rest > self._longest_segment:
            self._discarding = True
            self.counters.refused += 1
        if self._discarding:
            self.counters.skipped_bytes += rest
            return 0
        return rest
