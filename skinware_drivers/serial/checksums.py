"""Checksums of frames: exclusive or, sums and cyclic redundancy checks.

The parameters of a CRC are those of the usual catalogues (width, polynomial, initial value, reflected input and
output, final exclusive or) and can be checked with its value for ``b"123456789"``.
"""

from __future__ import annotations

import binascii
import zlib
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

from skinware.errors import ConfigurationError

Order = Literal["little", "big"]


@dataclass(frozen=True, kw_only=True)
class Checksum(ABC):
    """A checksum that frames carry.

    Attributes:
        order: byte order in which it is sent, ``little`` (its lowest byte first) or ``big``; one byte has none.
    """

    width: int
    order: Order = "little"

    @property
    def size(self) -> int:
        """Bytes that it takes in a frame."""
        return -(-self.width // 8)

    @abstractmethod
    def of(self, data: bytes) -> int:
        """Return the checksum of data."""

    def to_bytes(self, data: bytes) -> bytes:
        """Return the checksum of data as it is sent."""
        return self.of(data).to_bytes(self.size, self.order)


@dataclass(frozen=True, kw_only=True)
class Xor(Checksum):
    """Exclusive or of all bytes, one byte.

    Attributes:
        init: initial value.
    """

    width: int = field(default=8, init=False)
    init: int = 0

    def of(self, data: bytes) -> int:
        value = self.init
        for byte in data:
            value ^= byte
        return value


@dataclass(frozen=True, kw_only=True)
class Sum(Checksum):
    """Sum of all bytes, modulo the width.

    Attributes:
        width: in bits: 8, 16 or 32.
        order: ``little`` (default): its lowest byte is sent first; or ``big``.
        init: initial value.
        negative: the sum is sent with its sign changed (two's complement), so that a whole frame adds up to 0.
    """

    width: Literal[8, 16, 32] = 8
    init: int = 0
    negative: bool = False

    def of(self, data: bytes) -> int:
        value = self.init + sum(data)
        return (-value if self.negative else value) & ((1 << self.width) - 1)


@dataclass(frozen=True, kw_only=True)
class Crc(Checksum):
    """A cyclic redundancy check.

    Attributes:
        width: 8 to 32 bits.
        order: ``little`` (default): its lowest byte is sent first; or ``big``, as most catalogues write it.
        polynomial: without its highest bit.
        init: initial value.
        reflected_in: the lowest bit of each byte comes first.
        reflected_out: the result's bits are reversed.
        xor_out: final exclusive or.
        plain_table: with ``reflected_in``, the table of the polynomial that is not reflected (Weiss Robotics).

    Raises:
        ConfigurationError: another width.
    """

    polynomial: int
    init: int = 0
    reflected_in: bool = False
    reflected_out: bool = False
    xor_out: int = 0
    plain_table: bool = False

    def __post_init__(self) -> None:
        if not 8 <= self.width <= 32:
            raise ConfigurationError(f"a CRC of {self.width} bits: 8 to 32 can be had")

    def of(self, data: bytes) -> int:
        if self.native is not None:
            return self.native(data)
        state, table = self.first_state, self.table
        if self.reflected_in:
            for byte in data:
                state = table[(state ^ byte) & 0xFF] ^ state >> 8
        else:
            shift, mask = self.width - 8, (1 << self.width) - 1
            for byte in data:
                state = (state << 8 & mask) ^ table[(state >> shift ^ byte) & 0xFF]
        if self.reflected_in != self.reflected_out:
            state = _reversed(state, self.width)
        return state ^ self.xor_out

    @cached_property
    def native(self) -> Callable[[bytes | memoryview], int] | None:
        """The function of the standard library for these parameters, if there is one."""
        if self == replace(CRC32, order=self.order):
            return zlib.crc32
        if self.width == 16 and self.polynomial == 0x1021 and not (self.reflected_in or self.reflected_out):
            init, xor_out = self.init, self.xor_out
            return lambda data: binascii.crc_hqx(data, init) ^ xor_out
        return None

    @property
    def first_state(self) -> int:
        """The register before the first byte; with reflected input it is reversed."""
        return _reversed(self.init, self.width) if self.reflected_in else self.init

    @cached_property
    def table(self) -> list[int]:
        """The change of the register by each value of a byte."""
        reflected, top, mask = self.reflected_in and not self.plain_table, 1 << self.width - 1, (1 << self.width) - 1
        polynomial = _reversed(self.polynomial, self.width) if reflected else self.polynomial
        table = []
        for byte in range(256):
            state = byte if reflected else byte << self.width - 8
            for _ in range(8):
                if reflected:
                    state = state >> 1 ^ (polynomial if state & 1 else 0)
                else:
                    state = (state << 1 ^ (polynomial if state & top else 0)) & mask
            table.append(state)
        return table


def _reversed(value: int, width: int) -> int:
    return int(f"{value:0{width}b}"[::-1], 2)


XOR = Xor()
"""Exclusive or of all bytes."""
SUM8 = Sum()
"""Sum of all bytes modulo 256."""
LRC = Sum(negative=True)
"""Minus the sum of all bytes modulo 256."""
CRC8 = Crc(width=8, polynomial=0x07)
"""CRC-8/SMBUS."""
CRC16_XMODEM = Crc(width=16, polynomial=0x1021)
"""CRC-16/XMODEM."""
CRC16_CCITT_FALSE = Crc(width=16, polynomial=0x1021, init=0xFFFF)
"""CRC-16/IBM-3740, often called CCITT-FALSE."""
CRC16_MODBUS = Crc(width=16, polynomial=0x8005, init=0xFFFF, reflected_in=True, reflected_out=True)
"""CRC-16/MODBUS."""
CRC16_X25 = Crc(width=16, polynomial=0x1021, init=0xFFFF, reflected_in=True, reflected_out=True, xor_out=0xFFFF)
"""CRC-16/IBM-SDLC, of X.25, HDLC and PPP."""
CRC32 = Crc(width=32, polynomial=0x04C11DB7, init=0xFFFFFFFF, reflected_in=True, reflected_out=True, xor_out=0xFFFFFFFF)
"""CRC-32/ISO-HDLC, of Ethernet and zlib."""
CRC32C = Crc(
    width=32, polynomial=0x1EDC6F41, init=0xFFFFFFFF, reflected_in=True, reflected_out=True, xor_out=0xFFFFFFFF
)
"""CRC-32/ISCSI, Castagnoli's."""
CRC16_WEISS = Crc(width=16, polynomial=0x1021, init=0xFFFF, reflected_in=True, reflected_out=True, plain_table=True)
"""CRC of Weiss Robotics' WTS and Schunk's DSACON32, which is in no catalogue. ``b"123456789"`` gives 0x6EB4."""
