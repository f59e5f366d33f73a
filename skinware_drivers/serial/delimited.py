"""Find frames that end with a delimiter, stuffed so that it does not occur in them: COBS, SLIP, HDLC, or lines of text.

References: S. Cheshire and M. Baker, "Consistent Overhead Byte Stuffing" (1999); RFC 1055 (SLIP); RFC 1662, section 4
(octet stuffing). Where they leave a choice to a receiver, anything that no sender would write is refused.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import accumulate, pairwise

from skinware.errors import ConfigurationError
from skinware_drivers.serial.checksums import Checksum
from skinware_drivers.serial.framing import Field, Framed, Framer, Framing, check_body


class Stuffing(ABC):
    """The coding of the bytes between two delimiters."""

    delimiter: int

    @abstractmethod
    def longest(self, size: int) -> int:
        """Return the most bytes that ``size`` bytes take, without the delimiter."""

    @abstractmethod
    def encode(self, content: bytes) -> bytes:
        """Return content as it is sent, with delimiters."""

    @abstractmethod
    def decode(self, segment: bytes) -> bytes | None:
        """Return the content of a segment between delimiters; None if the segment is malformed."""


class Lines(Stuffing):
    """Lines of text: nothing is stuffed. One carriage return before the end of a line belongs to the end."""

    delimiter = 0x0A

    def longest(self, size: int) -> int:
        return size + 1

    def encode(self, content: bytes) -> bytes:
        """Return the line with its end.

        Raises:
            ValueError: the content has an end of line in it.
        """
        if b"\n" in content:
            raise ValueError(f"a line with an end of line in it: {content!r}")
        return content + b"\n"

    def decode(self, segment: bytes) -> bytes:
        return segment.removesuffix(b"\r")


class Cobs(Stuffing):
    """Consistent overhead byte stuffing: every zero is replaced by the distance to the next."""

    delimiter = 0

    def longest(self, size: int) -> int:
        return size + size // 254 + 1

    def encode(self, content: bytes) -> bytes:
        encoded = bytearray()
        parts = content.split(b"\0")
        for number, part in enumerate(parts):
            while len(part) >= 254:
                encoded += b"\xff" + part[:254]
                part = part[254:]
                if not part and number == len(parts) - 1:
                    return bytes(encoded) + b"\0"
            encoded += bytes([len(part) + 1]) + part
        return bytes(encoded) + b"\0"

    def decode(self, segment: bytes) -> bytes | None:
        """Return the content; None if a distance leads beyond the end."""
        size = len(segment)
        if not size:
            return b""
        code = segment[0]
        if code == size:
            return segment[1:]
        parts = []
        place = 0
        while place < size:
            code = segment[place]
            parts.append(segment[place + 1 : place + code])
            place += code
            if code < 0xFF and place < size:
                parts.append(b"\0")
        return b"".join(parts) if place == size else None


class Escaped(Stuffing):
    """Some bytes are replaced by an escape byte and another byte.

    Args:
        sent: the byte behind the escape byte, for each byte that a sender replaces.
        accepted: further replacements that a receiver accepts.
        opening: frames begin with a delimiter too.

    Attributes:
        meaning: the byte that each byte behind the escape byte stands for.
    """

    def __init__(
        self,
        delimiter: int,
        escape: int,
        sent: Mapping[int, int],
        accepted: Mapping[int, int] | None = None,
        *,
        opening: bool = True,
    ) -> None:
        self.delimiter = delimiter
        self.escape = escape
        self._opening = bytes([delimiter] * opening)
        self._sent = [(escape, sent[escape]), *((byte, code) for byte, code in sent.items() if byte != escape)]
        self.meaning = {code: byte for byte, code in {**(accepted or {}), **sent}.items()}

    def longest(self, size: int) -> int:
        return 2 * size

    def encode(self, content: bytes) -> bytes:
        for byte, code in self._sent:  # the escape byte first
            content = content.replace(bytes([byte]), bytes([self.escape, code]))
        return self._opening + content + bytes([self.delimiter])

    def decode(self, segment: bytes) -> bytes | None:
        """Return the content; None if the byte behind an escape byte has no meaning."""
        first, *others = segment.split(bytes([self.escape]))
        parts = [first]
        for part in others:
            if not part or part[0] not in self.meaning:
                return None
            parts += (bytes([self.meaning[part[0]]]), part[1:])
        return b"".join(parts)


LINES = Lines()
"""Lines of text."""
COBS = Cobs()
"""Consistent overhead byte stuffing, delimited by zeros."""
SLIP = Escaped(0xC0, 0xDB, {0xC0: 0xDC, 0xDB: 0xDD})
"""RFC 1055: C0 ends a frame, DB DC stands for C0, DB DD for DB."""
HDLC = Escaped(
    0x7E,
    0x7D,
    {0x7E: 0x5E, 0x7D: 0x5D},
    {byte: byte ^ 0x20 for byte in range(256) if byte ^ 0x20 not in (0x7E, 0x7D)},
)
"""RFC 1662: 7E around a frame; 7D and a byte with bit 5 inverted for 7E, 7D and any other byte the sender chooses."""


@dataclass(frozen=True)
class Delimited(Framing):
    """Frames that end with a delimiter: header, body and checksum, stuffed.

    The rest of a damaged frame ends at the next delimiter, and the frame behind it is found.

    Attributes:
        stuffing: ``LINES``, ``COBS``, ``SLIP`` or ``HDLC``.
        maximum_body: bytes of the longest body; longer ones are skipped.
        minimum_body: bytes of the shortest body; 0: empty lines are frames.
        checksum: of header and body, at the end.
        identifier: number in the header that distinguishes kinds of frames.
        header: bytes before the body; default: up to the end of ``identifier``.
        trusts_first: bytes before the first delimiter are a frame if they look like one. Default: only with a
            checksum; without one they may be the end of a frame.

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
        """Whether the bytes before the first delimiter may be a frame."""
        return self.checksum is not None if self.trusts_first is None else self.trusts_first

    def framer(self) -> Framer:
        return DelimitedFramer(self)

    def encode(self, identifier: int, payload: bytes) -> bytes:
        """Return a frame as it is sent; the header is zero except for the identifier."""
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
        kept = len(rest)
        if not self._discarding and kept > self._longest_segment:
            self._discarding = True
            self.counters.refused += 1
        if self._discarding:
            self.counters.skipped_bytes += kept
            kept = 0
        return found, len(stream) - kept

    def _content(self, segment: bytes) -> bytes | None:
        """Return header and body of a segment; None, and counted, if it is no frame."""
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
