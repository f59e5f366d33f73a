"""Modbus as bytes: published examples, streams cut at every byte, and noise."""

from __future__ import annotations

import random
from unittest import mock

import pytest

from skinware_drivers.counters import FramerCounters
from skinware_drivers.modbus import wire
from skinware_drivers.modbus.wire import Message, RtuMessages, TcpMessages

RTU = [  # of the Modbus specification, and computed from manuals
    ("01 03 0B B8 00 09 07 CD", Message(1, wire.question_to_read(3, 3000, 9))),
    ("01 03 0B CA 00 60 67 F8", Message(1, wire.question_to_read(3, 3018, 96))),
    ("01 03 0B B8 00 7D 07 EA", Message(1, wire.question_to_read(3, 3000, 125))),
    ("01 04 00 07 00 24 41 D0", Message(1, wire.question_to_read(4, 7, 36))),
    ("27 06 00 3C 00 01 8F 00", Message(0x27, bytes.fromhex("06 003C 0001"))),
    ("01 83 02 C0 F1", Message(1, bytes.fromhex("83 02"))),
    (
        "7E 10 0F A0 00 05 0A 00 01 00 01 00 01 00 01 00 01 4E E4",
        Message(126, bytes.fromhex("10 0FA0 0005 0A 0001 0001 0001 0001 0001")),
    ),
]
READ_9 = wire.question_to_read(3, 3000, 9)
REPLY_9 = b"\x03\x12" + bytes(range(18))


@pytest.mark.parametrize(("frame", "message"), RTU)
def test_frames_of_lines(frame: str, message: Message) -> None:
    assert wire.rtu_frame(message) == bytes.fromhex(frame)


def test_frames_of_connections() -> None:
    assert wire.tcp_frame(Message(1, READ_9, 1)) == bytes.fromhex("0001 0000 0006 01 03 0BB8 0009")
    [found] = TcpMessages(FramerCounters()).feed(bytes.fromhex("0001 0000 0015 01 03 12") + bytes(18))
    assert found == Message(1, b"\x03\x12" + bytes(18), 1)


@pytest.mark.parametrize(("function", "address", "count"), [(3, 0, 0), (3, 0, 126), (3, 65536, 1), (6, 0, 1)])
def test_questions_that_are_none(function: int, address: int, count: int) -> None:
    with pytest.raises(ValueError, match="no such question"):
        wire.question_to_read(function, address, count)


@pytest.mark.parametrize(
    ("question", "reply", "is_one"),
    [
        (READ_9, REPLY_9, True),
        (READ_9, b"\x83\x02", True),
        (READ_9, b"\x83\x02\x00", False),
        (READ_9, REPLY_9[:-1], False),
        (READ_9, b"\x03\x11" + bytes(18), False),
        (READ_9, b"\x04\x12" + bytes(18), False),
        (READ_9, b"", False),
        (bytes.fromhex("06 003C 0001"), bytes.fromhex("06 003C 0001"), True),
        (bytes.fromhex("06 003C 0001"), bytes.fromhex("06 003C 0002"), False),
        (bytes.fromhex("10 0FA0 0001 02 0001"), bytes.fromhex("10 0FA0 0001"), True),
        (bytes.fromhex("10 0FA0 0001 02 0001"), bytes.fromhex("10 0FA0 0002"), False),
    ],
)
def test_what_is_a_reply(question: bytes, reply: bytes, is_one: bool) -> None:
    assert wire.is_reply(question, reply) == is_one


@pytest.mark.parametrize("size", [1, 2, 3, 7, 100])
def test_replies_on_a_line_are_found_in_whatever_pieces_and_behind_whatever_noise(size: int) -> None:
    counters = FramerCounters()
    found = RtuMessages(counters)
    noise = b"\x01\x03\xff\x00\x01"
    stream = noise + wire.rtu_frame(Message(1, REPLY_9))
    replies = []
    for at in range(0, len(stream), size):
        found.feed(stream[at : at + size])
        if (reply := found.reply_to([Message(1, READ_9)])) is not None:
            replies.append(reply)
    assert replies == [Message(1, REPLY_9)]
    assert (counters.frames, counters.skipped_bytes) == (1, len(noise))
    assert counters.bytes_in == counters.frame_bytes + counters.skipped_bytes


def test_a_reply_with_a_flipped_bit_is_none() -> None:
    good = wire.rtu_frame(Message(1, REPLY_9))
    for bit in range(24, 8 * len(good)):
        counters = FramerCounters()
        found = RtuMessages(counters)
        damaged = bytearray(good)
        damaged[bit // 8] ^= 1 << bit % 8
        found.feed(bytes(damaged))
        assert found.reply_to([Message(1, READ_9)]) is None
        assert counters.checksum_errors == 1


def test_replies_of_other_units_and_of_other_lengths_are_none() -> None:
    found = RtuMessages(FramerCounters())
    for other in (Message(2, REPLY_9), Message(1, b"\x03\x04abcd"), Message(1, b"\x04" + REPLY_9[1:])):
        found.feed(wire.rtu_frame(other))
        assert found.reply_to([Message(1, READ_9)]) is None
    found.feed(wire.rtu_frame(Message(1, b"\x83\x06")))
    assert found.reply_to([Message(1, READ_9)]) == Message(1, b"\x83\x06")


def test_what_is_no_modbus_ends_a_connection() -> None:
    for garbage in (
        b"HTTP/1.1 400 Bad Request\r\n",
        bytes.fromhex("0001 0000 0001 01"),
        bytes.fromhex("00010000FFFF01"),
    ):
        with pytest.raises(ValueError, match="no Modbus"):
            list(TcpMessages(FramerCounters()).feed(garbage))


def test_messages_of_a_connection_come_in_whatever_pieces() -> None:
    messages = [Message(unit, REPLY_9, 1000 + unit) for unit in range(1, 9)]
    stream = b"".join(map(wire.tcp_frame, messages))
    counters = FramerCounters()
    found = TcpMessages(counters)
    assert [message for byte in stream for message in found.feed(bytes([byte]))] == messages
    assert list(found.feed(stream)) == messages
    assert counters.bytes_in == counters.frame_bytes == 2 * len(stream)


def test_noise_is_counted_and_never_raises_on_a_line() -> None:
    noise = random.Random(5)
    counters = FramerCounters()
    found, pending = RtuMessages(counters), 0
    for _ in range(3000):
        found.feed(noise.randbytes(noise.randrange(1, 40)))
        found.reply_to([Message(1, READ_9)])
        found.next_of(Message(1, READ_9))
        pending = len(found._rest)
        assert pending < 300
    assert counters.bytes_in == counters.frame_bytes + counters.skipped_bytes + pending


@pytest.mark.parametrize(("listens", "most"), [(False, 0.02), (True, 0.1)])
def test_a_line_that_babbles_is_hardly_looked_at(listens: bool, most: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Work is counted, not timed: a byte at which nothing can begin costs none of ours."""
    noise = random.Random(1).randbytes(20_000)
    looks = mock.Mock(side_effect=wire._sizes_of_reply)
    monkeypatch.setattr(wire, "_sizes_of_reply", looks)
    counters = FramerCounters()
    line = RtuMessages(counters)
    for start in range(0, len(noise), 64):
        line.feed(noise[start : start + 64])
        while (line.next_of(Message(1, READ_9)) if listens else line.reply_to([Message(1, READ_9)])) is not None:
            pass
    assert counters.skipped_bytes + counters.frame_bytes + line.pending == len(noise)
    assert looks.call_count < most * len(noise)
