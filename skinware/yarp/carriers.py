"""How a vector is written in YARP's carriers ``text``, ``tcp`` and ``fast_tcp``, and how their connections begin.

Source: YARP's manual, "Port and connection protocols", and for the list of doubles robotology/yarp, VectorOf. All
numbers are little-endian.

* A binary connection begins with ``YA``, 7777 and the carrier's number (3, and 128 where each message is acknowledged)
  i32, ``RP``; then the length of the sender's name with its zero byte i32, and these. The receiver answers eight bytes.
* A message: ``YA``, 10, ``RP``; 1 block, 1 answer and eight FF; the block's length i32; 0 i32. The block begins with a
  command, here ``do``, the number of the message and its time: its length with a zero byte i32, ``~``, 0, 0, 1, it, 0.
  Then the list: 256 + 10 i32 (a list of doubles), its length i32, the doubles.
* An acknowledgement: ``YA``, length i32, ``RP``, and as many bytes.
"""

from __future__ import annotations

import struct
from enum import Enum
from functools import cached_property

import numpy as np
import numpy.typing as npt

_TCP, _ACKNOWLEDGED = 7777 + 3, 128
_INDEX = 10
_LIST_OF_DOUBLES = 256 + 10
_DIGITS = 3


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

    def greeting(self, name: str) -> bytes:
        """What a sender begins a connection with; the receiver of a binary one answers eight bytes."""
        if self.is_text:
            return f"{'CONNACK' if self.acknowledges else 'CONNECT'} {name}\r\n".encode()
        return (
            framed(_TCP + self.acknowledges * _ACKNOWLEDGED) + struct.pack("<i", len(name) + 1) + name.encode() + b"\0"
        )


class Message:
    """A vector as it is sent; each form is made once, when the first reader wants it.

    Args:
        values: (n,) numbers.
        count: of messages of the port.
        time_s: since 1970.
    """

    def __init__(self, values: npt.NDArray[np.floating], count: int, time_s: float) -> None:
        self._values = values
        self._command = f"do {count} {time_s:.6f}".encode()

    def of(self, carrier: Carrier) -> bytes:
        """In a carrier."""
        return self._text if carrier.is_text else self._binary

    @cached_property
    def _text(self) -> bytes:
        numbers = " ".join(map(repr, np.round(self._values.astype(np.float64), _DIGITS).tolist()))
        return b"%s\r\n%s\r\n" % (self._command, numbers.encode())

    @cached_property
    def _binary(self) -> bytes:
        command = struct.pack("<i4s", len(self._command) + 1, b"~\0\0\1") + self._command + b"\0"
        block = command + struct.pack("<ii", _LIST_OF_DOUBLES, len(self._values)) + self._values.astype("<f8").tobytes()
        return framed(_INDEX) + b"\1\1" + b"\xff" * 8 + struct.pack("<ii", len(block), 0) + block


def framed(number: int) -> bytes:
    """A number as YARP marks it."""
    return struct.pack("<2si2s", b"YA", number, b"RP")


def unframed(data: bytes) -> int | None:
    """The number of eight bytes; None if it is not marked as one."""
    begin, number, end = struct.unpack("<2si2s", data)
    return int(number) if (begin, end) == (b"YA", b"RP") else None


__all__ = ["Carrier", "Message", "framed", "unframed"]
