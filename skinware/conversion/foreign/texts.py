"""Read texts of numbers: CSV with any separator, and the ``data.log`` of YARP's datadumper."""

from __future__ import annotations

import contextlib
import csv
import re
from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import numpy.typing as npt

from skinware.conversion.foreign.source import DUMP, ColumnSource, Rows
from skinware.errors import ConfigurationError
from skinware.realtime import NS_PER_S

_READ_BYTES = 1 << 20
_SAMPLE_LINES = 200
_SHOWN = 40
"""Characters of a cell in a message."""
_SEPARATORS = ("\t", ";", ",")
_MISSING = ("", "-", "nan", "null", "none", "na", "n/a", "#n/a", "<na>")
_EXACT = 1 << 53
"""From this number on, a float does not hold every integer."""
_DATE = re.compile(r"(\d{4}-\d\d-\d\d[T ]\d\d:\d\d:\d\d)([.,]\d+)?(Z|[+-]\d\d:?\d\d)?")
_DUMPED = re.compile(r"\d+ \d+(\.\d+)?( |$)")
_BRACKETS = str.maketrans("()", "  ")
_COMMAS = str.maketrans(",.", ".,")
"""Decimal commas become points; a point then makes no number."""
_BY_COMMA, _BY_POINT = (re.compile(rf"[-+]?\d*{mark}\d+(e[-+]?\d+)?", re.I) for mark in (",", r"\."))
_TWO_NUMBERS = re.compile(r"[-+]?\d+\s+[-+]?\d+")
"""Parts of two numbers with decimal commas, between which there are only spaces."""
_IN_THOUSANDS = re.compile(r"[-+]?[1-9]\d{0,2}(,\d{3})+")


