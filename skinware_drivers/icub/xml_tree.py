"""Read XML with line numbers, read values, and keep remarks on everything that is left out."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal
from xml.parsers import expat

import msgspec

from skinware.errors import ConfigurationError
from skinware.text import printable

LARGEST_FILE = 4 << 20
_DEEPEST = 40
_LONGEST, _LONGEST_NUMBER = 400, 12

Level = Literal["todo", "odd", "unknown", "missing", "info"]
"""``todo``: the user must fill in or decide; ``odd``: understood, but probably a mistake; ``unknown``: not understood;
``missing``: named, but does not exist; ``info``: nothing to do."""


class Note(msgspec.Struct, frozen=True, order=True):
    """A remark; lines count from 1, and 0 is the whole file."""

    level: Level
    file: str
    line: int
    element: str
    text: str

    def __str__(self) -> str:
        place = f"{self.file}:{self.line}" if self.line else self.file
        return f"{place}: {self.element}: {self.text}" if self.element else f"{place}: {self.text}"


def shown(text: object) -> str:
    """Return a text of a foreign file for a terminal or a comment: without control characters, not too long."""
    visible = printable(str(text))
    return visible if len(visible) <= _LONGEST else f"{visible[:_LONGEST]} ..."


@dataclass
class Element:
    """An element; ``tag`` has its prefix, and ``understood`` says that a reader has used it."""

    tag: str
    attributes: dict[str, str]
    file: Path
    line: int
    children: list[Element] = field(default_factory=list)
    text: str = ""
    understood: bool = False

    @property
    def name(self) -> str:
        return self.attributes.get("name", "")

    @property
    def label(self) -> str:
        return f'{self.tag} "{self.name}"' if self.name else self.tag

    def walk(self) -> Iterator[Element]:
        yield self
        for child in self.children:
            yield from child.walk()


class Notes:
    """Remarks, and values of elements: those that cannot be read are noted, and count as not given."""

    def __init__(self) -> None:
        self._notes: dict[Note, None] = {}

    def add(self, level: Level, file: Path | str, text: str, *, line: int = 0, element: str = "") -> None:
        self._notes[Note(level, shown(file), line, shown(element), shown(text))] = None

    def at(self, element: Element, level: Level, text: str) -> None:
        self.add(level, element.file, text, line=element.line, element=element.label)

    def take(self, other: Notes) -> None:
        self._notes.update(other._notes)

    def all(self) -> list[Note]:
        return list(self._notes)

    def numbers(self, element: Element | None) -> list[int] | None:
        """Return all words of an element as numbers; None if there is no element, or a word is not a number."""
        if element is None:
            return None
        element.understood = True
        try:
            return [number(word) for word in words(element.text)]
        except ValueError as error:
            self.refuse(element, str(error))
            return None

    def number(self, element: Element | None, first: int, last: int) -> int | None:
        found = self.numbers(element)
        if element is None or found is None:
            return None
        if len(found) != 1:
            self.refuse(element, f"{element.text!r} is not one number")
        elif not first <= found[0] <= last:
            self.refuse(element, f"{found[0]} is outside {first}-{last}")
        else:
            return found[0]
        return None

    def truth(self, element: Element | None) -> bool | None:
        """Return a truth as YARP reads it: the first word is ``true`` or a number other than 0; else False."""
        if element is None:
            return None
        element.understood = True
        found = words(element.text)
        try:
            value = found[:1] == ["true"] or bool(number("".join(found[:1])))
            clear = len(found) == 1
        except ValueError:
            value, clear = False, found == ["false"]
        if not clear:
            text = f"{element.text!r} is neither true nor false; taken to be {str(value).lower()}, as on the robot"
            self.at(element, "odd", text)
        return value

    def refuse(self, element: Element, why: str) -> None:
        self.at(element, "unknown", f"{why}; left out")


def words(text: str) -> list[str]:
    return text.translate(str.maketrans('()"', "   ")).split()


def number(text: str) -> int:
    if len(text) > _LONGEST_NUMBER or not text.isascii() or "_" in text:
        raise ValueError(f"{text[:20]!r} is not a whole number")
    try:
        value = int(text, 16) if text.lower().startswith("0x") else int(text, 10)
    except ValueError:
        raise ValueError(f"{text!r} is not a whole number") from None
    return value


def read_bytes(path: Path) -> bytes:
    """Read an ordinary file that is not too large."""
    try:
        if not path.is_file():
            raise ConfigurationError(f"{path}: not there, or not an ordinary file")
        with path.open("rb") as file:
            data = file.read(LARGEST_FILE + 1)
    except OSError as error:
        raise ConfigurationError(f"{path}: {error.strerror}") from None
    except ValueError as error:  # a NUL in the path
        raise ConfigurationError(f"{str(path)!r}: {error}") from None
    if len(data) > LARGEST_FILE:
        raise ConfigurationError(f"{path}: larger than {LARGEST_FILE >> 20} MiB, too large for a robot's configuration")
    return data


def read_xml(path: Path, notes: Notes) -> Element:
    return _TreeBuilder(path, notes).read(_without_odd_comments(read_bytes(path), path, notes))


def _without_odd_comments(data: bytes, path: Path, notes: Notes) -> bytes:
    """Blank the comments that XML forbids (they hold ``--``) but the robots' reader takes."""
    parts, position = [], 0
    while (start := data.find(b"<!--", position)) >= 0:
        end = data.find(b"-->", start + 4)
        if end < 0:
            break
        body = data[start + 4 : end]
        if b"--" in body or body.endswith(b"-"):
            line = data.count(b"\n", 0, start) + 1
            notes.add(
                "info",
                path,
                "'--' in a comment is not XML; the comment ends at the first '-->', as on the robot",
                line=line,
            )
            parts += [data[position:start], b"\n" * body.count(b"\n")]
        else:
            parts.append(data[position : end + 3])
        position = end + 3
    return b"".join([*parts, data[position:]])


