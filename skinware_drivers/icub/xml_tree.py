"""XML as robots have it: elements with line numbers, read without trust.

Documents may refer to a DTD by its address, as real ones do; it is not fetched. Documents that define entities are
refused, as nobody here needs them and they can make a small file huge. Comments are read as the robots' own reader
does, which lets them end at the first ``-->``, whatever they hold before.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from xml.parsers import expat

from skinware.errors import ConfigurationError
from skinware_drivers.icub.notes import Notes

LARGEST_FILE = 4 << 20
_DEEPEST = 40


@dataclass
class Element:
    """An element.

    Attributes:
        tag: with its prefix, if it has one.
        attributes: by name.
        file: where it was read.
        line: counted from 1.
        children: in order.
        text: all text directly within, without what is around it.
        understood: somebody took it into account.
    """

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
        """For messages: ``param "period"``."""
        return f'{self.tag} "{self.name}"' if self.name else self.tag

    def walk(self) -> Iterator[Element]:
        yield self
        for child in self.children:
            yield from child.walk()

    def understand(self) -> None:
        for element in self.walk():
            element.understood = True


def read_bytes(path: Path, limit: int = LARGEST_FILE) -> bytes:
    """A whole file, if it is an ordinary one and not too large.

    Raises:
        ConfigurationError: it is not.
    """
    try:
        if not path.is_file():
            raise ConfigurationError(f"{path}: not there, or not an ordinary file")
        with path.open("rb") as file:
            data = file.read(limit + 1)
    except OSError as error:
        raise ConfigurationError(f"{path}: {error.strerror}") from None
    except ValueError as error:  # a NUL in the path
        raise ConfigurationError(f"{str(path)!r}: {error}") from None
    if len(data) > limit:
        raise ConfigurationError(f"{path}: larger than {limit >> 20} MiB, too large for a robot's configuration")
    return data


def read_xml(path: Path, notes: Notes) -> Element:
    """The root element of a file.

    Raises:
        ConfigurationError: not there, not XML, or it defines entities; the message says where.
    """
    return _Reader(path, notes).read(_without_odd_comments(read_bytes(path), path, notes))


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


class _Reader:
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
        except (LookupError, ValueError) as error:  # an encoding that nobody has
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
