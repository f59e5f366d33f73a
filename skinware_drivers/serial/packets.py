"""Find frames with a known beginning and a length that is known or in the frame."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

from skinware.errors import ConfigurationError
from skinware_drivers.serial.checksums import Checksum
from skinware_drivers.serial.framing import Field, Framed, Framer, Framing, check_body

_GOOD, _REFUSED, _INCOMPLETE = range(3)

Pattern = Sequence[int | Collection[int]]
"""The value of each byte, or the values that it can have."""


@dataclass(frozen=True)
class Length:
    """A field with the length of a frame, apart from a constant number of bytes.

    Attributes:
        field: place of the length.
        more: bytes of the whole frame that the field does not count.
    """

    field: Field
    more: int


@dataclass(frozen=True)
class LengthTable:
    """A byte of the header determines the length of a frame, or the place of the length.

    Attributes:
        offset: place of the byte.
        total: bytes of the whole frame, or a field with them, for each value that the byte can have.
    """

    offset: int
    total: Mapping[int, int | Length] = field(hash=False)

    @property
    def has_fields(self) -> bool:
        """Whether some frames have a length field."""
        return any(isinstance(total, Length) for total in self.total.values())


@dataclass(frozen=True, kw_only=True)
class Packet(Framing):
    """Frames with a known beginning and length: header, body, checksum and trailer.

    The bytes of a beginning can also occur in a body, or in the rest of a damaged frame. If the checksum, the trailer
    or the length is then wrong, the search continues one byte later, and the next whole frame is found. This is known
    only when as many bytes have arrived as the false beginning claims.

    Attributes:
        sync: first bytes of every frame.
        length: bytes of a whole frame, or the place of the length in it.
        maximum: bytes of the longest whole frame; needed with :class:`Length`, also in a table.
        checksum: of the bytes ``covers``.
        checksum_at: place of the checksum in the header; default: behind the body.
        covers: the bytes under the checksum: (start, end); end counts from the end of the frame and is at most 0.
            Default: everything before the checksum, or (with ``checksum_at``) everything behind it.
        bare_when_empty: a frame whose length field is 0 has no checksum (Schunk DSACON32).
        trailer: last bytes of every frame.
        identifier: number in the header that distinguishes kinds of frames.
        header: bytes before the body; default: up to the last of sync, length, identifier and checksum in front.
        confirmed: a frame that does not follow another one at once counts only if the next one begins right behind
            it (and, with a trailer, ends correctly). For devices without a checksum; costs one frame of delay after
            every fault. ``"each"``: every frame is confirmed in this way; for devices whose frames offer so little to
            check that a shortened one passes together with the beginning of the next.

    Raises:
        ConfigurationError: the declaration contradicts itself.
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
        for what in (self.sync, self.trailer):
            if isinstance(what, str):
                raise ConfigurationError(f"sync and trailer are bytes: write b{what!r}, not {what!r}")
        object.__setattr__(self, "maximum_body", self.longest - self.body_start - self.behind)
        if not self.sync and not self.trailer and self.checksum is None:
            raise ConfigurationError("frames without sync, trailer and checksum cannot be recognized")
        has_field = isinstance(self.length, LengthTable) and self.length.has_fields
        if (has_field or isinstance(self.length, Length)) and not self.maximum:
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
        least = max(self.body_start, 0 if self.identifier is None else self.identifier.end) + self.behind
        if isinstance(self.length, LengthTable):
            totals = [max(least, t.more) if isinstance(t, Length) else t for t in self.length.total.values()]
            return min((total for total in totals if total >= least), default=least)
        return least - (self.checksum.size if self.bare_when_empty and self.checksum else 0)

    @property
    def longest(self) -> int:
        """Bytes of the longest frame."""
        if isinstance(self.length, int):
            return self.length
        if isinstance(self.length, LengthTable) and not self.length.has_fields:
            return max((total for total in self.length.total.values() if isinstance(total, int)), default=0)
        return self.maximum

    @property
    def known_from(self) -> int:
        """Bytes of a frame from which on its length is known."""
        if isinstance(self.length, Length):
            return max(len(self.sync), self.length.field.end)
        if isinstance(self.length, LengthTable):
            return max(len(self.sync), self.length.offset + 1)
        return len(self.sync)

    @property
    def look_ahead(self) -> int:
        """Bytes behind a frame that are needed to confirm it."""
        if not self.confirmed:
            return 0
        return self.longest if self.trailer else len(self.sync)

    def framer(self) -> Framer:
        return PacketFramer(self)

    def encode(self, identifier: int, payload: bytes) -> bytes:
        """Return a frame as it is sent; bytes of the header that the declaration leaves open are zero.

        Identifier and length are written at their places, also over the payload.

        Raises:
            ValueError: there is no such frame.
        """
        least = self.shortest - self.body_start - self.behind if isinstance(self.length, int) else 0
        check_body(identifier, payload, self.identifier, least, self.maximum_body)
        frame = bytearray(_first(self.sync)[: self.body_start]).ljust(self.body_start, b"\0") + payload
        total = self.body_start + len(payload) + self.behind
        has_checksum = self.checksum is not None
        if len(frame) < max(0 if self.identifier is None else self.identifier.end, self.known_from):
            raise ValueError(f"{len(payload)} bytes of payload have no room for identifier and length")
        if self.identifier is not None:
            self.identifier.put(frame, identifier)
        length = self._length_field(frame)
        if length is not None:
            if length.field.end > len(frame):
                raise ValueError(f"{len(payload)} bytes of payload have no room for the length of the frame")
            says = total - length.more
            has_checksum = has_checksum and not (self.bare_when_empty and says == 0)
            length.field.put(frame, says)
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
        table = self.length if isinstance(self.length, LengthTable) and length is None else None
        if table is not None and table.total.get(made[table.offset]) != len(made):
            raise ValueError(f"no frame of this device has {len(payload)} bytes of payload and begins {made[:8].hex()}")
        return made

    def _length_field(self, header: bytes | bytearray) -> Length | None:
        """Return the length field of frames with this header; None if they have none."""
        length: int | Length | LengthTable = self.length
        if isinstance(length, LengthTable):
            length = length.total.get(header[length.offset], 0) if length.has_fields else 0
        return length if isinstance(length, Length) else None

    def checksum_place(self, total: int) -> int:
        """Return where the checksum begins in a frame of ``total`` bytes."""
        return total - self.behind if self.checksum_at is None else self.checksum_at

    def covered(self, total: int) -> tuple[int, int]:
        """Return the first byte under the checksum, and one past the last, in a frame of ``total`` bytes."""
        if self.covers is not None:
            return self.covers[0], total + self.covers[1]
        if self.checksum_at is None or self.checksum is None:
            return 0, total - self.behind
        return self.checksum_at + self.checksum.size, total - len(self.trailer)


