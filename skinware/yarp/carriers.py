"""How a vector is written in YARP's carriers ``text``, ``tcp`` and ``fast_tcp``, and how their connections begin.

Source: YARP's manual, "Port and connection protocols", and for the list of doubles robotology/yarp, VectorOf. All
numbers are little-endian.

* A binary connection begins with ``YA``, 7777 and the carrier's number (3, and 128 where each message is acknowledged)
  i32, ``RP``; then the length of the sender's name with its zero byte i32, and these. The receiver answers eight bytes.
* A message: ``YA``, 10, ``RP``; 1 block, 1 answer and eight FF; the block's length i32; 0 i32. The block begins with a
  command, here ``do``, the number of the message and its time: its length with a zero byte i32, ``~``, 0, 0, 1, it, 0.
  Then the list: its tag i32, its length i32, the doubles. The tag of a list of float64 is 256 + 10 up to YARP 3 and
  256 + 20 since YARP 4, where 256 + 10 is float32 (exchanges with 3.8.1 and 4.0.0): a reader of the other version
  would show nonsense, or nothing.
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
_LIST = 256
_DOUBLE = {3: 10, 4: 20}
"""How YARP marks float64, by its major version; to YARP 4, 10 is float32."""
_DIGITS = 3


READ = struct.pack("<2si2s", b"YA", _INDEX, b"RP") + b"\1\1" + b"\xff" * 8 + struct.pack("<iii4s", 8, 0, 0, b"~r\0\1")
"""What asks a port, in a binary connection, to send its messages to whoever called."""


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
        """The carrier that a connection begins with in these eight bytes; None if it is none of ours."""
        texts = {b"CONNECT ": cls.TEXT, b"CONNACK ": cls.TEXT_ACK}
        return texts.get(begin) or {_TCP: cls.FAST_TCP, _TCP + _ACKNOWLEDGED: cls.TCP}.get(unframed(begin) or 0)

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
        yarp: major version of the YARP that reads binary carriers, 3 or 4.
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
    """The number of eight bytes; None if it is not marked as one."""
    begin, number, end = struct.unpack("<2si2s", data)
    return int(number) if (begin, end) == (b"YA", b"RP") else None
