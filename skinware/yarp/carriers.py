"""Encode YARP's lists and vectors, and begin connections of its carriers text, tcp and fast_tcp."""

from __future__ import annotations

import re
import struct
from collections.abc import Sequence
from enum import Enum
from functools import cached_property

import numpy as np
import numpy.typing as npt

_INT32, _TEXT, _WORD, _LIST = 1, 4, 9, 256
_LETTERS = 4
_DEEPEST = 4
_IN_TEXT = re.compile(r'"([^"]*)"|\(([^()]*)\)|(\S+)')
_PLAIN = re.compile(r"[A-Za-z/_][^\s\"()\[\]]*")


class YarpWord(str):
    """A word of at most four letters, which YARP writes in square brackets."""

    __slots__ = ()


Value = int | str | Sequence["Value"]


def in_text(values: Sequence[Value]) -> str:
    texts = []
    for value in values:
        if isinstance(value, YarpWord):
            texts.append(f"[{value}]")
        elif isinstance(value, str):
            texts.append(value if _PLAIN.fullmatch(value) else '"' + value.replace('"', "'") + '"')
        else:
            texts.append(str(value) if isinstance(value, int) else f"({in_text(value)})")
    return " ".join(texts)


def of_text(line: str) -> list[str]:
    """Return the words of a flat list in text; they may be in quotes or, as commands are, in square brackets."""
    words = ["".join(found) for found in _IN_TEXT.findall(line)]
    return [word[1:-1] if word.startswith("[") and word.endswith("]") else word for word in words]


def packed(values: Sequence[Value]) -> bytes:
    parts = [struct.pack("<ii", _LIST, len(values))]
    for value in values:
        if isinstance(value, YarpWord):
            parts.append(struct.pack("<i4s", _WORD, value.encode()))
        elif isinstance(value, str):
            data = value.encode()
            parts.append(struct.pack("<ii", _TEXT, len(data)) + data)
        else:
            parts.append(struct.pack("<ii", _INT32, value) if isinstance(value, int) else packed(value))
    return b"".join(parts)


def unpacked(data: bytes) -> list[Value]:
    """Return the values of a list in binary, or raise ValueError."""
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
        return YarpWord(letters.rstrip(b"\0").decode("utf-8", "replace")), at + _LETTERS
    if kind == _TEXT:
        (size,) = struct.unpack_from("<i", data, at)
        end = at + 4 + size
        if size < 0 or end > len(data):
            raise ValueError(f"a text of {size} bytes in a list of YARP")
        return data[at + 4 : end].decode("utf-8", "replace"), end
    return _unpacked_list(data, at, kind, deepest - 1)


_TCP, _ACKNOWLEDGED = 7777 + 3, 128
_INDEX = 10
_DOUBLE = {3: 10, 4: 20}
"""How YARP marks float64, by its major version; to YARP 4, 10 is float32."""
_DIGITS = 3


READ = struct.pack("<2si2s", b"YA", _INDEX, b"RP") + b"\1\1" + b"\xff" * 8 + struct.pack("<iii4s", 8, 0, 0, b"~r\0\1")
"""Asks a port, in a binary connection, to send its messages to the caller."""


class Carrier(Enum):
    """A carrier: its name, whether it is text, and whether each message is acknowledged."""

    TEXT = ("text", True, False)
    TEXT_ACK = ("text_ack", True, True)
    TCP = ("tcp", False, True)
    FAST_TCP = ("fast_tcp", False, False)

    def __init__(self, title: str, is_text: bool, acknowledges: bool) -> None:
        self.title = title
        self.is_text = is_text
        self.acknowledges = acknowledges

    @classmethod
    def of_greeting(cls, begin: bytes) -> Carrier | None:
        """Return the carrier that begins a connection with these eight bytes; None: it is not known here."""
        texts = {b"CONNECT ": cls.TEXT, b"CONNACK ": cls.TEXT_ACK}
        return texts.get(begin) or {_TCP: cls.FAST_TCP, _TCP + _ACKNOWLEDGED: cls.TCP}.get(unframed(begin) or 0)

    def greeting(self, name: str) -> bytes:
        """Return the bytes that begin a connection; the receiver of a binary one answers with eight bytes."""
        if self.is_text:
            return f"{'CONNACK' if self.acknowledges else 'CONNECT'} {name}\r\n".encode()
        return (
            framed(_TCP + self.acknowledges * _ACKNOWLEDGED) + struct.pack("<i", len(name) + 1) + name.encode() + b"\0"
        )


class VectorMessage:
    """A vector with its envelope; each form is made once, when the first reader needs it.

    Args:
        values: (n,) numbers.
        time_s: since 1970.
        yarp: major version of the YARP of binary readers, 3 or 4.
    """

    def __init__(self, values: npt.NDArray[np.floating], count: int, time_s: float, yarp: int = 4) -> None:
        self._values = values
        self._tag = _LIST + _DOUBLE[yarp]
        self._command = f"do {count} {time_s:.6f}".encode()

    def of(self, carrier: Carrier) -> bytes:
        return self._text if carrier.is_text else self._binary

    @cached_property
    def _text(self) -> bytes:
        numbers = " ".join(map(repr, np.round(self._values.astype(np.float64), _DIGITS).tolist()))
        return b"%s\r\n%s\r\n" % (self._command, numbers.encode())

    @cached_property
    def _binary(self) -> bytes:
        command = struct.pack("<i4s", len(self._command) + 1, b"~\0\0\1") + self._command + b"\0"
        block = command + struct.pack("<ii", self._tag, len(self._values)) + self._values.astype("<f8").tobytes()
        return framed(_INDEX) + b"\1\1" + b"\xff" * 8 + struct.pack("<ii", len(block), 0) + block


def framed(number: int) -> bytes:
    return struct.pack("<2si2s", b"YA", number, b"RP")


def unframed(data: bytes) -> int | None:
    """Return the number in eight bytes; None if they are no frame of YARP's."""
    begin, number, end = struct.unpack("<2si2s", data)
    return int(number) if (begin, end) == (b"YA", b"RP") else None
