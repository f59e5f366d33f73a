"""Find the fields of a message in its bytes (CDR) by its definition, and read numbers without making objects.

Definitions are texts as in ``.msg`` files, by type without ``msg``: ``{"std_msgs/Int8": "int8 data"}``. Plain CDR of
versions 1 and 2 is read, in both byte orders.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from skinware.errors import ConfigurationError

ENCAPSULATION = 4
_PLAIN_CDR = {b"\0\0": (">", 8), b"\0\1": ("<", 8), b"\0\6": (">", 4), b"\0\7": ("<", 4)}
"""Byte order and greatest alignment, by encapsulation."""
_CODES = {
    "bool": "u1",
    "byte": "u1",
    "char": "u1",
    "float32": "f4",
    "float64": "f8",
    **{f"{sign}int{8 * size}": f"{sign or 'i'}{size}" for sign in ("", "u") for size in (1, 2, 4, 8)},
}
_TEXT = "string"
_FIELD = re.compile(r"([\w/]+)(<=\d+)?(\[(?:<=)?(\d*)\])?\s+([A-Za-z]\w*)(?:\s+[^=\s].*)?")
_CONSTANT = re.compile(r"[\w/]+(?:<=\d+)?\s+\w+\s*=.*")
_EMPTY = "uint8 structure_needs_at_least_one_member"
_MOST_FIELDS, _DEEPEST = 20_000, 16

Indices = tuple[int, ...]
"""The elements of sequences within which a field is."""


class CdrField(NamedTuple):
    """A field of a definition.

    Attributes:
        kind: code of numpy without byte order, ``string``, or another type.
        length: elements of an array; 0: a sequence; None: one value.
    """

    name: str
    kind: str
    length: int | None


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


class Definitions:
    """Definitions of a type and all that are in it.

    Args:
        type_name: with or without ``msg``.
        texts: by type without ``msg``; names in them may leave out the package.

    Attributes:
        texts: of the types that are used, complete and with nothing but fields.

    Raises:
        ConfigurationError: a definition is missing or is none.
    """

    def __init__(self, type_name: str, texts: Mapping[str, str]) -> None:
        self.type_name = type_name = type_name.replace("/msg/", "/")
        self.texts: dict[str, str] = {}
        self._fields: dict[str, Sequence[CdrField]] = {}
        self._add(type_name, texts, ())

    def __getitem__(self, type_name: str) -> Sequence[CdrField]:
        return self._fields[type_name]

    def _add(self, type_name: str, texts: Mapping[str, str], outer: tuple[str, ...]) -> None:
        if type_name in outer or len(outer) > _DEEPEST:
            raise ConfigurationError(f"type {type_name} is within itself")
        if type_name in self._fields:
            return
        if type_name not in texts:
            raise ConfigurationError(f"the definition of type {type_name} is missing")
        fields, lines = [], []
        for line in map(str.strip, re.sub(r"#.*", "", texts[type_name]).splitlines()):
            if not line or _CONSTANT.fullmatch(line):
                continue
            match = _FIELD.fullmatch(line)
            if match is None:
                raise ConfigurationError(f"definition of {type_name}: {line!r} is no field")
            plain, bound, brackets, length, name = match.groups()
            kind = plain if plain in _CODES or plain == _TEXT else _qualified(plain, type_name)
            if "/" in kind:
                self._add(kind, texts, (*outer, type_name))
            lines.append(f"{kind}{bound or ''}{brackets or ''} {name}")
            fields.append(CdrField(name, _CODES.get(kind, kind), _length(brackets, length)))
        if not fields:  # as ROS does
            fields, lines = [CdrField("structure_needs_at_least_one_member", "u1", None)], [_EMPTY]
        self._fields[type_name], self.texts[type_name] = fields, "\n".join([*lines, ""])


def _qualified(plain: str, type_name: str) -> str:
    if plain == "Header":
        return "std_msgs/Header"
    return plain.replace("/msg/", "/") if "/" in plain else f"{type_name.rpartition('/')[0]}/{plain}"


def _length(brackets: str | None, length: str) -> int | None:
    if brackets is None:
        return None
    return 0 if "<=" in brackets or not length else int(length)


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
        self.fix(found)
        return int(found.of(self.sample)[0])

    def fix(self, found: Numbers) -> None:
        """Note that the places of other fields depend on these bytes."""
        self._fixed.append((found.start, found.start + found.length * np.dtype(found.dtype).itemsize))

    @property
    def fixed(self) -> npt.NDArray[np.int64]:
        """(n,) int64, the bytes that are the same in all samples whose fields are at the same places."""
        return np.concatenate([np.arange(*one) for one in self._fixed])

    def _struct(self, type_name: str, path: str, within: Indices) -> None:
        for field in self._definitions[type_name]:
            name = f"{path}.{field.name}" if path else field.name
            is_number = "/" not in field.kind and field.kind != _TEXT
            if field.length is not None and not is_number and self._alignment < 8:
                self._take(4, 4, name)  # version 2 writes a size before such elements
            count = field.length or (1 if field.length is None else self._size(name))
            if is_number:
                size = int(field.kind[1:])
                start = self._take(min(size, self._alignment) if count else 1, size * count, name)
                self.numbers.setdefault(name, {})[within] = Numbers(start, count, self._order + field.kind)
                continue
            if field.length is not None:
                self.counts.setdefault(name, {})[within] = count
            for element in range(count):
                inner = within if field.length is None else (*within, element)
                if field.kind == _TEXT:
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
