"""In which line of a TOML file something stands, which its parser does not tell: for messages to people."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Sequence

Keys = tuple[str | int, ...]
"""Where a value is: ``("bus", 1, "name")``."""

_KEY = r"""[\w-]+|"[^"]*"|'[^']*'"""
_KEYS = rf"(?:{_KEY})(?:\s*\.\s*(?:{_KEY}))*"
_HEADER = re.compile(rf"\s*(\[\[?)\s*({_KEYS})\s*\]")
_PAIR = re.compile(rf"\s*({_KEYS})\s*=")


def line_of(text: str, keys: Sequence[str | int]) -> int:
    """The number of the line of a value, or of the table or value that has it in itself; 1 if there is none.

    Args:
        text: of the file.
        keys: where the value is.
    """
    found, depth = 1, 0
    for number, path in _paths(text):
        if len(path) > depth and path == tuple(keys[: len(path)]):
            found, depth = number, len(path)
    return found


def _paths(text: str) -> Iterator[tuple[int, Keys]]:
    """Every line that begins a table or a value, with its keys."""
    elements: Counter[Keys] = Counter()  # of arrays of tables
    table: Keys = ()
    for number, line in enumerate(text.splitlines(), 1):
        if header := _HEADER.match(line):
            *outer, last = _split(header[2])
            table = ()
            for key in outer:
                table = _element((*table, key), elements)
            table = (*table, last)
            if header[1] == "[[":
                elements[table] += 1
                table = _element(table, elements)
            yield number, table
        elif pair := _PAIR.match(line):
            yield number, (*table, *_split(pair[1]))


def _element(path: Keys, elements: Counter[Keys]) -> Keys:
    """The newest element of an array of tables; a table as it is."""
    return (*path, elements[path] - 1) if elements[path] else path


def _split(keys: str) -> list[str]:
    return [key.strip("\"'") for key in re.findall(_KEY, keys)]
