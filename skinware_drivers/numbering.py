"""Numbers in a payload that a device counts up: its frames, its cycles, its time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

_MOST_BITS = 32
"""Of a sequence number."""


@dataclass(frozen=True)
class SequenceNumber:
    """A number in the payload that the device counts up: with a module's frames, or with its cycles.

    Skipped and repeated numbers are counted. In a :class:`Cycle` the number also says which frames belong together.

    Attributes:
        offset: first byte of the word that it is in.
        dtype: unsigned numpy dtype of that word, with byte order.
        modulo: it wraps to 0 here, at most 2**32; default: the range of its bits.
        mask: the bits of the word that it is made of, side by side (``0xF0``: the upper half of a byte); default: all.
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
        """Why no payload of so many bytes can have it; empty if it can."""
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
        modulo: it wraps to 0 here; default: the dtype's own range.
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
