"""Frames that begin with their length: in step or lost, never in between; and frames that become several."""

from __future__ import annotations

import random
from functools import partial

import pytest

from skinware.errors import BusNotAvailable, ConfigurationError
from skinware_drivers.bus import FrameBatch
from skinware_drivers.serial.bus import SerialBus
from skinware_drivers.serial.framing import Field, Framed
from skinware_drivers.serial.framings import LengthFirst, Part, Split, by_length
from skinware_drivers.testing.waiting import wait_until
from tests.streams.peers import LOCAL, opened, server

FRAMING = LengthFirst(length=Field(0, 2, "big"), identifier=Field(2), answers={(1, 5), (1, 7), (8, 3)})
SHORT, LONG, EMPTY = b"\0\5\1ab", b"\0\7\1abcd", b"\0\3\x08"


def test_frames_of_known_lengths_are_found_however_they_are_cut() -> None:
    stream = SHORT + EMPTY + LONG + SHORT
    expected = [Framed(1, b"ab", 5), Framed(8, b"", 8), Framed(1, b"abcd", 15), Framed(1, b"ab", 20)]
    for size in range(1, len(stream) + 1):
        framer = FRAMING.framer()
        found = [frame for at in range(0, len(stream), size) for frame in framer.feed(stream[at : at + size])]
        assert found == expected
        assert (framer.pending, framer.counters.frame_bytes, framer.is_lost) == (0, 20, False)


@pytest.mark.parametrize("wrong", [b"\0\6\1abc", b"\0\5\2ab", b"\1\5\1ab", b"\0\0\0", b"a" + SHORT])
def test_after_what_is_no_answer_nothing_is_found_until_the_next_question(wrong: bytes) -> None:
    framer = FRAMING.framer()
    assert framer.feed(SHORT + wrong + SHORT) == [Framed(1, b"ab", 5)]
    assert framer.feed(SHORT) == []
    counters = framer.counters
    assert (counters.frames, counters.refused, counters.frame_bytes) == (1, 1, 5)
    framer.asked()
    assert [frame.body for frame in framer.feed(LONG)] == [b"abcd"]
    assert counters.bytes_in == counters.frame_bytes + counters.skipped_bytes


def test_half_an_answer_is_never_completed_by_the_next() -> None:
    framer = FRAMING.framer()
    assert framer.feed(LONG[:5]) == []
    framer.asked()
    assert framer.counters.skipped_bytes == 5
    assert framer.feed(LONG) == [Framed(1, b"abcd", 12)]


def test_three_questions_in_vain_are_the_end() -> None:
    framer = FRAMING.framer()
    for turn in range(3):
        assert not framer.is_lost
        framer.feed(b"\xff\xff\xff" + SHORT)
        framer.asked()
        assert framer.is_lost == (turn == 2)
    assert framer.feed(SHORT) == []
    assert framer.counters.refused == 3


def test_a_good_answer_forgives() -> None:
    framer = FRAMING.framer()
    for _ in range(9):
        framer.feed(LONG[:4])
        framer.asked()
        assert len(framer.feed(SHORT)) == 1
    assert not framer.is_lost


def test_a_question_between_whole_answers_changes_nothing() -> None:
    framer = FRAMING.framer()
    for _ in range(3):
        framer.asked()
        assert len(framer.feed(LONG)) == 1
    assert not framer.is_lost


def test_questions_have_any_length() -> None:
    assert FRAMING.encode(1, b"\1\2\3\4\5") == bytes.fromhex("00 08 01 01 02 03 04 05")
    with pytest.raises(ValueError, match="payload"):
        FRAMING.encode(1, bytes(0x10000))
    with pytest.raises(ConfigurationError, match="cannot have 2 bytes"):
        LengthFirst(length=Field(0, 2, "big"), identifier=Field(2), answers={(1, 2)})


def test_whatever_comes_every_byte_is_accounted_for() -> None:
    rng = random.Random(5)
    for _ in range(300):
        framer = Split(FRAMING, by_length({(1, 4): [Part(9, 0, 4)]})).framer()
        for _ in range(rng.randint(1, 9)):
            framer.feed(rng.choice([SHORT, LONG, EMPTY, LONG[:3], rng.randbytes(rng.randint(0, 9))]))
            if rng.random() < 0.3:
                framer.asked()
            counters = framer.counters
            assert counters.bytes_in == counters.frame_bytes + counters.skipped_bytes + framer.pending


def test_a_frame_becomes_its_parts() -> None:
    framer = Split(FRAMING, by_length({(1, 4): [Part(0x100, 2, 4), Part(0x101, 0, 2)]})).framer()
    assert framer.feed(SHORT + LONG) == [Framed(1, b"ab", 5), Framed(0x100, b"cd", 12), Framed(0x101, b"ab", 12)]
    assert (framer.counters.frames, framer.position, framer.pending) == (2, 12, 0)


def has_heard(bus: SerialBus, batch: FrameBatch, count: int) -> bool:
    bus.receive(batch, 0)
    return bus.counters.framing.bytes_in == count


def test_a_bus_that_stays_out_of_step_is_lost_and_begins_anew_when_it_is_opened_again() -> None:
    with server() as device, opened(f"tcp://{LOCAL}:{device.port}", FRAMING) as bus:
        batch = FrameBatch(100, 64)
        caller = device.answer()
        for turn in range(3):
            caller.sendall(b"\xff\xff\xff" + SHORT)
            wait_until(partial(has_heard, bus, batch, 8 * (turn + 1)))
            bus.send(1, b"\5")
        with pytest.raises(BusNotAvailable, match="out of step"):
            bus.receive(batch, 0)
        bus.close()
        bus.open()
        device.answer().sendall(LONG)
        wait_until(lambda: bus.receive(batch, 0) == 1)