class TextSource(ColumnSource):
    """A text with a row of numbers in each line; an empty cell is NaN.

    Names of columns are in its first lines; without them they are ``column_0``, ``column_1`` ... Separators are tabs,
    semicolons (between both, numbers may have decimal commas), commas, or any white space.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        with path.open("rb") as file:
            lines = self._lines_of([file.readline(_READ_BYTES) for _ in range(_SAMPLE_LINES)], 0)
        self._is_dump = path.name == DUMP and any(map(_DUMPED.match, lines[:5]))
        self._skipped = _heading(lines)
        data = [line for line in lines[self._skipped :] if line.strip()]
        if not data:
            raise ConfigurationError(f"{path}: no line with numbers in it: is it a text, as CSV is?")
        separators = (each for each in _SEPARATORS if each in data[0])
        self._separator = None if self._is_dump else next(separators, None)
        self._letters = self._letters_of(data)
        self._count = count = len(self._cells(self._clean(data[0])))
        self._places = self._dumped(count) if self._is_dump else self._named(lines[: self._skipped], count)
        rows = [cells for line in data if len(cells := self._cells(self._clean(line))) == count]
        samples = {name: [cells[places[0]] for cells in rows] for name, places in self._places.items()}
        self.times = {name for name, cells in samples.items() if all(_DATE.fullmatch(cell.strip()) for cell in cells)}
        self._exact = {
            name
            for name, cells in samples.items()
            if any(cell.strip().isdecimal() and float(cell) >= _EXACT for cell in cells)
        }
        wrong = {name: [cell for cell in cells if _number(cell) is None] for name, cells in samples.items()}
        self.left_out = {
            name: f"{self._shown(cells[0])} is no number"
            for name, cells in wrong.items()
            if name not in self.times and len(cells) > len(rows) / 2
        }
        shapes = {
            name: (len(places),) if self._is_dump and name == "value" else () for name, places in self._places.items()
        }
        self.tables = {"": {name: shape for name, shape in shapes.items() if name not in self.left_out}}

    def blocks(self, table: str, names: Collection[str]) -> Iterator[Rows]:
        size, at, number = max(self.path.stat().st_size, 1), 0, 1
        with self.path.open("rb") as file:
            for _ in range(self._skipped):
                at, number = at + len(file.readline()), number + 1
            while read := file.readlines(_READ_BYTES):
                lines = list(map(self._clean, self._lines_of(read, at)))
                at += sum(map(len, read))
                self.share = at / size
                rows = self._rows(lines, number, names)
                yield {name: each.reshape(-1, *self.tables[table].get(name, ())) for name, each in rows}
                number += len(read)

    # -- the form of the text -------------------------------------------------------------------------------------

    def _named(self, head: Sequence[str], count: int) -> dict[str, list[int]]:
        lines = [line.lstrip("# ") for line in reversed(head) if line.strip()]
        named = [cells for line in lines if len(cells := self._cells(line)) == count]
        if lines and not named:
            self._damaged(self._skipped + 1, f"{count} cells under {len(self._cells(lines[0]))} names")
        above = named[:1] if self._separator is None else reversed(named)  # a line of units, or of groups
        names = [" ".join(filter(None, map(str.strip, cells))) for cells in zip(*above, strict=True)] or [""] * count
        names = [name or f"column_{number}" for number, name in enumerate(names)]
        for name, often in Counter(names).items():
            if often > 1:
                self._damaged(self._skipped, f"{often} columns are called {name!r}")
        return {name: [number] for number, name in enumerate(names)}

    def _dumped(self, count: int) -> dict[str, list[int]]:
        info = self.path.with_name("info.log")
        has_both = info.exists() and "tx+rx" in info.read_text(errors="replace")
        names = ["sequence", "time", *(["received_time"] * has_both)]
        places = {name: [number] for number, name in enumerate(names)}
        return places | ({"value": list(range(len(names), count))} if count > len(names) else {})

    def _clean(self, line: str) -> str:
        return line.translate(self._letters) if self._letters else line

    def _letters_of(self, lines: Sequence[str]) -> dict[int, int]:
        """Return the letters to exchange in each line, so that numbers have points."""
        if self._is_dump:
            return _BRACKETS
        if self._separator is None:
            return {}
        cells = [cell.strip() for line in lines for cell in self._cells(line)]
        if self._separator == ",":
            two = next(filter(_TWO_NUMBERS.fullmatch, cells), None)
            if two is not None:
                raise ConfigurationError(
                    f"{self.path}: {two!r} between commas: export it with points and commas, or tabs"
                )
            return {}
        commas = [cell for cell in cells if _BY_COMMA.fullmatch(cell)]
        points = [cell for cell in cells if _BY_POINT.fullmatch(cell)]
        if commas and points:
            why = f"{points[0]!r} and {commas[0]!r}: is the comma or the point that of decimals?"
        elif commas and all(map(_IN_THOUSANDS.fullmatch, commas)):
            why = f"is {commas[0]!r} a number of thousands?"
        else:
            return _COMMAS if commas else {}
        raise ConfigurationError(f"{self.path}: {why} Export it without marks between thousands")

    def _cells(self, line: str) -> list[str]:
        if self._separator is None:
            return line.split()
        try:
            return next(csv.reader([line], delimiter=self._separator), [])
        except csv.Error:
            raise ConfigurationError(
                f"{self.path}: a cell has more than {csv.field_size_limit()} characters, or ends with a carriage return"
                " alone: save it with line feeds"
            ) from None

    # -- rows -----------------------------------------------------------------------------------------------------

    def _rows(self, lines: list[str], first: int, names: Collection[str]) -> Iterator[tuple[str, npt.NDArray[Any]]]:
        whole = [name for name in names if name in {*self._exact, *self.times}]
        texts = [name for name in names if name in self.left_out]
        floats = [name for name in names if name not in (*whole, *texts)]
        places = [self._places[name] for name in floats]
        numbers = self._numbers(lines, first, [place for each in places for place in each])
        ends = np.cumsum([len(each) for each in places]).tolist()
        for name, each, end in zip(floats, places, ends, strict=True):
            yield name, numbers[:, end - len(each) : end]
        for name in whole:
            yield name, self._whole_numbers(lines, first, name)
        for name in texts:
            (place,) = self._places[name]
            yield name, np.array([cells[place] for _, cells in self._split(lines, first)], str)

    def _numbers(self, lines: list[str], first: int, places: list[int]) -> npt.NDArray[np.float64]:
        if not places:
            return np.zeros((len(lines), 0))
        count, separator = self._count, self._separator
        if separator is None:
            is_even = all(len(line.split()) in (0, count) for line in lines)
        else:
            is_even = all(line.count(separator) == count - 1 or not line.strip() for line in lines)
        if is_even:
            with contextlib.suppress(ValueError):  # an empty cell, or one to complain about, as is one out of range
                found = np.loadtxt(lines, delimiter=separator, comments=None, quotechar='"', usecols=places, ndmin=2)
                if not np.isinf(found).any():
                    return found
        rows = [[self._float(cells[place], line) for place in places] for line, cells in self._split(lines, first)]
        return np.array(rows, np.float64).reshape(-1, len(places))

    def _whole_numbers(self, lines: list[str], first: int, name: str) -> npt.NDArray[np.int64]:
        (place,) = self._places[name]
        found: list[np.int64] = []
        for line, cells in self._split(lines, first):
            cell = cells[place].strip()
            try:
                if name in self.times:
                    found.append(_date_ns(cell))
                else:
                    found.append(np.int64(int(cell)))
            except (ValueError, OverflowError):
                self._damaged(line, f"{self._shown(cell)} in {name} is neither a date nor an integer of 64 bits")
        return np.array(found, np.int64)

    def _split(self, lines: list[str], first: int) -> Iterator[tuple[int, list[str]]]:
        for number, line in enumerate(lines, first):
            cells = self._cells(line) if line.strip() else []
            if cells and len(cells) != self._count:
                where = f"{self.path}, line {number}: {len(cells)} cells instead of {self._count}: "
                what = "mend or remove the line"
                if self._is_dump:
                    what = (
                        "only ports with equally many numbers in each message can be read, as those of a skin's taxels"
                    )
                raise ConfigurationError(where + what)
            if cells:
                yield number, cells

    def _float(self, cell: str, line: int) -> float:
        number = _number(cell)
        if number is None or (np.isinf(number) and "inf" not in cell.lower()):
            self._damaged(line, f"{self._shown(cell)} is {'no number' if number is None else 'out of range'}")
        return number

    def _lines_of(self, read: Sequence[bytes], at: int) -> list[str]:
        data = b"".join(read)
        if max(map(len, read), default=0) >= _READ_BYTES:
            raise ConfigurationError(f"{self.path}: a line of {_READ_BYTES} bytes or more: not a text of numbers")
        try:
            text = data.decode("utf-8-sig" if not at else "utf-8")
        except UnicodeDecodeError as error:
            raise ConfigurationError(f"{self.path}, byte {at + error.start}: no UTF-8: save it as UTF-8") from None
        if "\0" in text:
            where = at + data.index(b"\0")
            raise ConfigurationError(f"{self.path}, byte {where}: not a text; what reads this file can export CSV")
        return [line.rstrip("\r") for line in text.removesuffix("\n").split("\n")]

    def _shown(self, cell: str) -> str:
        return repr(cell[:_SHOWN].translate(self._letters))

    def _damaged(self, line: int, what: str) -> NoReturn:
        raise ConfigurationError(f"{self.path}, line {line}: {what}: mend or remove the line")


def _heading(lines: Sequence[str]) -> int:
    """Return the number of lines before the first row."""
    first = next((at for at, line in enumerate(lines) if line[:1] != "#" and any(_are_numbers(line))), len(lines))
    if not first and len(lines) > 1:  # numbers may be names: those of cells above which another name is a word
        first = int(any(under and not above for above, under in zip(*map(_are_numbers, lines[:2]), strict=False)))
    return first


def _are_numbers(line: str) -> list[bool]:
    cells = [cell.strip('" ') for cell in re.split(r"[\t,;]| +", line.translate(_BRACKETS).strip(" "))]
    return [bool(_DATE.match(f"{cell} 00:00:00")) or (bool(cell) and _number(cell) is not None) for cell in cells]


def _number(cell: str) -> float | None:
    """Return a number, NaN for an empty cell, None for anything else."""
    try:
        return None if "_" in cell else float(cell)
    except ValueError:
        return np.nan if cell.strip().lower() in _MISSING else None


def _date_ns(cell: str) -> np.int64:
    """Return ns since 1970, or raise ValueError."""
    found = _DATE.fullmatch(cell)
    if not found:
        raise ValueError
    date = np.datetime64(found[1] + (found[2] or "").replace(",", "."), "ns")  # which wraps
    if not str(date).startswith(cell[:4]):
        raise ValueError
    zone = found[3] if found[3] not in (None, "Z") else "+00:00"
    ahead_ns = (int(zone[:3]) * 60 + int(zone[0] + zone[-2:])) * 60 * NS_PER_S
    return np.int64(int(date.astype(np.int64)) - ahead_ns)
