"""Checksums of frames: exclusive or, sums and cyclic redundancy checks, of one frame or of many at once.

A cyclic redundancy check is linear: that of a frame is the exclusive or of what each of its bytes contributes, which
depends on nothing but the byte and its distance from the end. So one table lookup per byte serves all frames of a
buffer at once, and no byte waits for the one before it.

The parameters of a CRC are those of the usual catalogues (width, polynomial, initial value, reflected input and
output, final exclusive or) and can be checked with its value for ``b"123456789"``.
"""

from __future__ import annotations

import binascii
import zlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
import numpy.typing as npt

from skinware.errors import ConfigurationError
from skinware_drivers.serial.gather import Bytes, Indices, by_width, flush_right, windows

Words = npt.NDArray[np.uint32]
Order = Literal["little", "big"]

_BLOCK = 64  # bytes whose contributions are looked up in one table
_LONG = 256  # bytes; from here on a call per frame, where the standard library has one, beats lookups for all


@dataclass(frozen=True, kw_only=True)
class Checksum(ABC):
    """A checksum that frames carry.

    Attributes:
        order: byte order in which it is sent.
    """

    order: Order = "little"

    @property
    @abstractmethod
    def size(self) -> int:
        """Bytes it takes in a frame."""

    @abstractmethod
    def of(self, data: bytes) -> int:
        """Of one piece of data."""

    @abstractmethod
    def of_rows(self, rows: Bytes, length: Indices) -> Words:
        """Of the last ``length`` bytes of each row; those before them are zero."""

    def of_many(self, data: Bytes, start: Indices, stop: Indices) -> Words:
        """(n,) uint32 of the bytes from each start to each stop, of which none is before the start.

        ``data`` begins at least as many bytes before the first piece as the longest piece has.
        """
        length = stop - start
        sums = np.zeros(len(start), np.uint32)
        for group, width in by_width(length):
            sums[group] = self.of_rows(flush_right(data, stop[group], length[group], width), length[group])
        return sums

    def read_many(self, data: Bytes, at: Indices) -> Words:
        """(n,) uint32 as sent, at each position."""
        columns = windows(data, at, self.size).T.astype(np.uint32)
        value: Words = np.zeros(len(at), np.uint32)
        for column in columns if self.order == "big" else columns[::-1]:
            value = value << np.uint32(8) | column
        return value

    def to_bytes(self, data: bytes) -> bytes:
        """As it is sent for some data."""
        return self.of(data).to_bytes(self.size, self.order)


@dataclass(frozen=True, kw_only=True)
class Xor(Checksum):
    """Exclusive or of all bytes, one byte.

    Attributes:
        init: what it begins with.
    """

    init: int = 0

    @property
    def size(self) -> int:
        """One byte."""
        return 1

    def of(self, data: bytes) -> int:
        """Of one piece of data."""
        value = self.init
        for byte in data:
            value ^= byte
        return value

    def of_rows(self, rows: Bytes, length: Indices) -> Words:  # noqa: ARG002
        """Of the last ``length`` bytes of each row."""
        value: Words = np.bitwise_xor.reduce(rows, axis=1, dtype=np.uint8, initial=self.init).astype(np.uint32)
        return value


@dataclass(frozen=True, kw_only=True)
class Sum(Checksum):
    """Sum of all bytes, modulo the width.

    Attributes:
        width: in bits: 8, 16 or 32.
        init: what it begins with.
        negative: the sum is sent with its sign changed (two's complement), so that a whole frame adds up to 0.
    """

    width: Literal[8, 16, 32] = 8
    init: int = 0
    negative: bool = False

    @property
    def size(self) -> int:
        """Bytes it takes in a frame."""
        return self.width // 8

    def of(self, data: bytes) -> int:
        """Of one piece of data."""
        value = self.init + sum(data)
        return (-value if self.negative else value) & ((1 << self.width) - 1)

    def of_rows(self, rows: Bytes, length: Indices) -> Words:  # noqa: ARG002
        """Of the last ``length`` bytes of each row."""
        value = rows.sum(axis=1, dtype=np.int64) + self.init
        sums: Words = ((-value if self.negative else value) & ((1 << self.width) - 1)).astype(np.uint32)
        return sums


