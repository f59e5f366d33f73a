"""When a frame is of a kind, and which bits name its patch and module."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from skinware_drivers.bus import EXTENDED_FLAG, IDENTIFIER_MASK, LARGEST_STANDARD


@dataclass(frozen=True)
class Identifier:
    """Condition: ``identifier & mask == value``. Whether the identifier has 11 or 29 bits counts whatever the mask.

    Attributes:
        value: what the masked bits are; of a 29-bit identifier, with the flag: ``EXTENDED_FLAG | 0x18DA00F1``.
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
        """What all these identifiers of 11 bits have in common, and as few others as one condition can have."""
        differ = 0
        for identifier in identifiers:
            differ |= identifier ^ identifiers[0]
        mask = LARGEST_STANDARD & ~((1 << differ.bit_length()) - 1)
        return cls(identifiers[0] & mask, mask)


@dataclass(frozen=True)
class Byte:
    """Condition: ``payload[offset] & mask == value``; a frame that is too short does not match."""

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
        byte: None: of the identifier; a number: of that payload byte (only as a module's key, at most 8 bits).
    """

    shift: int
    width: int
    byte: int | None = None
