"""How frames between delimiters are kept free of the delimiter: COBS, SLIP, the octet stuffing of HDLC, or not at all.

References: S. Cheshire and M. Baker, "Consistent Overhead Byte Stuffing" (1999); RFC 1055 (SLIP); RFC 1662, section 4
(octet stuffing). Where those leave a choice to a receiver, what no sender would write is refused.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping


class Stuffing(ABC):
    """What stands between delimiters.

    Attributes:
        delimiter: the byte that ends a frame.
    """

    delimiter: int

    @abstractmethod
    def longest(self, size: int) -> int:
        """Bytes that ``size`` bytes take at most, without the delimiter."""

    @abstractmethod
    def encode(self, content: bytes) -> bytes:
        """Content as it is sent, delimiters included."""

    @abstractmethod
    def decode(self, segment: bytes) -> bytes | None:
        """What a segment between delimiters says; None: it has a form that cannot be."""


class Lines(Stuffing):
    """Lines of text: nothing is stuffed. One carriage return before the end of a line belongs to the end."""

    delimiter = 0x0A

    def longest(self, size: int) -> int:
        """Text and carriage return."""
        return size + 1

    def encode(self, content: bytes) -> bytes:
        """The line with its end.

        Raises:
            ValueError: there is an end of line in it.
        """
        if b"\n" in content:
            raise ValueError(f"a line with an end of line in it: {content!r}")
        return content + b"\n"

    def decode(self, segment: bytes) -> bytes:
        """The line without its carriage return."""
        return segment.removesuffix(b"\r")


class Cobs(Stuffing):
    """Consistent overhead byte stuffing: every zero is replaced by the distance to the next."""

    delimiter = 0

    def longest(self, size: int) -> int:
        """One byte for every 254, at least one."""
        return size + size // 254 + 1

    def encode(self, content: bytes) -> bytes:
        """Encoded, with the zero that ends it."""
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
        """The content; None if a distance leads behind the end."""
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
        delimiter: the byte that ends a frame.
        escape: the escape byte.
        sent: what follows the escape byte, for each byte that is replaced by a sender.
        accepted: as ``sent``, for what a receiver takes beyond it.
        opening: frames begin with a delimiter too.

    Attributes:
        escape: the escape byte.
        meaning: which byte it stands for together with each of those that may follow it.
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
        """Every byte escaped."""
        return 2 * size

    def encode(self, content: bytes) -> bytes:
        """Escaped, with delimiters."""
        for byte, code in self._sent:  # the escape byte first
            content = content.replace(bytes([byte]), bytes([self.escape, code]))
        return self._opening + content + bytes([self.delimiter])

    def decode(self, segment: bytes) -> bytes | None:
        """The content; None if what follows an escape byte means nothing."""
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
"""RFC 1662: 7E around a frame, 7D and the byte with bit 5 inverted for 7E, 7D and whatever else the sender likes."""
