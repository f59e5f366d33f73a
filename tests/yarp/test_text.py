"""The text carrier of YARP: literal messages, those of the manual among them, and everything that is none."""

from __future__ import annotations

import math
import struct
from itertools import pairwise

import numpy as np
import pytest

from skinware_drivers.serial.framing import Framed
from skinware_drivers.streams.yarp_text import LENGTH, LONGEST_LINE, MOST_VALUES, PLAIN, TIMED, YarpText

WELCOME = b"Welcome foo\r\n"
MANUAL = (  # "YARP without YARP", the section on listening
    b"do 2654 1215723086.182938\n10.0 10.0 -10.0 -10.0 5.0\ndo 2655 1215723086.203243\n10.0 10.0 -10.0 -10.0 5.0\n"
)
NETCAT = b'CONNECT /write\nd\n0 "hello world"\n'
"""What the manual's other port says, of which nothing is a skin's."""
LINE = b" ".join(b"%d.0" % number for number in range(12))
TWELVE = b"D\r\n" + LINE + b"\r\n"
"""As ``yarp write`` of YARP 4.0 begins a message."""


def found(stream: bytes, length: int = 12, *parts: tuple[int, int]) -> list[Framed]:
    return YarpText(length, parts or ((0x21, 0),)).framer().feed(stream)


def numbers(frame: Framed) -> tuple[float, ...]:
    return struct.unpack("<4x12f", frame.body)


def test_a_message_of_each_kind_of_first_line() -> None:
    for head in (b"d", b"do", b"D", b"DO", b"d ", b"d 3 four", b"d \xff"):
        (frame,) = found(WELCOME + head + b"\r\n" + LINE + b"\r\n")
        assert frame.identifier == PLAIN << 8 | 0x21
        assert (frame.body[:4], numbers(frame)) == (bytes(4), tuple(range(12)))


