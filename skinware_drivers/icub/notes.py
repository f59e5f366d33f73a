"""What an import has to say of the files it read: nothing is dropped without a word."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import msgspec

from skinware._printable import printable

Level = Literal["todo", "odd", "unknown", "missing", "info"]
"""``todo``: the user must fill in or decide; ``odd``: understood, but hardly what its author wanted; ``unknown``: not
understood; ``missing``: named, but not there; ``info``: nothing to do."""


class Note(msgspec.Struct, frozen=True, order=True):
    """One remark.

    Attributes:
        level: what kind.
        file: where it is about.
        line: counted from 1; 0: the file as a whole.
        element: what is meant there.
        text: the remark.
    """

    level: Level
    file: str
    line: int
    element: str
    text: str

    def __str__(self) -> str:
        place = f"{self.file}:{self.line}" if self.line else self.file
        return f"{place}: {self.element}: {self.text}" if self.element else f"{place}: {self.text}"


_LONGEST = 400


def shown(text: object) -> str:
    """A text from a foreign file as a terminal or a comment can show it: without control characters, not too long."""
    visible = printable(str(text))
    return visible if len(visible) <= _LONGEST else f"{visible[:_LONGEST]} ..."


class Notes:
    """Remarks in the order in which they came, each once."""

    def __init__(self) -> None:
        self._notes: dict[Note, None] = {}

    def add(self, level: Level, file: Path | str, text: str, *, line: int = 0, element: str = "") -> None:
        self._notes[Note(level, shown(file), line, shown(element), shown(text))] = None

    def take(self, other: Notes) -> None:
        self._notes.update(other._notes)

    def all(self) -> list[Note]:
        return list(self._notes)
