"""Find frames with a known beginning and a length that is known or in the frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from skinware.errors import ConfigurationError
from skinware_drivers.native import structs
from skinware_drivers.serial.checksums import Checksum
from skinware_drivers.serial.framing import Field, check_body
from skinware_drivers.serial.stream import (
    BYTE_VALUES,
    PACKET_FORM,
    CompiledFraming,
    Pattern,
    check_parts,
    compile_checksum,
    compile_field,
    compile_pattern,
    values_of,
)

_LENGTHS_COMPARED = 4
"""Frames in which marks are compared (MISSES and MARKS + 1 in ``framing.c``)."""


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
class Packet(CompiledFraming):
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
            every fault, and four while values look like a beginning in frame after frame. ``"each"``: every frame is
            confirmed in this way; for devices whose frames offer so little to check that a shortened one passes
            together with the beginning of the next.

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
        if self.confirmed and not (isinstance(self.length, int) and self.checksum is None):
            raise ConfigurationError("only frames of one length, without a checksum, can be confirmed by the next")
        if self.shortest > self.longest or self.shortest < 1:
            raise ConfigurationError(f"the longest frame has {self.longest} bytes, the shortest {self.shortest}")
        most = self.shortest + (self.checksum.size if self.bare_when_empty and self.checksum else 0)
        if self.checksum is not None and not 0 <= self.covered(most)[0] <= self.covered(most)[1] <= most:
            raise ConfigurationError(f"the checksum covers bytes {self.covered(most)} of a frame of {most}")
        if self.bare_when_empty and (not isinstance(self.length, Length) or self.checksum_at is not None):
            raise ConfigurationError("bare_when_empty needs a length field, and a checksum at the end")
        check_parts(self.checksum, self.identifier)
        self._check_places()

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

    @property
    def undecided(self) -> int:
        """Bytes that must have come to decide whether a frame begins, at most."""
        if self.confirmed:
            return _LENGTHS_COMPARED * self.longest + len(self.sync)
        return max(self.longest, self.known_from)

    def compiled(self, arrays: structs.Arrays) -> structs.Framing:
        compiled = structs.Framing(form=PACKET_FORM, body_start=self.body_start)
        if self.identifier is not None:
            compiled.identifier = compile_field(self.identifier)
        if self.checksum is not None:
            compiled.checksum = compile_checksum(self.checksum, arrays)
        compiled.shortest, compiled.longest, compiled.behind = self.shortest, self.longest, self.behind
        compiled.n_sync, compiled.sync = compile_pattern(self.sync, arrays)
        compiled.n_trailer, compiled.trailer = compile_pattern(self.trailer, arrays)
        if isinstance(self.length, Length):
            compiled.length, compiled.more = compile_field(self.length.field), self.length.more
            if self.bare_when_empty and self.checksum is not None:
                compiled.bare = self.checksum.size
        elif isinstance(self.length, LengthTable):
            compiled.length = compile_field(Field(self.length.offset))
            known = [self.length.total.get(value, 0) for value in range(BYTE_VALUES)]
            compiled.totals = arrays.of([one.more if isinstance(one, Length) else one for one in known], np.int64)
            of_each = [compile_field(one.field) if isinstance(one, Length) else structs.WireField() for one in known]
            compiled.lengths = arrays.structs(structs.WireField, of_each)[1]
        compiled.known_from, compiled.look_ahead = self.known_from, self.look_ahead
        compiled.confirms_each = self.confirmed == "each"
        compiled.checksum_at = self.checksum_place(0)
        compiled.covered_from, compiled.covered_to = self.covered(0)
        return compiled

    def _check_places(self) -> None:
        """Refuse a frame of which a byte that is looked at may lie outside."""
        least = least_checked = self.shortest
        ends = [self.body_start, len(self.sync), len(self.trailer)]
        if isinstance(self.length, Length):
            ends.append(self.length.field.offset)
            if self.bare_when_empty:
                least_checked = max(least, 1 + self.length.more)
        elif isinstance(self.length, LengthTable):
            ends.append(self.length.offset)
            if any(isinstance(one, Length) and one.field.end > self.longest for one in self.length.total.values()):
                raise ConfigurationError("a length lies beyond the longest frame")
        if self.identifier is not None:
            ends.append(self.identifier.end)
        if self.checksum is not None:
            ends += [self.checksum_at or 0, (self.checksum_at or 0) + self.checksum.size]
            begin, end = self.covered(least_checked)
            ends.append(0 if 0 <= begin <= end <= least_checked else -1)
        if min(ends) < 0 or max(ends) > least or self.behind > least_checked:
            raise ConfigurationError(f"a part of the frame lies outside its shortest form of {least} bytes")

    def encode(self, identifier: int, payload: bytes) -> bytes:
        """Return a frame as it is sent; bytes of the header that the declaration leaves open are zero.

        Identifier and length are written at their places, also over the payload.
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


def _first(pattern: Pattern) -> bytes:
    return bytes(values_of(what)[0] for what in pattern)
