"""Lists of values as YARP's commands and answers are, in text and in binary: words, texts, whole numbers, lists.

Source: robotology/yarp, tags v3.8.1 and v4.0.0 (``Bottle.h``, ``PortCommand``), and exchanges with ports of both. In
binary, numbers are little-endian i32: the tag of a list is 256, with the type of all its values added if it is one
type, which the values then do not repeat; the number of values follows. A value is its type and its bytes; a word of at
most four letters (``[list]``) is such a value itself.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Sequence

_INT32, _TEXT, _WORD, _LIST = 1, 4, 9, 256
_LETTERS = 4
_DEEPEST = 4
_IN_TEXT = re.compile(r'"([^"]*)"|\(([^()]*)\)|(\S+)')
_PLAIN = re.compile(r"[A-Za-z/_][^\s\"()\[\]]*")


class Word(str):
    """A word of at most four letters, which YARP writes in square brackets."""

    __slots__ = ()


Value = int | str | Sequence["Value"]


def in_text(values: Sequence[Value]) -> str:
    return " ".join(map(_value_in_text, values))


def _value_in_text(value: Value) -> str:
    if isinstance(value, Word):
        return f"[{value}]"
    if isinstance(value, str):
        return value if _PLAIN.fullmatch(value) else '"' + value.replace('"', "'") + '"'
    return str(value) if isinstance(value, int) else f"({in_text(value)})"


def of_text(line: str) -> list[str]:
    """The words of a flat list in text, which may stand in quotes or, as commands do, in square brackets."""
    words = ["".join(found) for found in _IN_TEXT.findall(line)]
    return [word[1:-1] if word.startswith("[") and word.endswith("]") else word for word in words]


def packed(values: Sequence[Value]) -> bytes:
    return struct.pack("<ii", _LIST, len(values)) + b"".join(map(_packed_value, values))


def _packed_value(value: Value) -> bytes:
    if isinstance(value, Word):
        return struct.pack("<i4s", _WORD, value.encode())
    if isinstance(value, str):
        data = value.encode()
        return struct.pack("<ii", _TEXT, len(data)) + data
    return struct.pack("<ii", _INT32, value) if isinstance(value, int) else packed(value)


def unpacked(data: bytes) -> list[Value]:
    """The values of a list in binary.

    Raises:
        ValueError: the bytes are none, or the list has values of other types.
    """
    try:
        (tag,) = struct.unpack_from("<i", data)
        values, end = _unpacked_list(data, 4, tag, _DEEPEST)
    except struct.error as error:
        raise ValueError(f"a list of YARP that is cut off: {error}") from None
    if end != len(data):
        raise ValueError(f"{len(data) - end} bytes follow a list of YARP")
    return values


def _unpacked_list(data: bytes, at: int, tag: int, deepest: int) -> tuple[list[Value], int]:
    if not deepest or tag & ~0xFF != _LIST:
        raise ValueError(f"no list of YARP: tag {tag}")
    (count,) = struct.unpack_from("<i", data, at)
    at += 4
    if not 0 <= count <= len(data):
        raise ValueError(f"a list of YARP of {count} values")
    values: list[Value] = []
    for _ in range(count):
        kind = tag - _LIST
        if not kind:
            (kind,) = struct.unpack_from("<i", data, at)
            at += 4
        value, at = _unpacked_value(data, at, kind, deepest)
        values.append(value)
    return values, at


def _unpacked_value(data: bytes, at: int, kind: int, deepest: int) -> tuple[Value, int]:
    if kind == _INT32:
        return struct.unpack_from("<i", data, at)[0], at + 4
    if kind == _WORD:
        (letters,) = struct.unpack_from("<4s", data, at)
        return Word(letters.rstrip(b"\0").decode("utf-8", "replace")), at + _LETTERS
    if kind == _TEXT:
        (size,) = struct.unpack_from("<i", data, at)
        end = at + 4 + size
        if size < 0 or end > len(data):
            raise ValueError(f"a text of {size} bytes in a list of YARP")
        return data[at + 4 : end].decode("utf-8", "replace"), end
    return _unpacked_list(data, at, kind, deepest - 1)