def test_the_messages_of_the_manual() -> None:
    first, second = found(MANUAL, 5)
    assert first.identifier == second.identifier == TIMED << 8 | 0x21
    assert struct.unpack("<I12f", first.body) == (1215723086182 & 0xFFFF_FFFF, 10, 10, -10, -10, 5, *[0] * 7)
    assert int.from_bytes(second.body[:4], "little") - int.from_bytes(first.body[:4], "little") == 21
    assert [frame.end for frame in (first, second)] == [len(MANUAL) // 2, len(MANUAL)]
    assert found(NETCAT, 1) == []


def test_a_vector_is_cut_where_the_parts_say() -> None:
    vector = b"d\n" + b" ".join(b"%d" % number for number in range(40)) + b"\n"
    one, other = found(vector, 40, (0x00, 36), (0x1F, 12))
    assert numbers(one) == (36, 37, 38, 39, *[0] * 8)
    assert numbers(other) == tuple(range(12, 24))
    assert (one.identifier, other.identifier) == (PLAIN << 8, PLAIN << 8 | 0x1F)


@pytest.mark.parametrize("text", [b"1", b"1.5", b"-2", b"1e2", b"1E-2", b"+3.", b".5", b"123.456789012345"])
def test_numbers_as_they_can_be_written(text: bytes) -> None:
    (frame,) = found(b"d\n" + text + b"\n", 1)
    assert numbers(frame)[0] == np.float32(float(text))


@pytest.mark.parametrize(
    ("text", "shown"),
    [(b"nan", math.nan), (b"-nan", math.nan), (b"NaN", math.nan), (b"inf", math.inf), (b"1e300", math.inf)],
)
def test_what_is_no_value_is_handed_on_for_its_sensor_alone(text: bytes, shown: float) -> None:
    (frame,) = found(b"d\n1 " + text + b" 3\n", 3)
    assert numbers(frame)[:3] == pytest.approx((1, shown, 3), nan_ok=True)


@pytest.mark.parametrize(
    "wrong",
    [
        b"",
        b"(1 2 3)",
        b"1 2 (3 4) 5 6 7 8 9 10 11 12",
        b"[1] 2 3 4 5 6 7 8 9 10 11 12",
        b'"hello world"',
        b"hello",
        b"1_0 2 3 4 5 6 7 8 9 10 11 12",
        b"1,0 2 3 4 5 6 7 8 9 10 11 12",
        b"0x10 2 3 4 5 6 7 8 9 10 11 12",
        b"infinity",
        b"1..2",
        b"e",
        b"-",
        b"1 2 3 4 5 6 7 8 9 10 11",
        b"1 2 3 4 5 6 7 8 9 10 11 12 13",
        b"1\0 2",
        b"\xff\xfe",
        b"{1 2 3}",
        b"1 " * (MOST_VALUES + 1),
        "\u0661 \u0662".encode(),
    ],
)
def test_what_is_no_vector_of_this_length_is_counted_and_costs_itself_alone(wrong: bytes) -> None:
    framer = YarpText(12, ((0, 0),)).framer()
    stream = b"d\n" + wrong + b"\n" + TWELVE
    (frame,) = framer.feed(stream)
    assert numbers(frame) == tuple(range(12))
    counters = framer.counters
    assert counters.refused == 1
    assert counters.skipped_bytes == len(wrong) + 1
    assert counters.bytes_in == counters.frame_bytes + counters.idle_bytes + counters.skipped_bytes


def test_a_first_line_without_a_second_and_a_second_without_a_first() -> None:
    framer = YarpText(12, ((0, 0),)).framer()
    assert len(framer.feed(b"d\n" + TWELVE)) == 1
    assert framer.counters.refused == 1
    assert len(framer.feed(LINE + b"\r\n" + TWELVE)) == 1
    assert framer.counters.refused == 2


def test_a_line_that_does_not_end_is_given_up_and_needs_no_room() -> None:
    framer = YarpText(12, ((0, 0),)).framer()
    framer.feed(b"d\n")
    for _ in range(40):
        assert framer.feed(b"1.0 " * 4096) == []
        assert framer.pending <= LONGEST_LINE
    assert framer.counters.refused >= 1
    (frame,) = framer.feed(b"2.0\n" + TWELVE)
    assert numbers(frame) == tuple(range(12))
    counters = framer.counters
    assert counters.bytes_in == counters.frame_bytes + counters.idle_bytes + counters.skipped_bytes


def test_it_does_not_matter_where_the_stream_is_cut() -> None:
    stream = WELCOME + TWELVE + b"rubbish\n" + MANUAL + b"do 7 8.5\r\n" + LINE + b"\r\n"
    whole = found(stream)
    assert len(whole) == 2
    for size in (1, 2, 3, 7, 50):
        framer = YarpText(12, ((0x21, 0),)).framer()
        cuts = [*range(0, len(stream), size), len(stream)]
        assert [frame for a, b in pairwise(cuts) for frame in framer.feed(stream[a:b])] == whole


def told(frames: list[Framed]) -> list[int]:
    assert {frame.identifier for frame in frames} <= {LENGTH << 8}
    return [int.from_bytes(frame.body, "little") for frame in frames]


def test_the_number_of_values_is_told_when_it_is_sure() -> None:
    framer = YarpText().framer()
    assert told(framer.feed(TWELVE * 2 + MANUAL)) == []
    assert told(framer.feed(TWELVE * 2)) == []
    assert told(framer.feed(TWELVE)) == [12]
    assert told(framer.feed(TWELVE * 600)) == [12] * 9
    assert framer.counters.refused == 0


def test_another_number_of_values_is_refused_and_told() -> None:
    framer = YarpText(5, ((0, 0),)).framer()
    assert [frame.identifier for frame in framer.feed(TWELVE * 2 + MANUAL + TWELVE * 2)] == [TIMED << 8] * 2
    assert told(framer.feed(TWELVE)) == [12]
    assert framer.counters.refused == 5


@pytest.mark.parametrize("time", [b"0", b"0.0", b"-5", b"nan", b"1e400", b"99999999999999"])
def test_a_time_that_is_none_is_none(time: bytes) -> None:
    (frame,) = found(b"do 5 " + time + b"\n" + LINE + b"\n")
    assert frame.identifier >> 8 == PLAIN


def test_nothing_can_be_said() -> None:
    with pytest.raises(ValueError, match="only read"):
        YarpText().encode(0, b"tare")
