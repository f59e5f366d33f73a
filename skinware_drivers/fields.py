"""Fields of frames: conditions that recognize kinds, keys of patches and modules, numbers that devices count, flags."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import numpy as np

from skinware.status import Status
from skinware_drivers.bus import EXTENDED_FLAG, IDENTIFIER_MASK, LARGEST_STANDARD, Filter

_MOST_BITS = 32  # of a sequence number


@dataclass(frozen=True)
class Identifier:
    """The condition ``identifier & mask == value``; whether the identifier has 11 or 29 bits always counts.

    Attributes:
        value: the masked bits; of a 29-bit identifier with the flag: ``EXTENDED_FLAG | 0x18DA00F1``.
        mask: bits that count; default: all.
        extended: whether the identifier has 29 bits, as the flag in the value says.
    """

    value: int
    mask: int = -1
    extended: bool = field(init=False)

    def __post_init__(self) -> None:
        is_extended = bool(self.value & EXTENDED_FLAG)
        object.__setattr__(self, "extended", is_extended)
        every = EXTENDED_FLAG | IDENTIFIER_MASK if is_extended else LARGEST_STANDARD
        mask = every if self.mask == -1 else self.mask | (EXTENDED_FLAG if is_extended else 0)
        object.__setattr__(self, "mask", mask)

    @classmethod
    def covering(cls, identifiers: Sequence[int]) -> Identifier:
        """Return a condition that all these identifiers of 11 bits fulfil, and as few others as possible."""
        differ = 0
        for identifier in identifiers:
            differ |= identifier ^ identifiers[0]
        mask = LARGEST_STANDARD & ~((1 << differ.bit_length()) - 1)
        return cls(identifiers[0] & mask, mask)


@dataclass(frozen=True)
class Byte:
    """The condition ``payload[offset] & mask == value``; a frame that is too short does not fulfil it."""

    offset: int
    value: int
    mask: int = 0xFF


Condition = Identifier | Byte


@dataclass(frozen=True)
class Bits:
    """A bit field that names a patch or a module.

    Attributes:
        shift: position of the lowest bit.
        width: number of bits, 1 to 29.
        byte: number of the payload byte that has the field (only for the key of a module, at most 8 bits); None: the
            identifier has it.
    """

    shift: int
    width: int
    byte: int | None = None


@dataclass(frozen=True)
class SequenceNumber:
    """A number in the payload that the device counts up, with a module's frames or with its cycles.

    Skipped and repeated numbers are counted. A frame that one of the next 64 has overtaken is not shown, if the number
    has more than 128 values. In a :class:`Cycle` the number also says which frames belong together.

    Attributes:
        offset: first byte of its word.
        dtype: unsigned numpy dtype of that word, with byte order.
        modulo: the number wraps to 0 here, at most 2**32; default: the range of its bits.
        mask: the adjacent bits of the word that form the number (``0xF0``: the upper half of a byte); default: all.
    """

    offset: int
    dtype: str
    modulo: int | None = None
    mask: int | None = None

    @property
    def end(self) -> int:
        """One past the last byte of its word."""
        return self.offset + np.dtype(self.dtype).itemsize

    @property
    def bits(self) -> int:
        """The mask, also where it is the whole word."""
        return (1 << 8 * np.dtype(self.dtype).itemsize) - 1 if self.mask is None else self.mask

    @property
    def shift(self) -> int:
        """Position of its lowest bit."""
        return (self.bits & -self.bits).bit_length() - 1

    @property
    def turn(self) -> int:
        """Counts until it is 0 again."""
        return self.modulo or (self.bits >> self.shift) + 1

    def wrong(self, shortest: int) -> str:
        """Return why a payload of so many bytes cannot have the number; empty if it can."""
        if np.dtype(self.dtype).kind != "u":
            return f"the sequence number's dtype {self.dtype!r} is not unsigned"
        if self.end > shortest:
            return "the sequence number is not in every right payload"
        plain = self.bits >> self.shift if self.bits > 0 else 0
        if not plain or plain & (plain + 1) or self.bits >> 8 * np.dtype(self.dtype).itemsize:
            return f"mask {self.bits:#x} of the sequence number: give bits of a {self.dtype!r} that lie side by side"
        if not 2 <= self.turn <= plain + 1:
            return f"modulo {self.modulo} of the sequence number: its bits do not fit"
        if self.turn > 1 << _MOST_BITS:
            return f"the sequence number counts to more than {_MOST_BITS} bits: give its lowest as `mask`"
        return ""


@dataclass(frozen=True)
class DeviceTime:
    """The time in a payload at which the device took the values, by its own clock.

    The frame then has this time, converted to CLOCK_MONOTONIC, instead of the time of receipt. A patch has one clock.

    Attributes:
        offset: first byte.
        dtype: unsigned numpy dtype with byte order, at most 4 bytes.
        unit_s: seconds per count.
        modulo: the time wraps to 0 here; default: the dtype's own range.
    """

    offset: int
    dtype: str
    unit_s: float
    modulo: int | None = None

    @property
    def end(self) -> int:
        """One past its last byte."""
        return self.offset + np.dtype(self.dtype).itemsize

    @property
    def turn(self) -> int:
        """Counts until it is 0 again."""
        return self.modulo or 1 << 8 * np.dtype(self.dtype).itemsize


@dataclass(frozen=True)
class Packed:
    """A value of any number of bits, packed without gaps.

    Attributes:
        bits: bits of a value, 1 to 32.
        order: ``big``: the first value begins at the highest bit of the first byte; ``little``: at its lowest.
        signed: two's complement.
        skip: bits of the first byte that come before the first value, 0 to 7.
    """

    bits: int
    order: Literal["big", "little"] = "big"
    signed: bool = False
    skip: int = 0


@dataclass(frozen=True)
class Flag:
    """Bits of a payload that set a status bit.

    The word of ``dtype`` at ``offset`` is read; a frame that ends before it sets no flag.

    Attributes:
        status: the bit to set.
        offset: first byte of the word.
        dtype: unsigned numpy dtype with byte order (``">u2"``).
        mask: any of these bits set the status of the whole module. 0: none does.
        each: (channel, bit of the word) pairs: the bit sets the status of this channel only.
        normal: the word that sets no flag: bits count as set where they differ from it.
        each_module: (key, bit of the word) pairs, for a frame that has the status of all modules of its patch: the bit
            sets the status of the module of this key from its next update on, until a later frame clears it, or the
            patch restarts.
    """

    status: Status
    offset: int
    dtype: str
    mask: int = 0
    each: Sequence[tuple[int, int]] = ()
    normal: int = 0
    each_module: Sequence[tuple[int, int]] = ()


@dataclass(frozen=True)
class Sentinel:
    """A value that means "no value": each value equal to it (or NaN, if it is NaN) sets a status bit of its sensor."""

    status: Status
    value: float


@dataclass(frozen=True)
class Above:
    """A limit that no true value exceeds: each value greater than it sets a status bit of its sensor."""

    status: Status
    limit: float


@dataclass(frozen=True)
class StatusBytes:
    """A byte of status bits for each value, in the order of the values; a frame that ends before them sets none.

    Attributes:
        offset: first byte.
        mask: bits of each that are status bits.
    """

    offset: int
    mask: Status


NO_NUMBER: Sequence[Sentinel] = tuple(Sentinel(Status.SUSPECT, value) for value in (np.nan, np.inf, -np.inf))
"""Values of floating point that are no numbers."""

AnyFlag = Flag | Sentinel | Above | StatusBytes


class Reply(NamedTuple):
    """A frame that answered."""

    time_ns: int
    identifier: int
    payload: bytes


class Match(NamedTuple):
    """The frames that are an answer: ``identifier & mask == value``, and a payload that begins with ``prefix``.

    Whether the identifier has 11 or 29 bits (``EXTENDED_FLAG`` in ``value``) always counts. If questions of other
    programs begin like the answers, ``shortest`` excludes them: the least number of bytes of an answer.
    """

    value: int
    mask: int = IDENTIFIER_MASK
    prefix: bytes = b""
    shortest: int = 0

    @property
    def filter(self) -> Filter:
        """The filter that lets all frames with fitting identifiers through."""
        return Filter(self.value, self.mask | EXTENDED_FLAG)

    def fits(self, frame: Reply) -> bool:
        """Return whether a frame is such an answer."""
        value, mask = self.filter
        is_from_there = frame.identifier & mask == value
        return is_from_there and frame.payload.startswith(self.prefix) and len(frame.payload) >= self.shortest