@dataclass(frozen=True, kw_only=True)
class Crc(Checksum):
    """A cyclic redundancy check.

    Attributes:
        width: 8 to 32 bits.
        polynomial: without its highest bit.
        init: initial value.
        reflected_in: the lowest bit of each byte comes first.
        reflected_out: the result's bits are reversed.
        xor_out: final exclusive or.

    Raises:
        ConfigurationError: another width.
    """

    width: int
    polynomial: int
    init: int = 0
    reflected_in: bool = False
    reflected_out: bool = False
    xor_out: int = 0

    def __post_init__(self) -> None:
        if not 8 <= self.width <= 32:
            raise ConfigurationError(f"a CRC of {self.width} bits: 8 to 32 can be had")

    @property
    def size(self) -> int:
        """Bytes it takes in a frame."""
        return -(-self.width // 8)

    def of(self, data: bytes) -> int:
        """Of one piece of data."""
        if self.native is not None:
            return self.native(data)
        if len(data) > _LONG:
            row = np.frombuffer(data, np.uint8)[None]
            return int(self.of_rows(row, np.array([len(data)]))[0])
        return self._finish(self._after(data, self._first_state))

    def of_rows(self, rows: Bytes, length: Indices) -> Words:
        """Of the last ``length`` bytes of each row; those before them are zero."""
        state = self._state_after_zeros(int(length.max(initial=0)))[length]
        if rows.size:
            state ^= self._contribution(rows)
        return self._finish_many(state)

    def of_many(self, data: Bytes, start: Indices, stop: Indices) -> Words:
        """(n,) uint32 of the bytes from each start to each stop."""
        native = self.native
        if native is None or int((stop - start).sum()) < _LONG * len(start):
            return super().of_many(data, start, stop)
        view = data.data
        return np.array([native(view[a:b]) for a, b in zip(start.tolist(), stop.tolist(), strict=True)], np.uint32)

    @cached_property
    def native(self) -> Callable[[bytes | memoryview], int] | None:
        """What the standard library has for these parameters, if it has something."""
        if self == CRC32.with_order(self.order):
            return zlib.crc32
        if type(self) is Crc and self.width == 16 and self.polynomial == 0x1021 and not self._reflects:
            init, xor_out = self.init, self.xor_out
            return lambda data: binascii.crc_hqx(data, init) ^ xor_out
        return None

    def with_order(self, order: Order) -> Crc:
        """The same, sent in another byte order."""
        own = {name: getattr(self, name) for name in self.__dataclass_fields__}
        return type(self)(**{**own, "order": order})

    # The register as the update uses it: with reflected input it is reversed.

    @property
    def _reflects(self) -> bool:
        return self.reflected_in or self.reflected_out

    @property
    def _first_state(self) -> int:
        return _reversed(self.init, self.width) if self.reflected_in else self.init

    @cached_property
    def _table(self) -> list[int]:
        return _reflected_table(self) if self.reflected_in else _normal_table(self)

    def _after(self, data: bytes, state: int) -> int:
        """The register after some bytes."""
        table = self._table
        if self.reflected_in:
            for byte in data:
                state = table[(state ^ byte) & 0xFF] ^ state >> 8
            return state
        shift, mask = self.width - 8, (1 << self.width) - 1
        for byte in data:
            state = (state << 8 & mask) ^ table[(state >> shift ^ byte) & 0xFF]
        return state

    def _step(self, state: int, byte: int) -> int:
        return self._after(bytes([byte]), state)

    def _finish(self, state: int) -> int:
        if self.reflected_in != self.reflected_out:
            state = _reversed(state, self.width)
        return state ^ self.xor_out

    def _finish_many(self, state: Words) -> Words:
        if self.reflected_in != self.reflected_out:
            bits = [
                (state >> np.uint32(bit) & np.uint32(1)) << np.uint32(self.width - 1 - bit) for bit in range(self.width)
            ]
            state = np.bitwise_or.reduce(bits)
        return state ^ np.uint32(self.xor_out)

    # Many at once

    def _contribution(self, rows: Bytes) -> Words:
        """What the bytes of each row contribute: blocks first, then pairs of blocks, pairs of pairs ..."""
        n, width = rows.shape
        blocks = 1 << (-(-width // _BLOCK) - 1).bit_length()
        if blocks > 1:
            whole = np.zeros((n, blocks * _BLOCK), np.uint8)
            whole[:, blocks * _BLOCK - width :] = rows
            rows, width = whole.reshape(n * blocks, _BLOCK), _BLOCK
        columns = np.ascontiguousarray(rows.T)  # numpy would keep their order otherwise, which costs four times as much
        columns_at = columns + (np.arange(_BLOCK - width, _BLOCK)[:, None] << 8)
        state: Words = np.bitwise_xor.reduce(self._block_table.take(columns_at), axis=0).astype(np.uint32)
        level = 0
        while len(state) > n:
            state = self._after_blocks(state[0::2], level) ^ state[1::2]
            level += 1
        return state

    @cached_property
    def _block_table(self) -> npt.NDArray[np.uint16] | Words:
        """(block * 256,): contribution of each byte value, by place in a block."""
        table = np.zeros((_BLOCK, 256), np.uint16 if self.width <= 16 else np.uint32)
        basis = [self._step(0, 1 << bit) for bit in range(8)]
        for place in range(_BLOCK - 1, -1, -1):
            table[place] = _spanned(basis)
            basis = [self._step(state, 0) for state in basis]
        return table.ravel()

    def _after_blocks(self, state: Words, level: int) -> Words:
        """What 2**level blocks of zeros make of each register."""
        tables = self._zero_tables
        while len(tables) <= level:  # twice as many zeros: the table applied to itself
            step = tables[-1]
            tables.append([self._look_up(step, table) for table in step])
        return self._look_up(tables[level], state)

    @staticmethod
    def _look_up(tables: list[Words], state: Words) -> Words:
        after: Words = tables[0][state & 0xFF]
        for number, table in enumerate(tables[1:], 1):
            after = after ^ table[state >> np.uint32(8 * number) & 0xFF]
        return after

    @cached_property
    def _zero_tables(self) -> list[list[Words]]:
        """For 1, 2, 4 ... blocks of zeros and each byte of the register: what they make of it."""
        tables = []
        for low in range(0, self.width, 8):
            basis = [1 << bit if bit < self.width else 0 for bit in range(low, low + 8)]
            for _ in range(_BLOCK):
                basis = [self._step(state, 0) for state in basis]
            tables.append(np.array(_spanned(basis), np.uint32))
        return [tables]

    @cached_property
    def _after_zeros(self) -> list[int]:
        return [self._first_state]

    def _state_after_zeros(self, most: int) -> Words:
        """(at least most + 1,): the register after so many bytes of zeros, to which the contributions add."""
        known = self._after_zeros
        while len(known) <= most:
            known.append(self._step(known[-1], 0))
        return np.array(known[: most + 1], np.uint32)


class _WeissCrc(Crc):
    """Updated as if reflected, with the table of the polynomial that is not."""

    @cached_property
    def _table(self) -> list[int]:
        return _normal_table(self)


def _normal_table(crc: Crc) -> list[int]:
    top, mask = 1 << crc.width - 1, (1 << crc.width) - 1
    table = []
    for byte in range(256):
        state = byte << crc.width - 8
        for _ in range(8):
            state = (state << 1 ^ (crc.polynomial if state & top else 0)) & mask
        table.append(state)
    return table


def _reflected_table(crc: Crc) -> list[int]:
    polynomial = _reversed(crc.polynomial, crc.width)
    table = []
    for byte in range(256):
        state = byte
        for _ in range(8):
            state = state >> 1 ^ (polynomial if state & 1 else 0)
        table.append(state)
    return table


def _reversed(value: int, width: int) -> int:
    return int(f"{value:0{width}b}"[::-1], 2)


def _spanned(basis: Sequence[int]) -> list[int]:
    """All 256 sums of eight vectors over the field of two elements."""
    values = [0]
    for vector in basis:
        values += [value ^ vector for value in values]
    return values


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
CRC16_WEISS = _WeissCrc(width=16, polynomial=0x1021, init=0xFFFF, reflected_in=True, reflected_out=True)
"""Of Weiss Robotics' WTS and Schunk's DSACON32: in no catalogue. ``b"123456789"`` gives 0x6EB4."""
