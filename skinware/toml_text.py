"""Read TOML files, and find the line of a value for messages: the parser does not keep it."""

from __future__ import annotations

import re
import tomllib
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import GenericAlias
from typing import Any, TypeVar

import msgspec
import msgspec.inspect

from skinware.errors import ConfigurationError

T = TypeVar("T", bound=msgspec.Struct)
_MOST_BYTES = 16_000_000
Keys = tuple[str | int, ...]
"""Where a value is: ``("bus", 1, "name")``."""

_KEY = r"""[\w-]+|"[^"]*"|'[^']*'"""
_KEYS = rf"(?:{_KEY})(?:\s*\.\s*(?:{_KEY}))*"
_HEADER = re.compile(rf"\s*(\[\[?)\s*({_KEYS})\s*\]")
_PAIR = re.compile(rf"\s*({_KEYS})\s*=")
_KEYS_IN_ERROR = re.compile(r"\.(\w+)|\[(\d+)\]")
_WHERE = re.compile(r" \(at (?:line (\d+), column \d+|end of document)\)$")


class TomlText:
    """A TOML file as it is now, or none; refuse what cannot be read, or is not TOML."""

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self._text = ""
        try:
            if path is not None:
                self._text = _text_of(path)
            self.data: dict[str, Any] = tomllib.loads(self._text)
        except OSError as error:
            raise ConfigurationError(f"{path}: {error.strerror}") from None
        except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
            where = _WHERE.search(str(error))
            line = f":{where[1] or len(self._text.splitlines())}" if where else ""
            raise ConfigurationError(f"{path}{line}: not TOML: {_WHERE.sub('', str(error))}") from None

    def place(self, keys: Sequence[str | int]) -> str:
        return f"{self._path}:{line_of(self._text, keys)}"

    def of_format(self, what: str, format_name: str, version: int, struct: type[T]) -> T:
        """Return the contents of a file of one of our formats, which begin with ``format`` and ``version``.

        Args:
            what: such a file is called, for messages.
            format_name: that it must have.

        Raises:
            ConfigurationError: another format or version, or a value that does not fit; the message says where.
        """
        if self.data.get("format") != format_name:
            raise ConfigurationError(f'{self.place(("format",))}: no {what}: it does not say format = "{format_name}"')
        found = self.data.get("version")
        if found != version:
            raise ConfigurationError(
                f"{self.place(('version',))}: version {found}, this Skinware reads version {version}"
            )
        try:
            return msgspec.convert(self.data, struct)
        except msgspec.ValidationError as error:
            text, keys = wrong_value(error, struct)
            raise ConfigurationError(f"{self.place(keys)}: {text}") from None

    def entries(self, what: str, format_name: str, version: int, key: str, kind: Any) -> tuple[Any, ...]:
        """Return all ``[[key]]`` of a file that has nothing else, each as ``kind``; otherwise as :meth:`of_format`."""
        head = [("format", str), ("version", int)]
        struct = msgspec.defstruct(
            "_File", [*head, (key, GenericAlias(tuple, (kind, ...)), ())], forbid_unknown_fields=True
        )
        found: tuple[Any, ...] = getattr(self.of_format(what, format_name, version, struct), key)
        return found


def _text_of(path: Path) -> str:
    """Return the text of a file, or of a pipe; refuse what does not end."""
    with path.open("rb") as file:
        found = file.read(_MOST_BYTES + 1)
    if len(found) > _MOST_BYTES:
        raise ConfigurationError(f"{path}: it has more than {_MOST_BYTES} bytes: is this the right file?")
    return found.decode("utf-8")


def wrong_value(error: msgspec.ValidationError, struct: type[msgspec.Struct]) -> tuple[str, Keys]:
    """Return what is wrong in data for a struct, with the choices where there are some, and the place of the value."""
    text = str(error).replace("`", "")
    found = _KEYS_IN_ERROR.findall(text.rpartition("$")[2])
    keys = tuple(int(number) if number else key for key, number in found)
    choices = _choices(msgspec.inspect.type_info(struct), keys) if text.startswith("Invalid enum value") else []
    return (f"{text}; there are {', '.join(choices)}" if choices else text), keys


def _choices(kind: msgspec.inspect.Type, keys: Keys) -> list[str]:
    """Return the texts that may stand at a place in a value of such a type."""
    match kind:
        case msgspec.inspect.Metadata():
            return _choices(kind.type, keys)
        case msgspec.inspect.UnionType():
            return [choice for one in kind.types for choice in _choices(one, keys)]
        case msgspec.inspect.LiteralType() if not keys:
            return [repr(value) for value in kind.values if value]
        case msgspec.inspect.StructType() if keys:
            return [
                found
                for field in kind.fields
                if field.encode_name == keys[0]
                for found in _choices(field.type, keys[1:])
            ]
        case msgspec.inspect.VarTupleType() | msgspec.inspect.ListType() if keys:
            return _choices(kind.item_type, keys[1:])
        case msgspec.inspect.DictType() if keys:
            return _choices(kind.value_type, keys[1:])
    return []


def line_of(text: str, keys: Sequence[str | int]) -> int:
    """Return the number of the line of a value, or of the table or value that has it in itself; 1 if there is none."""
    found, depth = 1, 0
    for number, path in _paths(text):
        if len(path) > depth and path == tuple(keys[: len(path)]):
            found, depth = number, len(path)
    return found


def _paths(text: str) -> Iterator[tuple[int, Keys]]:
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
    """Return the newest element of an array of tables; a table as it is."""
    return (*path, elements[path] - 1) if elements[path] else path


def _split(keys: str) -> list[str]:
    return [key.strip("\"'") for key in re.findall(_KEY, keys)]
