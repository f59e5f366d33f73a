"""Modbus as bytes: questions and replies, and their frames on a serial line (RTU) and over TCP.

A *message* is the part that both have in common: a function and its data. Sources: MODBUS Application Protocol
Specification V1.1b3, MODBUS over Serial Line V1.02, MODBUS Messaging on TCP/IP V1.0b.
"""

from __future__ import annotations

import functools
import re
import struct
from collections.abc import Iterator, Sequence
from typing import NamedTuple

from skinware_drivers.counters import FramerCounters
from skinware_drivers.serial.checksums import CRC16_MODBUS

READ_HOLDING, READ_INPUT, WRITE_ONE, WRITE_MANY = 3, 4, 6, 16
READS = (READ_HOLDING, READ_INPUT)
MOST_REGISTERS, MOST_WRITTEN = 125, 123
"""Registers of one read, and of one write."""
_READ_BITS, _WRITE_BIT, _WRITE_BITS, _MASK, _EXCHANGE = (1, 2), 5, 15, 22, 23
"""Functions that our drivers never use; other programs may use them through the gateway or beside us."""
_MOST_BITS, _MOST_WRITTEN_BITS, _MOST_EXCHANGED = 2000, 1968, 121
_ECHOING = {_WRITE_BIT: 5, WRITE_ONE: 5, _WRITE_BITS: 5, WRITE_MANY: 5, _MASK: 7}
"""Functions whose reply repeats the beginning of the question, and how many bytes of it."""
_COUNTING = (*_READ_BITS, *READS, _EXCHANGE)
"""Functions whose reply has a number of bytes that follow."""
_LENGTH_AT = {_WRITE_BITS: 6, WRITE_MANY: 6, _EXCHANGE: 10}
"""Place of the number of bytes that follow in the question of a function."""
LONGEST_MESSAGE = 253
FAILED = 0x80
"""Bit of the function in a reply that is an exception."""
NO_FUNCTION, NO_REGISTERS, ACKNOWLEDGE, BUSY = 1, 2, 5, 6
EXCEPTIONS = {
    NO_FUNCTION: "it does not know this function",
    NO_REGISTERS: "it has no such registers",
    3: "it does not take this value, or so many registers",
    4: "it failed",
    ACKNOWLEDGE: "it needs more time",
    BUSY: "it is busy",
    8: "its memory has a parity error",
    10: "the gateway has no way to it",
    11: "it does not answer the gateway",
}
_CRC = 2
_MBAP = struct.Struct(">HHHB")


class Message(NamedTuple):
    """A message to or from a unit: the function and the bytes after it.

    The number is that of its transaction; a serial line has none.
    """

    unit: int
    data: bytes
    number: int = 0


def question_to_read(function: int, address: int, count: int) -> bytes:
    if function not in READS or not 1 <= count <= MOST_REGISTERS or not 0 <= address <= 0xFFFF:
        raise ValueError(f"function {function}, {count} registers from {address}: there is no such question")
    return struct.pack(">BHH", function, address, count)


def is_known(question: bytes) -> bool:
    """Return whether the function is one whose questions and replies are known here."""
    return question[0] in _COUNTING or question[0] in _ECHOING


def is_write(question: bytes) -> bool:
    return question[0] in _ECHOING or question[0] == _EXCHANGE


def is_question(question: bytes) -> bool:
    """Return whether a question has the length and asks for the amount that the specification allows."""
    function, size = question[0], len(question)
    count = int.from_bytes(question[3:5], "big")
    if function in READS or function in _READ_BITS:
        return size == 5 and 1 <= count <= (MOST_REGISTERS if function in READS else _MOST_BITS)
    if function in (WRITE_MANY, _WRITE_BITS):
        bits, most = (16, MOST_WRITTEN) if function == WRITE_MANY else (1, _MOST_WRITTEN_BITS)
        return 1 <= count <= most and size == 6 + (bits * count + 7) // 8 == 6 + question[5]
    if function == _EXCHANGE:
        written = int.from_bytes(question[7:9], "big")
        are_few = 1 <= count <= MOST_REGISTERS and 1 <= written <= _MOST_EXCHANGED
        return are_few and size == 10 + 2 * written == 10 + question[9]
    return size == _ECHOING.get(function)


