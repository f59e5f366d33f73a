"""Plan the reads for the registers that a driver declares, and keep their newest content.

A driver declares *blocks*: each becomes one frame of its layout. Blocks that are near each other are asked for
together, long ones in several reads. A frame is whole when all registers of its block have come.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from numbers import Integral
from typing import Literal

import numpy as np
import numpy.typing as npt

from skinware.errors import ConfigurationError
from skinware_drivers.fields import AnyFlag, Packed, Reply
from skinware_drivers.layout import Values
from skinware_drivers.modbus.wire import MOST_REGISTERS, READ_HOLDING, READS, question_to_read

Order = Literal["big", "little"]
_LAST_ADDRESS = 0xFFFF


@dataclass(frozen=True)
class Registers:
    """A block of registers with values of one module.

    Attributes:
        address: of the first register; as in the protocol, addresses begin with 0.
        count: number of registers.
        unit: address of the device on its line.
        function: of the read, 3 or 4.
        dtype: of the values: ``u2``, ``i2``, ``u4``, ``i4`` or ``f4``.
        to: channel of the module for each value, None = dropped; default: 0, 1, 2 ...
        patch: key of the patch, if a bus has several.
        module: key of the module, if the patch has several.
        every: read it in each cycle (1), in every second one (2) ...
        flags: conditions that set status bits in this block, besides the ``flags`` of the adapter.
        values: places of the values in the bytes of the block, unless it holds values of one ``dtype`` one after the
            other; ``dtype`` and ``to`` are not used then. Blocks may overlap.
    """

    address: int
    count: int
    unit: int = 1
    function: int = READ_HOLDING
    dtype: str = "u2"
    to: Sequence[int | None] | None = None
    patch: int | None = None
    module: int | None = None
    every: int = 1
    flags: Sequence[AnyFlag] = ()
    values: Sequence[Values] = ()

    @property
    def words(self) -> int:
        """Registers of a value."""
        return np.dtype(self.dtype).itemsize // 2

    @property
    def runs(self) -> Sequence[Values]:
        """Places of the values in the bytes of the block."""
        return self.values or (Values(0, f">{self.dtype}", self.count // self.words, self.to),)

    @property
    def name(self) -> str:
        return f"registers {self.address} of unit {self.unit}"

    def check(self, step: int = 1) -> None:
        """Check the declaration.

        Args:
            step: from the address of one register to the next.

        Raises:
            ConfigurationError: a field makes no sense; the message says which.
        """
        name = self.name
        for what in ("address", "count", "unit", "function", "every"):
            if not isinstance(getattr(self, what), Integral):
                raise ConfigurationError(f"{name}: {what} = {getattr(self, what)!r} is no whole number")
        if self.dtype not in ("u2", "i2", "u4", "i4", "f4"):
            raise ConfigurationError(f"{name}: dtype {self.dtype!r}: give u2, i2, u4, i4 or f4")
        if self.function not in READS:
            raise ConfigurationError(f"{name}: function {self.function}: registers are read with 3 or 4")
        if not 0 <= self.unit <= 255:
            raise ConfigurationError(f"{name}: units have numbers from 1 to 247, over TCP from 0 to 255")
        if self.count < 1 or self.count % self.words:
            each = f", {self.words} for each {self.dtype}" if self.words > 1 else ""
            raise ConfigurationError(f"{name}: count = {self.count}: how many registers are there{each}?")
        if self.every < 1:
            raise ConfigurationError(f"{name}: every = {self.every}: 1 is in each cycle, 2 in every second one")
        last = self.address + step * (self.count - 1)
        if self.address < 0 or last > _LAST_ADDRESS:
            raise ConfigurationError(
                f"{name}: the last of {self.count} is {last}, and addresses go from 0 to {_LAST_ADDRESS}; a manual's"
                " 40001, or 400001, is 0"
            )


@dataclass(frozen=True)
class Read:
    """One question of a cycle; ``first``: its first register in that area."""

    unit: int
    function: int
    address: int
    count: int
    every: int
    area: int
    first: int

    @property
    def question(self) -> bytes:
        return question_to_read(self.function, self.address, self.count)


@dataclass(frozen=True)
class Wanted:
    """The registers that a driver wants, and how they can be read.

    Attributes:
        step: from the address of one register to the next: 2 where addresses count bytes.
        largest_gap: unwanted registers that are read along at most, to save a question.
        most: registers of a read.
        byte_order: of the bytes of a register.
        word_order: of the registers of a value that has several.
    """

    blocks: Sequence[Registers]
    step: int = 1
    largest_gap: int = 16
    most: int = MOST_REGISTERS
    byte_order: Order = "big"
    word_order: Order = "big"

    def reads(self) -> list[Read]:
        """Return the questions of a cycle: as few as possible, in order of address."""
        return [
            Read(
                area.unit,
                area.function,
                area.address + self.step * first,
                min(self.most, area.count - first),
                area.every,
                number,
                first,
            )
            for number, area in enumerate(self.areas())
            for first in range(0, area.count, self.most)
        ]

    def areas(self) -> list[Registers]:
        """Return the ranges that are read without a gap, as blocks without values."""
        found: list[Registers] = []
        for block in sorted(self.blocks, key=lambda b: (b.unit, b.function, b.every, b.address)):
            last = found[-1] if found else None
            if last is not None and _key(last) == _key(block):
                place = (block.address - last.address) // self.step
                if (block.address - last.address) % self.step == 0 and place <= last.count + self.largest_gap:
                    count = max(last.count, place + block.count)
                    found[-1] = Registers(last.address, count, block.unit, block.function, every=block.every)
                    continue
            found.append(Registers(block.address, block.count, block.unit, block.function, every=block.every))
        return found


def _key(block: Registers) -> tuple[int, int, int]:
    return block.unit, block.function, block.every


class Area:
    """Registers without a gap between them: their bytes as they came, and when.

    ``blocks`` has the identifier, first register and declaration of each block in it.
    """

    def __init__(self, where: Registers) -> None:
        self.where: Registers = where
        self.registers: npt.NDArray[np.uint8] = np.zeros((where.count, 2), np.uint8)
        self.heard_ns: npt.NDArray[np.int64] = np.zeros(where.count, np.int64)
        self.blocks: list[tuple[int, int, Registers]] = []


class Image:
    """The newest content of all wanted registers.

    Args:
        wanted: the blocks; the identifier of a frame is the number of its block.

    Attributes:
        told_ns: (n_blocks,) int64, when the frame of each was last whole.
        is_plain: a frame has the bytes of its registers as they come.
    """

    def __init__(self, wanted: Wanted) -> None:
        self._wanted = wanted
        self.is_plain = (wanted.byte_order, wanted.word_order) == ("big", "big")
        self.areas: list[Area] = [Area(area) for area in wanted.areas()]
        self.told_ns: npt.NDArray[np.int64] = np.zeros(len(wanted.blocks), np.int64)
        for number, block in enumerate(wanted.blocks):
            for area in self.areas:
                first, odd = divmod(block.address - area.where.address, wanted.step)
                is_in = not odd and 0 <= first <= area.where.count - block.count
                if is_in and _key(area.where) == _key(block):
                    area.blocks.append((number, first, block))
                    break

    def put(self, area: int, first: int, data: bytes, time_ns: int, since_ns: int) -> list[Reply]:
        """Store registers of an area that were read; return the frames that are whole now.

        Registers that came before ``since_ns`` do not count.
        """
        place = self.areas[area]
        end = first + len(data) // 2
        place.registers[first:end] = np.frombuffer(data, np.uint8).reshape(-1, 2)
        place.heard_ns[first:end] = time_ns
        rows = []
        for number, begin, block in place.blocks:
            if begin + block.count <= first or begin >= end:
                continue
            oldest_ns = int(place.heard_ns[begin : begin + block.count].min())
            if oldest_ns > self.told_ns[number] and oldest_ns >= since_ns:
                self.told_ns[number] = time_ns
                rows.append(Reply(oldest_ns, number, self._bytes(place.registers[begin : begin + block.count], block)))
        return rows

    def overhear(self, unit: int, question: bytes, data: bytes, time_ns: int, since_ns: int) -> list[Reply]:
        """Store the wanted ones of the registers that another master has read; see :meth:`put`."""
        address, count = int.from_bytes(question[1:3], "big"), int.from_bytes(question[3:5], "big")
        rows: list[Reply] = []
        for number, area in enumerate(self.areas):
            where, step = area.where, self._wanted.step
            if (where.unit, where.function) != (unit, question[0]) or (address - where.address) % step:
                continue
            place = (address - where.address) // step
            begin, end = max(0, -place), min(count, where.count - place)
            if begin < end:
                rows += self.put(number, place + begin, data[2 * begin : 2 * end], time_ns, since_ns)
        return rows

    def _bytes(self, registers: npt.NDArray[np.uint8], block: Registers) -> bytes:
        """Return the bytes in the order of the layout: the most significant byte first."""
        if self._wanted.byte_order == "little":
            registers = registers[:, ::-1]
        data = registers.tobytes()
        if self._wanted.word_order == "little":
            for run in block.runs:
                words = 1 if isinstance(run.dtype, Packed) else np.dtype(run.dtype).itemsize // 2
                if words > 1:
                    turned = np.frombuffer(data[run.offset : run.end], ">u2").reshape(-1, words)[:, ::-1].tobytes()
                    data = data[: run.offset] + turned + data[run.end :]
        return data
