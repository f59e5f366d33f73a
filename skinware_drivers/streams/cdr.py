"""Find the fields of a message in its bytes (CDR) by its definition, and read numbers without making objects.

Plain CDR of versions 1 and 2 is read, in both byte orders.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from skinware.ros_types import NUMBERS, TEXT, Definitions

ENCAPSULATION = 4
_PLAIN_CDR = {b"\0\0": (">", 8), b"\0\1": ("<", 8), b"\0\6": (">", 4), b"\0\7": ("<", 4)}
"""Byte order and greatest alignment, by encapsulation."""
_CODES = {name: np.dtype(name).str[1:] for name in NUMBERS} | {"bool": "u1"}
_MOST_FIELDS = 20_000

Indices = tuple[int, ...]
"""The elements of sequences within which a field is."""


class Numbers(NamedTuple):
    """Numbers of a field, side by side in a sample.

    Attributes:
        start: first byte.
        dtype: with byte order.
    """

    start: int
    length: int
    dtype: str

    @property
    def places(self) -> npt.NDArray[np.int64]:
        """(length,) int64, first byte of each."""
        return self.start + np.dtype(self.dtype).itemsize * np.arange(self.length)

    def of(self, sample: bytes) -> npt.NDArray[Any]:
        return np.frombuffer(sample, self.dtype, self.length, self.start)


class CdrMessage:
    """A sample whose fields were found.

    Attributes:
        sample: with its encapsulation.
        numbers: of each field, by its name (``sensors.values``) and the elements of sequences that it is within.
        texts: of each field of texts, in the same way.
        counts: elements of each sequence of other types, in the same way.

    Raises:
        ValueError: the bytes are no such message; the message says why.
    """

    def __init__(self, sample: bytes, definitions: Definitions) -> None:
        self.sample = sample
        self.numbers: dict[str, dict[Indices, Numbers]] = {}
        self.texts: dict[str, dict[Indices, str]] = {}
        self.counts: dict[str, dict[Indices, int]] = {}
        if sample[:2] not in _PLAIN_CDR:
            raise ValueError(f"an encapsulation {sample[:2].hex() or 'of no bytes'} that is no plain CDR")
        self._order, self._alignment = _PLAIN_CDR[sample[:2]]
        self._definitions = definitions
        self._at, self._left = ENCAPSULATION, _MOST_FIELDS
        self._fixed: list[tuple[int, int]] = [(0, 2)]
        self._struct(definitions.type_name, "", ())
        if len(sample) - self._at > ENCAPSULATION:
            raise ValueError(f"{len(sample) - self._at} bytes more than {definitions.type_name} has")

    def number(self, name: str, within: Indices = ()) -> int:
        """Return a whole number on which the places of others depend."""
        found = self.numbers[name][within]
        self._fixed.append((found.start, found.start + found.length * np.dtype(found.dtype).itemsize))
        return int(found.of(self.sample)[0])

    @property
    def fixed(self) -> npt.NDArray[np.int64]:
        """(n,) int64, the bytes that are the same in all samples whose fields are at the same places."""
        return np.concatenate([np.arange(*one) for one in self._fixed])

    def _struct(self, type_name: str, path: str, within: Indices) -> None:
        for field in self._definitions[type_name]:
            name = f"{path}.{field.name}" if path else field.name
            code = _CODES.get(field.kind)
            if field.length is not None and not code and self._alignment < 8:
                self._take(4, 4, name)  # version 2 writes a size before such elements
            count = field.length or (1 if field.length is None else self._size(name))
            if code:
                size = int(code[1:])
                start = self._take(min(size, self._alignment) if count else 1, size * count, name)
                self.numbers.setdefault(name, {})[within] = Numbers(start, count, self._order + code)
                continue
            if field.length is not None:
                self.counts.setdefault(name, {})[within] = count
            for element in range(count):
                inner = within if field.length is None else (*within, element)
                if field.kind == TEXT:
                    self._text(name, inner)
                else:
                    self._struct(field.kind, name, inner)

    def _text(self, name: str, within: Indices) -> None:
        size = self._size(name)
        start = self._take(1, size, name)
        self._fixed.append((start, self._at))
        text = self.sample[start : self._at].rstrip(b"\0").decode(errors="replace")
        self.texts.setdefault(name, {})[within] = text

    def _size(self, name: str) -> int:
        start = self._take(4, 4, name)
        self._fixed.append((start, self._at))
        return int.from_bytes(self.sample[start : self._at], "little" if self._order == "<" else "big")

    def _take(self, alignment: int, size: int, name: str) -> int:
        """Return the first of some bytes of a field, and go on behind them."""
        self._left -= 1
        start = self._at + (ENCAPSULATION - self._at) % alignment
        if start + size > len(self.sample) or self._left < 0:
            raise ValueError(f"{len(self.sample)} bytes that {'end' if self._left >= 0 else 'are too many'} in {name}")
        self._at = start + size
        return start


def gathered(sample: bytes, places: Iterable[npt.NDArray[np.int64]], dtypes: Iterable[str]) -> list[npt.NDArray[Any]]:
    """Return (n,) numbers that begin at (n,) places, for each of some columns."""
    data = np.frombuffer(sample, np.uint8)
    return [
        data[at[:, None] + np.arange(np.dtype(dtype).itemsize)].view(dtype)[:, 0]
        for at, dtype in zip(places, dtypes, strict=True)
    ]