def reply_size(question: bytes) -> int:
    """Return the bytes of a reply that is no exception (an exception has 2); 0: there is no such question."""
    if not question or not is_question(question):
        return 0
    if question[0] in _COUNTING:
        count = int.from_bytes(question[3:5], "big")
        return 2 + ((count + 7) // 8 if question[0] in _READ_BITS else 2 * count)
    return _ECHOING[question[0]]


def echo_of(question: bytes) -> bytes:
    """Return the beginning of a question that its good reply repeats."""
    return question[: _ECHOING.get(question[0], 1)]


def probe_of(question: bytes, count: int) -> bytes:
    """Return a read of so many registers where a question reads or writes some."""
    function = question[0] if question[0] in READS else READ_HOLDING
    return question_to_read(function, int.from_bytes(question[1:3], "big"), count)


def is_reply(question: bytes, reply: bytes) -> bool:
    """Return whether a message can be the reply to a question: a good one, or an exception."""
    if reply[:1] == bytes([question[0] | FAILED]):
        return len(reply) == 2
    if reply[:1] != question[:1] or len(reply) != reply_size(question):
        return False
    return reply[1] == len(reply) - 2 if question[0] in _COUNTING else question.startswith(reply)


def exception_of(reply: bytes) -> int:
    return reply[1] if reply[0] & FAILED and len(reply) > 1 else 0


def exception_text(code: int) -> str:
    return f"{EXCEPTIONS.get(code, 'no known reason')} (exception {code})"


def rtu_frame(message: Message) -> bytes:
    frame = bytes([message.unit]) + message.data
    return frame + CRC16_MODBUS.to_bytes(frame)


def tcp_frame(message: Message) -> bytes:
    return _MBAP.pack(message.number, 0, len(message.data) + 1, message.unit) + message.data


class _Messages:
    """The bytes of a connection or line that are no whole message yet."""

    def __init__(self, counters: FramerCounters) -> None:
        self._counters = counters
        self._rest = b""

    @property
    def pending(self) -> int:
        """Bytes that may still become part of a message."""
        return len(self._rest)

    def drop(self) -> None:
        self._skip(len(self._rest))

    def _skip(self, count: int) -> None:
        self._counters.skipped_bytes += count
        self._rest = self._rest[count:]


class TcpMessages(_Messages):
    """Find the messages in the bytes of a connection."""

    def feed(self, chunk: bytes) -> Iterator[Message]:
        """Yield the messages that a chunk completes."""
        self._counters.bytes_in += len(chunk)
        self._rest += chunk
        while len(self._rest) >= _MBAP.size:
            number, protocol, size, unit = _MBAP.unpack_from(self._rest)
            if protocol or not 2 <= size <= LONGEST_MESSAGE + 1:
                self._counters.refused += 1
                self.drop()
                raise ValueError("the bytes of this connection are no Modbus")
            end = _MBAP.size - 1 + size
            if len(self._rest) < end:
                return
            data, self._rest = self._rest[_MBAP.size : end], self._rest[end:]
            self._counters.frame_bytes += end
            self._counters.frames += 1
            yield Message(unit, data, number)


class RtuMessages(_Messages):
    """Find messages in the bytes of a serial line, where only lengths and checksums show their limits."""

    def feed(self, chunk: bytes) -> None:
        self._counters.bytes_in += len(chunk)
        self._rest += chunk

    def reply_to(self, asked: Sequence[Message]) -> Message | None:
        """Return the reply to one of these questions, if it has arrived; bytes before it are skipped."""
        return self._first(asked, also_questions=False)

    def repeats(self, asked: Message) -> bool:
        """Return whether another reply to a question seems to follow the one that was found."""
        return len(self._rest) > 2 and bool(_sizes_of_reply(self._rest, asked.unit, asked.data))

    def next_of(self, asked: Message | None) -> Message | None:
        """Return the next message on a line with another master: the reply to ``asked``, or a question."""
        return self._first([] if asked is None else [asked], also_questions=True)

    def _first(self, asked: Sequence[Message], *, also_questions: bool) -> Message | None:
        place, rest, was_damaged = 0, self._rest, False
        beginning = _beginning_of(frozenset((each.unit, each.data[0]) for each in asked), also_questions)
        while place < len(rest):
            found = beginning.search(rest, place)  # on a babbling line hardly any byte begins a message
            if found is None:
                place = len(rest)
                break
            place = found.start()
            here = rest[place:]
            sizes = [size for each in asked for size in _sizes_of_reply(here, each.unit, each.data)]
            if also_questions:
                sizes.append(_size_of_question(here))
            whole = [size for size in sizes if 0 < size <= len(here)]
            for size in whole:
                if CRC16_MODBUS.of(here[: size - _CRC]) == int.from_bytes(here[size - _CRC : size], "little"):
                    self._skip(place)
                    self._rest = rest[place + size :]
                    self._counters.frame_bytes += size
                    self._counters.frames += 1
                    return Message(here[0], here[1 : size - _CRC])
            was_damaged |= bool(whole)
            if any(size > len(here) for size in sizes):
                break
            place += 1
        self._counters.checksum_errors += was_damaged and place > 0
        self._skip(place)
        return None


@functools.lru_cache(256)
def _beginning_of(asked: frozenset[tuple[int, int]], also_questions: bool) -> re.Pattern[bytes]:
    beginnings = []
    for numbers in asked:
        unit, function = (re.escape(bytes([number])) for number in numbers)
        failed = re.escape(bytes([numbers[1] | FAILED]))
        beginnings.append(unit + b"(?:" + function + b"|" + failed + b"|\\Z)")
    if also_questions:
        known = b"".join(re.escape(bytes([number])) for number in (*range(1, WRITE_ONE + 1), *_LENGTH_AT, _MASK))
        beginnings.append(b".(?:[" + known + b"]|\\Z)")
    return re.compile(b"|".join(beginnings), re.DOTALL)


def _sizes_of_reply(here: bytes, unit: int, question: bytes) -> list[int]:
    size = reply_size(question)
    good = bytes([unit]) + question[:1]
    if question[0] in _COUNTING:
        good += bytes([size - 2]) if size else b""
    failed = bytes([unit, question[0] | FAILED])
    sizes = []
    for begin, whole in ((good, 1 + size + _CRC if size else 0), (failed, 3 + _CRC)):
        n = min(len(begin), len(here))
        if whole and here[:n] == begin[:n]:
            sizes.append(whole)
    return sizes


def _size_of_question(here: bytes) -> int:
    """Return the bytes of the question that may begin here; 0: none does."""
    if len(here) < 2 or 1 <= here[1] <= WRITE_ONE:
        return 8
    if here[1] == _MASK:
        return 10
    length_at = _LENGTH_AT.get(here[1])
    if length_at is None:
        return 0
    return length_at + 3 + (here[length_at] if len(here) > length_at else 0)