def values_of(what: int | Collection[int]) -> list[int]:
    """Return the values that a byte of a pattern can have, ascending."""
    return [what] if isinstance(what, int) else sorted(what)


def _first(pattern: Pattern) -> bytes:
    return bytes(values_of(what)[0] for what in pattern)


class PacketFramer(Framer):
    """Finds the frames of a stream by their beginnings."""

    def __init__(self, framing: Packet) -> None:
        super().__init__()
        self._framing = framing
        self._begin = re.compile(_prefixes([values_of(what) for what in framing.sync]), re.DOTALL)
        self._whole_sync = re.compile(b"".join(_one_of(values_of(what)) for what in framing.sync), re.DOTALL)
        self._whole_trailer = re.compile(b"".join(_one_of(values_of(what)) for what in framing.trailer), re.DOTALL)
        self._known_from, self._look_ahead = framing.known_from, framing.look_ahead
        self._bare = framing.checksum.size if framing.bare_when_empty and framing.checksum else 0
        self._checksum_at = framing.checksum_place(0)  # from the end, if negative
        self._covered_from, self._covered_to = framing.covered(0)  # from the beginning, and from the end
        self._confirms_each = framing.confirmed == "each"
        self._follows_at = -1  # place in the stream at which a frame would follow the last one at once

    def _find(self, stream: bytes) -> tuple[list[Framed], int]:
        found: list[tuple[int, int, bool]] = []
        done = self._search(stream, 0, found)
        framing, field = self._framing, self._framing.identifier
        first, behind, bare = framing.body_start, framing.behind, self._bare
        return [
            Framed(
                0 if field is None else field.of(stream, place),
                stream[place + first : place + total - behind + (bare if is_bare else 0)],
                self._before + place + total,
            )
            for place, total, is_bare in found
        ], done

    def _search(self, stream: bytes, place: int, found: list[tuple[int, int, bool]]) -> int:
        """Judge possible beginnings from ``place`` on; return the place of the first that needs more bytes."""
        counters, size = self.counters, len(stream)
        while True:
            match = self._begin.search(stream, place)
            begin = size if match is None else match.start()
            counters.skipped_bytes += begin - place
            place = begin
            if size - place < self._known_from or place == size:
                return place
            total, is_bare = self._total(stream, place)
            follows = not self._look_ahead or (not self._confirms_each and self._before + place == self._follows_at)
            if total:
                if size - place < total:
                    self._wanted = total
                    return place
                form = self._form(stream, place, total, follows)
                if form == _INCOMPLETE:
                    self._wanted = total + self._look_ahead
                    return place
                if form == _GOOD:
                    if is_bare or self._has_checksum(stream, place, total):
                        counters.frame_bytes += total
                        found.append((place, total, is_bare))
                        place += total
                        self._follows_at = self._before + place
                        continue
                    counters.checksum_errors += 1
                else:
                    counters.refused += 1
            else:
                counters.refused += 1
            counters.skipped_bytes += 1
            place += 1

    def _total(self, stream: bytes, place: int) -> tuple[int, bool]:
        """Return the bytes of the frame that begins here, 0 if impossible; and whether it has no checksum."""
        framing = self._framing
        length: int | Length | LengthTable = framing.length
        if isinstance(length, LengthTable):
            length = length.total.get(stream[place + length.offset], 0)
        if isinstance(length, int):
            total, is_bare = length, False
        elif len(stream) - place < length.field.end:  # at least
            return length.field.end, False
        else:
            says = length.field.of(stream, place)
            is_bare = says == 0 and self._bare > 0
            total = says + length.more - (self._bare if is_bare else 0)
        return (total if framing.shortest <= total <= framing.longest else 0), is_bare

    def _form(self, stream: bytes, place: int, total: int, follows: bool) -> int:
        """Judge the trailer of the frame and, unless it follows another one, the beginning of the next."""
        n = len(self._framing.trailer)
        if n and not self._whole_trailer.match(stream, place + total - n):
            return _REFUSED
        if follows:
            return _GOOD
        if len(stream) - place < total + self._look_ahead:
            return _INCOMPLETE
        if not self._whole_sync.match(stream, place + total):
            return _REFUSED
        return _GOOD if not n or self._whole_trailer.match(stream, place + 2 * total - n) else _REFUSED

    def _has_checksum(self, stream: bytes, place: int, total: int) -> bool:
        checksum = self._framing.checksum
        if checksum is None:
            return True
        end = place + total
        at = (end if self._checksum_at < 0 else place) + self._checksum_at
        covered = stream[place + self._covered_from : end + self._covered_to]
        return checksum.of(covered) == int.from_bytes(stream[at : at + checksum.size], checksum.order)


def _one_of(values: Sequence[int]) -> bytes:
    return b"[" + b"".join(re.escape(bytes([value])) for value in values) + b"]"


def _prefixes(pattern: Sequence[Sequence[int]]) -> bytes:
    """Return a regular expression of the pattern, or of its beginning at the end of the stream."""
    if not pattern:
        return b""
    rest = _prefixes(pattern[1:])
    return _one_of(pattern[0]) + (b"(?:\\Z|" + rest + b")" if rest else b"")
