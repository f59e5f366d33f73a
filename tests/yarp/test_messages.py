"""The binary messages of YARP: literal ones, those of real ports, and everything that is none."""

from __future__ import annotations

import math
import re
import struct
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from skinware_drivers.serial.framing import Framed
from skinware_drivers.streams.yarp_messages import LENGTH, LONGEST, MOST_VALUES, PLAIN, TIMED, YarpMessages
from tests.yarp.peers import GREETING, message, vector

TRANSCRIPTS = Path(__file__).parents[3] / "shared/data/yarp_transcripts"
TWELVE = [float(number) for number in range(12)]
DATA = struct.pack("<ii12d", 276, 12, *TWELVE)


def found(stream: bytes, length: int = 12, *parts: tuple[int, int]) -> list[Framed]:
    return YarpMessages(length, parts or ((0x21, 0),)).framer().feed(stream)


def numbers(frame: Framed) -> tuple[float, ...]:
    return struct.unpack("<4x12f", frame.body)


def received(name: str) -> bytes:
    """What a real port sent to its reader, from its answer to the greeting on."""
    path = TRANSCRIPTS / f"{name}.txt"
    if not path.exists():
        pytest.skip(f"there are no exchanges with a real YARP: {path} is missing")
    connections = path.read_text().split("\nconnection ")
    (port,) = [each for each in connections if GREETING.hex() in each]
    lines = [line[2:].split()[0] for line in port.splitlines() if re.match(r"< [0-9a-f]{8}", line)]
    return b"".join(bytes.fromhex(line[: len(line) // 2 * 2]) for line in lines)


@pytest.mark.parametrize("yarp", ["381", "400"])
@pytest.mark.parametrize("kind", ["vector_env", "vector_noenv", "bottle_env", "ibottle_noenv"])
def test_messages_of_real_ports(kind: str, yarp: str) -> None:
    framer = YarpMessages(12, ((0x21, 0),)).framer()
    frames = framer.feed(received(f"r_fast_tcp_{kind}_yarp{yarp}"))
    assert len(frames) >= 3
    values = [numbers(frame) for frame in frames if frame.identifier >> 8 != LENGTH]
    first = int(values[0][0])
    assert values == [tuple(float((first + n + i) % 256) for i in range(12)) for n in range(len(values))]
    assert {frame.identifier >> 8 for frame in frames} <= {LENGTH, PLAIN if "noenv" in kind else TIMED}
    assert framer.counters.refused == 0
    assert framer.counters.skipped_bytes == 8  # the answer to the greeting, which the port's end of a bus takes


def test_vectors_of_float32_and_of_odd_doubles_of_real_ports() -> None:
    (first, *_) = found(received("r_fast_tcp_float_env_yarp400"))
    assert numbers(first) == tuple(float(number) for number in range(21, 33))
    for yarp in ("381", "400"):
        (first, *_) = found(received(f"r_fast_tcp_odd_env_yarp{yarp}"))
        expected = np.array([1 / 3, 1e-20, 123456789.125, -0.0, math.nan], np.float32)
        assert np.array_equal(np.array(numbers(first)[:5], np.float32), expected, equal_nan=True)


def test_a_message_with_and_without_a_time() -> None:
    (plain,) = found(vector(TWELVE))
    assert (plain.identifier, plain.body[:4], numbers(plain)) == (PLAIN << 8 | 0x21, bytes(4), tuple(TWELVE))
    (timed,) = found(vector(TWELVE, "D 22 1795427851.26986"))
    assert timed.identifier == TIMED << 8 | 0x21
    assert struct.unpack_from("<I", timed.body)[0] == 1795427851269 & 0xFFFF_FFFF


@pytest.mark.parametrize(
    ("tag", "form"), [(266, "d"), (266, "f"), (276, "d"), (257, "i")], ids=["float64 of 3", "float32", "float64", "int"]
)
def test_lists_of_one_type(tag: int, form: str) -> None:
    (frame,) = found(message(struct.pack(f"<ii12{form}", tag, 12, *range(12))))
    assert numbers(frame) == tuple(TWELVE)


@pytest.mark.parametrize(("code", "form"), [(10, "d"), (10, "f"), (20, "d")])
def test_lists_with_a_type_for_each_value(code: int, form: str) -> None:
    values = b"".join(struct.pack("<ii", 1, n) if n % 2 else struct.pack(f"<i{form}", code, n) for n in range(12))
    (frame,) = found(message(struct.pack("<ii", 256, 12) + values))
    assert numbers(frame) == tuple(TWELVE)


def test_a_vector_is_cut_where_the_parts_say() -> None:
    one, other = found(vector([float(number) for number in range(40)]), 40, (0x00, 36), (0x1F, 12))
    assert numbers(one) == (36, 37, 38, 39, *[0] * 8)
    assert numbers(other) == tuple(range(12, 24))
    assert (one.identifier, other.identifier) == (PLAIN << 8, PLAIN << 8 | 0x1F)


@pytest.mark.parametrize("shown", [math.nan, -math.nan, math.inf, -math.inf])
def test_what_is_no_value_is_handed_on_for_its_sensor_alone(shown: float) -> None:
    (frame,) = found(vector([1.0, shown, 3.0]), 3)
    assert numbers(frame)[:3] == pytest.approx((1, shown, 3), nan_ok=True)


BEGIN = bytes.fromhex("59410a0000005250")


@pytest.mark.parametrize(
    "wrong",
    [
        vector(TWELVE[:11]),
        vector([*TWELVE, 12.0]),
        vector([1.0] * (MOST_VALUES + 1)),
        message(b""),
        message(struct.pack("<ii", 276, 0)),
        message(struct.pack("<ii", 276, -1)),
        message(struct.pack("<ii", 276, 1 << 30)),
        message(struct.pack("<ii11d", 276, 12, *range(11))),
        message(struct.pack("<ii12d", 5, 12, *range(12))),
        message(struct.pack("<iii5sx", 256, 1, 5, b"hello")),
        message(DATA, b"\1\0\0\0~\0\0\1D" + bytes(20)),
        message(DATA, b"\xff\xff\xff\x7f~\0\0\1D"),
        message(DATA, b"\0\0\0\0~q\0\1"),
        message(DATA, b"\0\0\0\0!D\0\1"),
        message(DATA, b""),
        BEGIN + b"\0\1" + b"\xff" * 8 + bytes(8),
        BEGIN + b"\xff\1" + b"\xff" * 8 + bytes(8),
        BEGIN + b"\1\1" + b"\xff" * 8 + struct.pack("<ii", 1 << 30, 0),
        BEGIN + b"\1\1" + b"\xff" * 8 + struct.pack("<ii", -5, 0),
        b"CONNECT foo\r\nD\r\n1.0 2.0\r\n",
        b"\xff" * 300,
    ],
)
def test_what_is_no_vector_of_this_length_is_counted_and_costs_itself_alone(wrong: bytes) -> None:
    framer = YarpMessages(12, ((0, 0),)).framer()
    (frame,) = framer.feed(wrong + vector(TWELVE))
    assert numbers(frame) == tuple(TWELVE)
    counters = framer.counters
    assert counters.refused == (BEGIN in wrong)
    assert counters.skipped_bytes == len(wrong)
    assert counters.bytes_in == counters.frame_bytes + counters.idle_bytes + counters.skipped_bytes


def test_what_never_becomes_a_message_needs_no_room() -> None:
    framer = YarpMessages(12, ((0, 0),)).framer()
    promise = BEGIN + b"\1\1" + b"\xff" * 8 + struct.pack("<ii", LONGEST - 100, 0)
    for _ in range(40):
        framer.feed(promise + bytes(16_384))
        assert framer.pending <= LONGEST
    assert framer.counters.refused >= 1


def test_it_does_not_matter_where_the_stream_is_cut() -> None:
    stream = b"rubbish" + vector(TWELVE) + b"YA\nrubbish" + vector([1.0]) + vector(TWELVE, "d 7 8.5") + vector(TWELVE)
    whole = found(stream)
    assert len(whole) == 3
    for size in (1, 2, 3, 7, 50):
        framer = YarpMessages(12, ((0x21, 0),)).framer()
        cuts = [*range(0, len(stream), size), len(stream)]
        assert [frame for a, b in pairwise(cuts) for frame in framer.feed(stream[a:b])] == whole


def lengths(frames: list[Framed]) -> list[int]:
    assert {frame.identifier for frame in frames} <= {LENGTH << 8}
    return [int.from_bytes(frame.body, "little") for frame in frames]


def test_the_number_of_values_is_reported_when_it_is_sure() -> None:
    framer = YarpMessages().framer()
    twelve, five = vector(TWELVE), vector(TWELVE[:5])
    assert lengths(framer.feed(twelve * 2 + five * 2)) == []
    assert lengths(framer.feed(twelve * 2)) == []
    assert lengths(framer.feed(twelve)) == [12]
    assert lengths(framer.feed(twelve * 600)) == [12] * 9
    assert framer.counters.refused == 0


def test_another_number_of_values_is_refused_and_reported() -> None:
    framer = YarpMessages(5, ((0, 0),)).framer()
    twelve, five = vector(TWELVE), vector(TWELVE[:5])
    assert [frame.identifier for frame in framer.feed(twelve * 2 + five * 2 + twelve * 2)] == [PLAIN << 8] * 2
    assert lengths(framer.feed(twelve)) == [12]
    assert framer.counters.refused == 5


@pytest.mark.parametrize("time", ["0", "0.0", "-5", "nan", "1e400", "99999999999999"])
def test_a_time_that_is_none_is_none(time: str) -> None:
    (frame,) = found(vector(TWELVE, f"D 5 {time}"))
    assert frame.identifier >> 8 == PLAIN


def test_nothing_can_be_sent() -> None:
    with pytest.raises(ValueError, match="only read"):
        YarpMessages().encode(0, b"tare")
