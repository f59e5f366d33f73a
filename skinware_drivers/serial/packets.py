"""Frames that begin with a known pattern and say, or are known to have, a length: how they are declared and sent."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

from skinware.errors import ConfigurationError
from skinware_drivers.serial.checksums import Checksum
from skinware_drivers.serial.framing import Field, Framer, Framing, check_body

Pattern = Sequence[int | Collection[int]]
"""What each byte is, or which values it can have."""


@dataclass(frozen=True)
class Length:
    """The length of a frame is what a field says, and some bytes more.

    Attributes:
        field: where it is said.
        more: bytes of the whole frame that the field does not count.
    """

    field: Field
    more: int


@dataclass(frozen=True)
class LengthTable:
    """A byte of the header tells how long a frame is.

    Attributes:
        offset: place of the byte.
        total: bytes of the whole frame for each value that the byte can have.
    """

    offset: int
    total: Mapping[int, int] = field(hash=False)


@dataclass(frozen=True, kw_only=True)
class Packet(Framing):
    """Frames of known beginning and length: header, body, checksum and trailer.

    A beginning can lie by chance in a body, or in what a damaged frame left. If a frame then does not hold what it
    promises (checksum, trailer, a length that can be), the search goes on one byte after that beginning, and the next
    whole frame is found. Until as many bytes have arrived as a false beginning promises, it cannot be told.

    Attributes:
        sync: first bytes of every frame.
        length: bytes of a whole frame, or how it is told.
        maximum: bytes of the longest whole frame; needed with :class:`Length`.
        checksum: of the bytes ``covers``.
        checksum_at: place of the checksum in the header; default: behind the body.
        covers: bytes that the checksum is of: (start, end); end counts from the end of the frame and is at most 0.
            Default: everything before the checksum, or (with ``checksum_at``) everything behind it.
        bare_when_empty: a frame whose length field says 0 has no checksum (Schunk DSACON32).
        trailer: last bytes of every frame.
        identifier: number in the header that tells kinds of frame apart.
        header: bytes before the body; default: up to the last of sync, length, identifier and checksum in front.
        confirmed: a frame that does not follow another one at once counts only if the next one begins right behind
            it (and, with a trailer, ends as it should). For devices without a checksum; costs one frame of delay
            after every fault. ``"each"``: every frame is confirmed so, always; for devices whose frames have so little
            that can be checked that a shortened one passes together with the beginning of the next.

    Raises:
        ConfigurationError: what it says cannot be.
    """

    sync: Pattern = ()
    length: int | Length | LengthTable
    maximum: int = 0
    checksum: Checksum | None = None
    checksum_at: int | None = None
    covers: tuple[int, int] | None = None
    bare_when_empty: bool = False
    trailer: Pattern = ()
    identifier: Field | None = None
    header: int | None = None
    confirmed: bool | Literal["each"] = False
    maximum_body: int = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "maximum_body", self.longest - self.body_start - self.behind)
        if not self.sync and not self.trailer and self.checksum is None:
            raise ConfigurationError("frames without sync, trailer and checksum cannot be told from anything else")
        if isinstance(self.length, Length) and not self.maximum:
            raise ConfigurationError("frames say how long they are: say how long they can be (maximum)")
        if self.confirmed and not isinstance(self.length, int):
            raise ConfigurationError("only frames of one length can be confirmed by the next")
        if self.shortest > self.longest or self.shortest < 1:
            raise ConfigurationError(f"the longest frame has {self.longest} bytes, the shortest {self.shortest}")
        most = self.shortest + (self.checksum.size if self.bare_when_empty and self.checksum else 0)
        if self.checksum is not None and not 0 <= self.covered(most)[0] <= self.covered(most)[1] <= most:
            raise ConfigurationError(f"the checksum covers bytes {self.covered(most)} of a frame of {most}")
        if self.bare_when_empty and (not isinstance(self.length, Length) or self.checksum_at is not None):
            raise ConfigurationError("bare_when_empty needs a length field, and a checksum at the end")

    @property
    def body_start(self) -> int:
        """Bytes before the body."""
        if self.header is not None:
            return self.header
        ends = [len(self.sync)]
        if isinstance(self.length, Length):
            ends.append(self.length.field.end)
        elif isinstance(self.length, LengthTable):
            ends.append(self.length.offset + 1)
        if self.identifier is not None:
            ends.append(self.identifier.end)
        if self.checksum is not None and self.checksum_at is not None:
            ends.append(self.checksum_at + self.checksum.size)
        return max(ends)

    @property
    def behind(self) -> int:
        """Bytes behind the body."""
        return len(self.trailer) + (self.checksum.size if self.checksum and self.checksum_at is None else 0)

    @property
    def shortest(self) -> int:
        """Bytes of the shortest frame."""
        if isinstance(self.length, int):
            return self.length
        least = self.body_start + self.behind
        if isinstance(self.length, LengthTable):
            return min((total for total in self.length.total.values() if total >= least), default=least)
        return least - (self.checksum.size if self.bare_when_empty and self.checksum else 0)

    @property
    def longest(self) -> int:
        """Bytes of the longest frame."""
        if isinstance(self.length, int):
            return self.length
        if isinstance(self.length, LengthTable):
            return max(self.length.total.values(), default=0)
        return self.maximum

    def framer(self) -> Framer:
        """Something to feed a stream to."""
        from skinware_drivers.serial.packet_framer import PacketFramer  # which needs what is declared here

        return PacketFramer(self)

    def encode(self, identifier: int, payload: bytes) -> bytes:
        """A frame as it is sent; what the declaration leaves open in the header is zero.

        Raises:
            ValueError: there is no such frame.
        """
        least = self.shortest - self.body_start - self.behind if isinstance(self.length, int) else 0
        check_body(identifier, payload, self.identifier, least, self.maximum_body)
        frame = bytearray(_first(self.sync)).ljust(self.body_start, b"\0")
        total = self.body_start + len(payload) + self.behind
        has_checksum = self.checksum is not None
        if isinstance(self.length, Length):
            says = total - self.length.more
            has_checksum = has_checksum and not (self.bare_when_empty and says == 0)
            self.length.field.put(frame, says)
        if self.identifier is not None:
            self.identifier.put(frame, identifier)
        frame += payload
        if self.checksum is not None and has_checksum:
            if self.checksum_at is None:
                frame += bytes(self.checksum.size)
            frame += _first(self.trailer)
            covered_from, covered_to = self.covered(len(frame))
            at = self.checksum_place(len(frame))
            frame[at : at + self.checksum.size] = self.checksum.to_bytes(bytes(frame[covered_from:covered_to]))
        else:
            frame += _first(self.trailer)
        made = bytes(frame)
        if not all(byte in values_of(what) for byte, what in zip(made, self.sync, strict=False)):
            raise ValueError(f"frames of this device cannot carry the identifier {identifier:#x}")
        if isinstance(self.length, LengthTable) and self.length.total.get(made[self.length.offset]) != len(made):
            raise ValueError(f"no frame of this device has {len(payload)} bytes of payload and begins {made[:8].hex()}")
        return made

    def checksum_place(self, total: int) -> int:
        """Where the checksum begins in a frame of so many bytes."""
        return total - self.behind if self.checksum_at is None else self.checksum_at

    def covered(self, total: int) -> tuple[int, int]:
        """First byte that the checksum covers, and one past the last, in a frame of so many bytes."""
        if self.covers is not None:
            return self.covers[0], total + self.covers[1]
        if self.checksum_at is None or self.checksum is None:
            return 0, total - self.behind
        return self.checksum_at + self.checksum.size, total - len(self.trailer)


def values_of(what: int | Collection[int]) -> list[int]:
    """Which values a byte of a pattern can have, ascending."""
    return [what] if isinstance(what, int) else sorted(what)


def _first(pattern: Pattern) -> bytes:
    return bytes(values_of(what)[0] for what in pattern)


__all__ = ["Length", "LengthTable", "Packet", "Pattern", "values_of"]
