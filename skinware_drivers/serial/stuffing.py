"""How frames between delimiters are kept free of the delimiter: COBS, SLIP, the octet stuffing of HDLC, or not at all.

References: S. Cheshire and M. Baker, "Consistent Overhead Byte Stuffing" (1999); RFC 1055 (SLIP); RFC 1662, section 4
(octet stuffing). Where those leave a choice to a receiver, what no sender would write is refused.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from skinware_drivers.serial.gather import Bytes, Indices

_FEW_FRAMES = 64  # so many are followed one by one: the others of a buffer are done with


class Unstuffed(NamedTuple):
    """Many frames, decoded.

    Attributes:
        data: buffer that they lie in.
        start: (n,) first byte of each.
        stop: (n,) one past its last byte.
        right: (n,) bool; the others have a form that cannot be.
    """

    data: Bytes
    start: Indices
    stop: Indices
    right: npt.NDArray[np.bool_]


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

    @abstractmethod
    def decode_many(self, data: Bytes, start: Indices, stop: Indices) -> Unstuffed:
        """What many segments say.

        Args:
            data: the buffer; before the first segment and behind the last it goes on with zeros.
            start: (n,) first byte of each, ascending.
            stop: (n,) where its delimiter is.
        """


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

    def decode_many(self, data: Bytes, start: Indices, stop: Indices) -> Unstuffed:
        """The lines without their carriage returns."""
        stop = stop - ((data[stop - 1] == 0x0D) & (stop > start))
        return Unstuffed(data, start, stop, np.ones(len(start), bool))


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

    def decode_many(self, data: Bytes, start: Indices, stop: Indices) -> Unstuffed:
        """All segments together go from zero to zero, until few of them are left."""
        decoded = data.copy()
        right = np.ones(len(start), bool)
        which, place, end = np.arange(len(start)), start, stop
        dropped: list[Indices] = []
        while len(which) > _FEW_FRAMES:
            code = data[place]
            place = place + code
            right[which[place > end]] = False
            goes_on = np.flatnonzero(place < end)
            which, place, end, code = which[goes_on], place[goes_on], end[goes_on], code[goes_on]
            decoded[place] = 0
            dropped.append(place[code == 0xFF])
        zeros: list[int] = []
        no_zeros: list[int] = []
        view = data.data
        for number, at, stop_at in zip(which.tolist(), place.tolist(), end.tolist(), strict=True):
            while at < stop_at:
                code_here = view[at]
                at += code_here
                if at < stop_at:
                    (no_zeros if code_here == 0xFF else zeros).append(at)
            right[number] = at == stop_at
        decoded[zeros] = 0
        dropped.append(np.array(no_zeros, np.int64))
        content_start = np.minimum(start + 1, stop)
        return _without(decoded, np.sort(np.concatenate(dropped)), content_start, stop, right)


class Escaped(Stuffing):
    """Some bytes are replaced by an escape byte and another byte.

    Args:
        delimiter: the byte that ends a frame.
        escape: the escape byte.
        sent: what follows the escape byte, for each byte that is replaced by a sender.
        accepted: as ``sent``, for what a receiver takes beyond it.
        opening: frames begin with a delimiter too.
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
        self._escape = escape
        self._opening = bytes([delimiter] * opening)
        self._sent = [(escape, sent[escape]), *((byte, code) for byte, code in sent.items() if byte != escape)]
        self._meaning = {code: byte for byte, code in {**(accepted or {}), **sent}.items()}
        self._meaning_of = np.zeros(256, np.uint8)
        self._is_meant = np.zeros(256, bool)
        for code, byte in self._meaning.items():
            self._meaning_of[code], self._is_meant[code] = byte, True

    def longest(self, size: int) -> int:
        """Every byte escaped."""
        return 2 * size

    def encode(self, content: bytes) -> bytes:
        """Escaped, with delimiters."""
        for byte, code in self._sent:  # the escape byte first
            content = content.replace(bytes([byte]), bytes([self._escape, code]))
        return self._opening + content + bytes([self.delimiter])

    def decode(self, segment: bytes) -> bytes | None:
        """The content; None if what follows an escape byte means nothing."""
        first, *others = segment.split(bytes([self._escape]))
        parts = [first]
        for part in others:
            if not part or part[0] not in self._meaning:
                return None
            parts += (bytes([self._meaning[part[0]]]), part[1:])
        return b"".join(parts)

    def decode_many(self, data: Bytes, start: Indices, stop: Indices) -> Unstuffed:
        """All escapes of the buffer together."""
        right = np.ones(len(start), bool)
        escape = np.flatnonzero(data[: stop[-1]] == self._escape) if len(stop) else start
        if not len(escape):
            return Unstuffed(data, start, stop, right)
        code = data[escape + 1]
        wrong = escape[~self._is_meant[code]]
        right[np.searchsorted(stop, wrong)] = False
        decoded = data.copy()
        decoded[escape + 1] = self._meaning_of[code]
        return _without(decoded, escape, start, stop, right)


def _without(data: Bytes, dropped: Indices, start: Indices, stop: Indices, right: npt.NDArray[np.bool_]) -> Unstuffed:
    """The same with some bytes (ascending) left out."""
    if not len(dropped):
        return Unstuffed(data, start, stop, right)
    kept = np.ones(len(data), bool)
    kept[dropped] = False
    start = start - np.searchsorted(dropped, start)
    stop = stop - np.searchsorted(dropped, stop)
    return Unstuffed(data[kept], start, stop, right)


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