class _TreeBuilder:
    def __init__(self, path: Path, notes: Notes) -> None:
        self._path, self._notes = path, notes
        self._open: list[Element] = []
        self._root: Element | None = None
        self._text: list[list[str]] = []
        # no namespaces: real files use the prefix xi without declaring it
        self._parser = parser = expat.ParserCreate()
        parser.buffer_text = True
        parser.StartElementHandler = self._start
        parser.EndElementHandler = self._end
        parser.CharacterDataHandler = self._characters
        parser.EntityDeclHandler = self._entity
        parser.SkippedEntityHandler = self._skipped
        parser.SetParamEntityParsing(expat.XML_PARAM_ENTITY_PARSING_NEVER)

    def read(self, data: bytes) -> Element:
        try:
            self._parser.Parse(data, True)
        except expat.ExpatError as error:
            why = expat.errors.messages.get(error.code, str(error))
            raise self._refusal(f"not XML: {why}", error.lineno) from None
        except (LookupError, ValueError) as error:  # an unknown encoding
            if isinstance(error, ConfigurationError):
                raise
            raise self._refusal(f"not XML: {error}") from None
        if self._root is None:
            raise self._refusal("not XML: no element")
        return self._root

    def _refusal(self, why: str, line: int = 0) -> ConfigurationError:
        return ConfigurationError(f"{self._path}{f':{line}' if line else ''}: {why}")

    @property
    def _line(self) -> int:
        return self._parser.CurrentLineNumber

    def _start(self, tag: str, attributes: dict[str, str]) -> None:
        if len(self._open) >= _DEEPEST:
            raise self._refusal(f"elements nested deeper than {_DEEPEST}", self._line)
        element = Element(tag, attributes, self._path, self._line)
        if self._open:
            self._open[-1].children.append(element)
        else:
            self._root = element
        self._open.append(element)
        self._text.append([])

    def _end(self, _tag: str) -> None:
        self._open.pop().text = "".join(self._text.pop()).strip()

    def _characters(self, text: str) -> None:
        if self._text:
            self._text[-1].append(text)

    def _entity(self, name: str, *_: object) -> None:
        raise self._refusal(f"defines the entity {name!r}: write out what it stands for", self._line)

    def _skipped(self, name: str, _is_parameter: bool) -> None:
        self._notes.add("unknown", self._path, "an undefined entity", line=self._line, element=f"&{name};")
