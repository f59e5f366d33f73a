"""Find frames that end with a delimiter, stuffed so that it does not occur in them: COBS, SLIP, HDLC, or lines of text.

References: S. Cheshire and M. Baker, "Consistent Overhead Byte Stuffing" (1999); RFC 1055 (SLIP); RFC 1662, section 4
(octet stuffing). Where they leave a choice to a receiver, anything that no sender would write is refused.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from skinware.errors import ConfigurationError
from skinware_drivers.native import structs
from skinware_drivers.serial.checksums import Checksum
from skinware_drivers.serial.framing import Field, check_body
from skinware_drivers.serial.stream import (
    BYTE_VALUES,
    COBS_FORM,
    ESCAPED_FORM,
    LINE_FORM,
    CompiledFraming,
    check_parts,
    compile_checksum,
    compile_field,
)


class Stuffing(ABC):
    """The coding of the bytes between two delimiters."""

    delimiter: int

    @abstractmethod
    def longest(self, size: int) -> int:
        """Return the most bytes that ``size`` bytes take, without the delimiter."""

    @abstractmethod
    def encode(self, content: bytes) -> bytes:
        """Return content as it is sent, with delimiters."""


class Lines(Stuffing):
    """Lines of text: nothing is stuffed. One carriage return before the end of a line belongs to the end."""

    delimiter = 0x0A

    def longest(self, size: int) -> int:
        return size + 1

    def encode(self, content: bytes) -> bytes:
        """Return the line with its end."""
        if b"\n" in content:
            raise ValueError(f"a line with an end of line in it: {content!r}")
        return content + b"\n"


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


class Escaped(Stuffing):
    """Some bytes are replaced by an escape byte and another byte; frames also begin with a delimiter.

    Args:
        sent: the byte behind the escape byte, for each byte that a sender replaces.
        accepted: further replacements that a receiver accepts.

    Attributes:
        meaning: the byte that each byte behind the escape byte stands for.
    """

    def __init__(
        self,
        delimiter: int,
        escape: int,
        sent: Mapping[int, int],
        accepted: Mapping[int, int] | None = None,
    ) -> None:
        self.delimiter = delimiter
        self.escape = escape
        self._sent = [(escape, sent[escape]), *((byte, code) for byte, code in sent.items() if byte != escape)]
        self.meaning = {code: byte for byte, code in {**(accepted or {}), **sent}.items()}

    def longest(self, size: int) -> int:
        return 2 * size

    def encode(self, content: bytes) -> bytes:
        for byte, code in self._sent:  # the escape byte first
            content = content.replace(bytes([byte]), bytes([self.escape, code]))
        return bytes([self.delimiter]) + content + bytes([self.delimiter])


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
class Delimited(CompiledFraming):
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
        check_parts(self.checksum, self.identifier)
        if type(self.stuffing) not in (Lines, Cobs, Escaped) or self.body_start < 0:
            raise ConfigurationError("stuffing is LINES, COBS, SLIP, HDLC or an Escaped; a header has 0 bytes or more")

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

    def compiled(self, arrays: structs.Arrays) -> structs.Framing:
        compiled, stuffing = structs.Framing(form=LINE_FORM, body_start=self.body_start), self.stuffing
        if self.identifier is not None:
            compiled.identifier = compile_field(self.identifier)
        if self.checksum is not None:
            compiled.checksum = compile_checksum(self.checksum, arrays)
        compiled.shortest, compiled.longest = self.minimum_body + self.overhead, self.maximum_body + self.overhead
        compiled.delimiter, compiled.longest_segment = stuffing.delimiter, stuffing.longest(compiled.longest)
        if isinstance(stuffing, Cobs):
            compiled.form = COBS_FORM
        elif isinstance(stuffing, Escaped):
            compiled.form, compiled.escape = ESCAPED_FORM, stuffing.escape
            compiled.meaning = arrays.of([stuffing.meaning.get(byte, -1) for byte in range(BYTE_VALUES)], np.int16)
        return compiled

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
