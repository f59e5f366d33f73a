"""Matrices of numbers as lines of text, with an empty line behind each matrix."""

from __future__ import annotations

import re
from dataclasses import dataclass, field

from skinware_drivers.serial.framing import Framed, Framer, Framing, check_body

_ROW = re.compile(rb"[0-9]{1,3}(?: +[0-9]{1,3})* *\r?")
_EMPTY = (b"", b"\r")
_LONGEST_NUMBER = 4  # with the space behind it
_LONGEST_END = 2


@dataclass(frozen=True)
class TextMatrix(Framing):
    """A line for each row, with decimal numbers from 0 to 255, and an empty line behind the last row.

    The body of a frame has two bytes that tell how many rows and columns there are, and then the numbers, row by row.
    Matrices whose rows are of different lengths are skipped. So is what comes before the first empty line: it may be
    the end of a matrix.

    Attributes:
        rows: at most, and at most 255.
        columns: likewise.
        identifier: of all frames that are found.
    """

    rows: int
    columns: int
    identifier: int = 0
    maximum_body: int = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "maximum_body", 2 + self.rows * self.columns)

    @property
    def longest(self) -> int:
        """Bytes of the longest matrix, without the empty line."""
        return self.rows * (self.columns * _LONGEST_NUMBER + _LONGEST_END)

    def framer(self) -> Framer:
        """Something to feed a stream to."""
        return _TextMatrixFramer(self)

    def encode(self, identifier: int, payload: bytes) -> bytes:
        """The lines of a matrix.

        Raises:
            ValueError: there is no such frame.
        """
        check_body(identifier - self.identifier, payload, None, 3, self.maximum_body)
        rows, columns, *numbers = payload
        if len(numbers) != rows * columns or not self.is_possible(rows, columns):
            raise ValueError(f"a payload that says {rows} x {columns} and has {len(numbers)} numbers")
        lines = (numbers[row * columns :][:columns] for row in range(rows))
        return b"".join(b" ".join(b"%d" % number for number in line) + b"\n" for line in lines) + b"\n"

    def is_possible(self, rows: int, columns: int) -> bool:
        """Whether there can be so many."""
        return 0 < rows <= self.rows and 0 < columns <= self.columns


class _TextMatrixFramer(Framer):
    def __init__(self, framing: TextMatrix) -> None:
        super().__init__()
        self._framing = framing
        self._longest = framing.longest
        self._discarding = True  # everything up to the next empty line

    def _find(self, stream: bytes) -> tuple[list[Framed], int]:
        found: list[Framed] = []
        begin = line = 0
        while (end := stream.find(b"\n", line)) >= 0:
            if stream[line:end] in _EMPTY:
                self._take(stream[begin:line], end + 1 - begin, self._before + end + 1, found)
                begin = end + 1
            line = end + 1
        if not self._discarding and len(stream) - begin > self._longest + _LONGEST_END:
            self._discarding = True
            self.counters.refused += 1
        if self._discarding:
            kept = max(line, len(stream) - 2)  # tells an empty line from the end of another
            self.counters.skipped_bytes += kept - begin
            begin = kept
        return found, begin

    def _take(self, text: bytes, size: int, end: int, found: list[Framed]) -> None:
        """Judge what came before an empty line: so many bytes with it."""
        if self._discarding:
            self._discarding = False
        elif not text:
            self.counters.idle_bytes += size
            return
        elif (body := self._body(text)) is not None:
            self.counters.frame_bytes += size
            found.append(Framed(self._framing.identifier, body, end))
            return
        else:
            self.counters.refused += 1
        self.counters.skipped_bytes += size

    def _body(self, text: bytes) -> bytes | None:
        """Rows, columns and numbers of a matrix; None if it is none."""
        lines = text.split(b"\n")[:-1] if len(text) <= self._longest else []
        if not all(_ROW.fullmatch(line) for line in lines):
            return None
        numbers = [[int(number) for number in line.split()] for line in lines]
        columns = {len(row) for row in numbers}
        if len(columns) != 1 or not self._framing.is_possible(len(numbers), *columns):
            return None
        if max(map(max, numbers)) > 0xFF:
            return None
        return bytes((len(numbers), *columns, *(number for row in numbers for number in row)))
