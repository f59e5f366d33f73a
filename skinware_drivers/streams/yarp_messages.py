"""Split the messages of a YARP port in its carrier ``fast_tcp``, lists of numbers, into frames of twelve values.

Source: robotology/yarp, tags v3.8.1 and v4.0.0 (``PortCommand``, ``VectorOf``, ``BottleImpl``), and exchanges with
ports of both. All numbers are little-endian.

A message begins with ``YA``, 10 i32, ``RP``; the number of its blocks u8, 1 u8 and eight FF; the length of each block
i32; and 0 i32. The blocks follow: a command, then the data. A command is the length of its text i32, ``~``, and three
bytes, the first of which is the command if there is no text. The command ``D`` or ``d`` announces data. Its text can
have an envelope: the number of the message and its time in seconds since 1970. The data are a list: its tag i32, the
number of values i32, the values. A tag is 256 plus the type of all values (1: int32; 10: float64 up to YARP 3, float32
since YARP 4; 20: float64 since YARP 4), or 256 alone for a list in which each value follows its own type. The length of
the block shows which meaning of 10 applies.

The values become frames of twelve, the number of a triangle; the last one is filled up with 0. The identifier of a
frame is ``kind << 8 | number``, with the driver's number for these twelve. Its body is the sender's time in ms u32 and
twelve float32; the kind ``PLAIN`` has no time, which is 0. A frame of the kind ``LENGTH`` (number 0) has the number of
values in a message, u32; it comes now and then, and when three messages in a row had an unexpected number.
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from skinware_drivers.serial.framing import Framed, Framer, ReceivedFraming, begun

LENGTH, PLAIN, TIMED = 0, 1, 2
"""Kinds of frames."""
VALUES_OF_A_FRAME = 12
MOST_VALUES = 3072
"""Values of a message: sixteen boards of sixteen triangles."""
BEGIN = struct.pack("<2si2s", b"YA", 10, b"RP")
"""The first bytes of every message."""
LONGEST = 1 << 16
"""Bytes of the longest message that is waited for."""
_FIXED = len(BEGIN) + 2 + 8
_MOST_BLOCKS = 16
_COMMAND = struct.Struct("<i4s")
_LIST = struct.Struct("<ii")
_OF_LISTS = 256
_INT32, _FLOAT_OF_3, _FLOAT64_OF_4 = 1, 10, 20
_ENVELOPE = re.compile(rb"[dD][oO]?[ \t]\s*\d{1,10}\s+(?P<time>\d{1,11}(?:\.\d{1,9})?)\s*\0?")
_SURE = 3
_REPORT_EVERY = 64
_U32 = 0xFFFF_FFFF


@dataclass(frozen=True)
class YarpMessages(ReceivedFraming):
    """The framing, for receiving only.

    Args:
        length: values of a message; others are refused. 0: not known yet; there are only frames ``LENGTH`` then.
        parts: (number, first value) of each twelve values that matter.
    """

    length: int = 0
    parts: tuple[tuple[int, int], ...] = ()
    maximum_body: int = field(default=4 + 4 * VALUES_OF_A_FRAME, init=False)

    def framer(self) -> Framer:
        return _Vectors(self)


def message_size(stream: bytes, start: int = 0) -> int | None:
    """Return the length of the message that begins at ``start``; 0: none does, None: its head is not whole yet."""
    if len(stream) < start + _FIXED:
        return None
    n_blocks = stream[start + len(BEGIN)]
    if not stream.startswith(BEGIN, start) or not 1 <= n_blocks <= _MOST_BLOCKS:
        return 0
    head = _FIXED + 4 * (n_blocks + 1)
    if len(stream) < start + head:
        return None
    blocks = struct.unpack_from(f"<{n_blocks}i", stream, start + _FIXED)
    size = head + sum(blocks)
    return size if min(blocks) >= 0 and size <= LONGEST else 0


class _Vectors(Framer):
    def __init__(self, framing: YarpMessages) -> None:
        super().__init__()
        self._length, self._parts = framing.length, framing.parts
        self._last, self._times = 0, 0  # values of the last message, and of how many before it

    def _find(self, stream: bytes) -> tuple[list[Framed], int]:
        found: list[Framed] = []
        done = 0
        while True:
            begin = stream.find(BEGIN, done)
            if begin < 0:
                kept = begun(stream, BEGIN)
                self._skip(max(done, len(stream) - kept) - done)
                return found, max(done, len(stream) - kept)
            self._skip(begin - done)
            size = message_size(stream, begin)
            if size == 0:
                self.counters.refused += 1
                self._skip(len(BEGIN))
                done = begin + len(BEGIN)
                continue
            if size is None or len(stream) < begin + size:
                self._wanted = size or 0  # counted from the beginning of the rest
                return found, begin
            cut = stream.find(BEGIN, begin + 1, begin + size)
            if cut >= 0:  # the next message begins in it
                self.counters.refused += 1
                self._skip(cut - begin)
                done = cut
                continue
            done = begin + size
            self._take(stream[begin:done], self._before + done, found)

    def _skip(self, size: int) -> None:
        self.counters.skipped_bytes += size

    def _take(self, message: bytes, end: int, found: list[Framed]) -> None:
        """Count a whole message as used or refused, append its frames to ``found``, now and then with its length."""
        envelope, values = _content(message[_FIXED + 4 * (message[len(BEGIN)] + 1) :])
        if values is not None:
            self._times = self._times + 1 if len(values) == self._last else 1
            self._last = len(values)
            if self._times % _REPORT_EVERY == (0 if len(values) == self._length else _SURE):
                found.append(Framed(LENGTH << 8, len(values).to_bytes(4, "little"), end))
        if values is None or self._length not in (0, len(values)):
            self.counters.refused += 1
            self._skip(len(message))
            return
        self.counters.frame_bytes += len(message)
        match = _ENVELOPE.fullmatch(envelope)
        time_ms = int(float(match["time"]) * 1e3) & _U32 if match is not None else 0
        kind, stamp = TIMED if time_ms else PLAIN, time_ms.to_bytes(4, "little")
        filled = values.tobytes().ljust(-(-len(values) // VALUES_OF_A_FRAME) * 4 * VALUES_OF_A_FRAME, b"\0")
        for number, first in self._parts:
            body = stamp + filled[4 * first : 4 * (first + VALUES_OF_A_FRAME)]
            found.append(Framed(kind << 8 | number, body, end))


def _content(blocks: bytes) -> tuple[bytes, npt.NDArray[np.float32] | None]:
    """Return the text of the command and the values of a message; None if it is no list of numbers."""
    if len(blocks) < _COMMAND.size:
        return b"", None
    size, command = _COMMAND.unpack_from(blocks)
    at = _COMMAND.size + size
    text = blocks[_COMMAND.size : at] if size else command[1:2]
    if size < 0 or len(text) != max(1, size) or command[:1] != b"~" or text[:1] not in (b"d", b"D"):
        return b"", None
    return text, _values(blocks[at:])


def _values(data: bytes) -> npt.NDArray[np.float32] | None:
    """Return the numbers of a list as float32; None if it is no such list, or longer than a skin."""
    if len(data) < _LIST.size:
        return None
    tag, count = _LIST.unpack_from(data)
    numbers = data[_LIST.size :]
    if not 1 <= count <= MOST_VALUES:
        return None
    if tag == _OF_LISTS:
        return _mixed(numbers, count)
    dtype = {
        (_OF_LISTS | _INT32, 4): "<i4",
        (_OF_LISTS | _FLOAT_OF_3, 8): "<f8",
        (_OF_LISTS | _FLOAT_OF_3, 4): "<f4",
        (_OF_LISTS + _FLOAT64_OF_4, 8): "<f8",
    }.get((tag, len(numbers) // count))
    if dtype is None or len(numbers) % count:
        return None
    with np.errstate(over="ignore"):
        return np.frombuffer(numbers, dtype).astype("<f4")


def _mixed(numbers: bytes, count: int) -> npt.NDArray[np.float32] | None:
    """Return the numbers of a list whose values have their own types, such as a Bottle of both kinds of numbers."""
    for float_of_3 in ("<d", "<f"):  # the length shows which
        forms = {_INT32: "<i", _FLOAT_OF_3: float_of_3, _FLOAT64_OF_4: "<d"}
        found: list[float] = []
        at = 0
        while at + 4 <= len(numbers) and len(found) < count:
            form = forms.get(int.from_bytes(numbers[at : at + 4], "little"))
            if form is None or at + 4 + struct.calcsize(form) > len(numbers):
                break
            found.append(struct.unpack_from(form, numbers, at + 4)[0])
            at += 4 + struct.calcsize(form)
        if len(found) == count and at == len(numbers):
            with np.errstate(over="ignore"):
                return np.array(found, np.float64).astype("<f4")
    return None
