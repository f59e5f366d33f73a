"""When what is asked, and what becomes of the replies: moments that no real device can be made to show."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from skinware.errors import ConfigurationError
from skinware_drivers.counters import BusCounters
from skinware_drivers.fields import Reply
from skinware_drivers.modbus import wire
from skinware_drivers.modbus.master import ANSWERS, Listener, Master, Talk, Timing
from skinware_drivers.modbus.registers import Registers, Wanted
from skinware_drivers.modbus.wire import Message
from skinware_drivers.virtual.recorded import Conversation as RecordedConversation
from tests.modbus.conversation import (
    MS,
    ONE,
    PERIOD,
    TIMEOUT,
    TURNAROUND,
    TWO,
    UNITS,
    Conversation,
    address_of,
    reply_of,
)


@pytest.fixture(params=[False, True], ids=["rtu", "tcp"])
def over_tcp(request: pytest.FixtureRequest) -> bool:
    return bool(request.param)


# What is asked


@pytest.mark.parametrize(
    ("blocks", "more", "reads"),
    [
        ([(0, 9), (9, 96), (105, 80)], {}, [(0, 125), (125, 60)]),
        ([(0, 10), (30, 10)], {}, [(0, 10), (30, 10)]),
        ([(0, 10), (26, 10)], {}, [(0, 36)]),
        ([(0, 10), (26, 10)], {"largest_gap": 15}, [(0, 10), (26, 10)]),
        ([(26, 10), (0, 10)], {"largest_gap": 16}, [(0, 36)]),
        ([(0, 300)], {}, [(0, 125), (125, 125), (250, 50)]),
        ([(0, 300)], {"most": 100}, [(0, 100), (100, 100), (200, 100)]),
        ([(3000, 9), (3018, 96)], {"step": 2}, [(3000, 105)]),
        ([(3000, 1062)], {"step": 2}, [(3000 + 250 * n, 125) for n in range(8)] + [(5000, 62)]),
        ([(3000, 9), (3019, 9)], {"step": 2}, [(3000, 9), (3019, 9)]),
        ([(0, 10), (2, 3)], {}, [(0, 10)]),
    ],
)
def test_near_blocks_are_read_together_and_long_ones_in_pieces(
    blocks: list[tuple[int, int]], more: dict[str, Any], reads: list[tuple[int, int]]
) -> None:
    wanted = Wanted([Registers(*block) for block in blocks], **more)
    assert [(read.address, read.count) for read in wanted.reads()] == reads


def test_units_functions_and_rates_are_read_apart() -> None:
    blocks = [Registers(0, 4), Registers(4, 4, unit=2), Registers(8, 4, function=4), Registers(12, 4, every=3)]
    assert len(Wanted(blocks).reads()) == 4


@pytest.mark.parametrize(
    "block",
    [Registers(0, 3, dtype="f4"), Registers(0, 1, dtype="u8"), Registers(0, 0), Registers(0, 1, function=6)],
)
def test_blocks_that_cannot_be(block: Registers) -> None:
    with pytest.raises(ConfigurationError, match="registers 0 of unit 1"):
        block.check()


def test_a_cycle_and_its_deadlines(over_tcp: bool) -> None:
    talk = Conversation(*TWO, over_tcp=over_tcp)
    begun = talk.now
    for cycle in range(3):
        first = talk.next_question()
        assert talk.now == begun + cycle * PERIOD
        assert address_of(first) == 100
        [row] = talk.registers(first, 7)
        assert (row.identifier, row.payload) == (0, np.arange(7, 11, dtype=">u2").tobytes())
        asked = talk.now
        assert address_of(second := talk.next_question()) == 300
        assert talk.now == asked + TURNAROUND
        assert [row.identifier for row in talk.registers(second)] == [1]
    assert talk.counters.polls_missed == 0


def test_deadlines_that_cannot_be_kept_are_counted_and_not_made_up_for() -> None:
    talk = Conversation(*ONE)
    question = talk.next_question()
    talk.now += 4 * MS
    talk.registers(question)
    talk.now += 3 * PERIOD
    talk.next_question()
    assert talk.counters.polls_missed == 2


def test_every_nth_cycle() -> None:
    talk = Conversation(Registers(0, 4), Registers(500, 4, every=3))
    addresses = []
    for _ in range(8):
        question = talk.next_question()
        addresses.append(address_of(question))
        talk.registers(question)
    assert addresses == [0, 500, 0, 0, 0, 500, 0, 0]


# What a reply means


def test_a_block_in_several_reads_comes_when_all_of_one_cycle_are_there() -> None:
    talk = Conversation(Registers(0, 200))
    first = talk.next_question()
    assert talk.registers(first) == []
    [row] = talk.registers(talk.next_question(), 125)
    assert row.payload == np.arange(200, dtype=">u2").tobytes()
    assert row.time_ns < talk.now  # of the older part
    talk.registers(talk.next_question())
    talk.next_question()  # its reply is lost
    lost = talk.next_question()  # of the next cycle
    assert (address_of(lost), talk.counters.polls_unanswered) == (0, 1)
    assert talk.answer(lost, b"\x83\x04") == []
    assert talk.registers(talk.next_question(), 125) == []  # the first half is of another cycle


@pytest.mark.parametrize(
    ("byte_order", "word_order", "data"),
    [
        ("big", "big", "3F 80 00 01"),
        ("big", "little", "00 01 3F 80"),
        ("little", "big", "80 3F 01 00"),
        ("little", "little", "01 00 80 3F"),
    ],
)
def test_orders_of_bytes_and_words(byte_order: str, word_order: str, data: str) -> None:
    talk = Conversation(Registers(0, 2, dtype="f4"), byte_order=byte_order, word_order=word_order)
    [row] = talk.answer(talk.next_question(), b"\x03\x04" + bytes.fromhex(data))
    assert np.frombuffer(row.payload, ">u4").tolist() == [0x3F80_0001]


def test_a_reply_of_another_length_is_none(over_tcp: bool) -> None:
    talk = Conversation(*ONE, over_tcp=over_tcp)
    assert talk.answer(talk.next_question(), reply_of(range(3))) == []
    assert talk.next_question() is not None
    assert talk.counters.framing.refused == over_tcp
    assert talk.counters.polls_unanswered == (not over_tcp)


def test_a_late_reply_is_known_by_its_number() -> None:
    talk = Conversation(*TWO, over_tcp=True)
    late = talk.next_question()
    second = talk.next_question()
    assert talk.counters.polls_unanswered == 1
    assert [row.identifier for row in talk.registers(late)] == [0]
    assert talk.counters.polls_late == 1
    assert talk.registers(late) == []  # twice
    assert [row.identifier for row in talk.registers(second)] == [1]
    assert talk.registers(second) == []
    assert talk.counters.refused == 2


def test_a_late_reply_is_waited_for_and_shown(over_tcp: bool, caplog: pytest.LogCaptureFixture) -> None:
    talk = Conversation(Registers(100, 4), Registers(300, 4), over_tcp=over_tcp)  # replies look alike
    late = talk.next_question()
    asked = talk.now
    talk.now = asked + TIMEOUT
    assert talk.master.say(talk.now) == b""
    talk.now += TIMEOUT // 2
    [row] = talk.registers(late)
    assert (row.identifier, row.time_ns) == (0, asked + TIMEOUT)  # it may have been measured long before it came
    assert (talk.counters.polls_late, talk.counters.refused) == (1, 0)
    assert "after timeout_s = " in caplog.text
    second = talk.next_question()
    assert talk.now < asked + 2 * TIMEOUT
    assert address_of(second) == 300
    assert [row.identifier for row in talk.registers(second)] == [1]


class Far:
    """A device behind a delay: it answers every question in order, with values that are its address and up."""

    def __init__(self, talk: Conversation, delay: int) -> None:
        self.talk, self.delay = talk, delay
        self.waiting: list[tuple[int, Message]] = []
        self.silent: set[int] = set()  # addresses that it does not answer for
        self.shown: list[tuple[int, int]] = []

    def run(self, duration: int) -> None:
        """Let time pass."""
        talk = self.talk
        end = talk.now + duration
        while talk.now < end:
            due = talk.master.due_ns
            moments = [end, *([] if due is None else [due]), *(moment for moment, _ in self.waiting[:1])]
            talk.now = max(talk.now + 1, min(moments))
            if said := talk.master.say(talk.now):
                question = talk._message(said)
                if address_of(question) not in self.silent:
                    self.waiting.append((talk.now + self.delay, question))
            while self.waiting and self.waiting[0][0] <= talk.now:
                question = self.waiting.pop(0)[1]
                rows = talk.registers(question, address_of(question))
                self.shown += [(row.identifier, int.from_bytes(row.payload[:2], "big")) for row in rows]


ALIKE = tuple(Registers(100 * n, 4) for n in range(1, 6))


@pytest.mark.parametrize("delay", [4 * MS, 9 * MS, 11 * MS, 13 * MS, 26 * MS, 60 * MS, 300 * MS, 900 * MS])
def test_a_device_behind_a_slow_link_is_followed(over_tcp: bool, delay: int) -> None:
    far = Far(Conversation(*ALIKE, over_tcp=over_tcp), delay)
    far.run(2000 * MS + 10 * delay)
    assert all(100 * (identifier + 1) == first for identifier, first in far.shown)
    far.shown.clear()
    far.run(20 * delay)
    assert len(far.shown) >= 5
    assert all(100 * (identifier + 1) == first for identifier, first in far.shown)


@pytest.mark.parametrize("pause", [8 * MS, 14 * MS, 40 * MS, 333 * MS, 5000 * MS])
def test_replies_that_a_line_held_back_are_shown_for_no_other_registers(over_tcp: bool, pause: int) -> None:
    talk = Conversation(*ALIKE, over_tcp=over_tcp)
    far = Far(talk, MS)
    far.run(100 * MS)
    for _ in range(3):
        far.shown.clear()
        held, far.delay = far.delay, 2 * pause
        far.run(pause)
        far.waiting = [(talk.now + MS * (number + 1), question) for number, (_, question) in enumerate(far.waiting)]
        far.delay = held
        far.run(3500 * MS)
        assert all(100 * (identifier + 1) == first for identifier, first in far.shown)
        assert {identifier for identifier, _ in far.shown[-5:]} == set(range(5))


@pytest.mark.parametrize("silent", [{100}, {300}, {500}, {100, 200}, {100, 300, 500}])
def test_registers_that_fall_silent_hide_no_others(over_tcp: bool, silent: set[int]) -> None:
    far = Far(Conversation(*ALIKE, over_tcp=over_tcp), MS)
    far.run(100 * MS)
    far.silent = silent
    far.run(1000 * MS)
    for _ in range(5):
        far.shown.clear()
        far.run(1000 * MS)
        assert {first for _, first in far.shown} == {100, 200, 300, 400, 500} - silent
        assert all(100 * (identifier + 1) == first for identifier, first in far.shown)


@pytest.mark.parametrize("silence", [20 * MS, 333 * MS, 1000 * MS])
def test_a_line_that_was_silent_is_shown_again_soon(over_tcp: bool, silence: int) -> None:
    for phase in range(3):
        far = Far(Conversation(*ALIKE, over_tcp=over_tcp), MS)
        far.run((100 + 7 * phase) * MS)
        far.silent = {100, 200, 300, 400, 500}
        far.run(silence)
        far.silent, far.shown = set(), []
        far.run(250 * MS)
        assert {identifier for identifier, _ in far.shown} == set(range(5))
        assert all(100 * (identifier + 1) == first for identifier, first in far.shown)


@pytest.mark.parametrize("answer", ["nothing", "an exception"])
def test_devices_that_answer_no_probe_are_shown_again(over_tcp: bool, answer: str) -> None:
    talk = Conversation(*ALIKE, over_tcp=over_tcp)
    for _ in range(3):
        talk.next_question()
    end, shown = talk.now + 5000 * MS, set[int]()
    while talk.now < end:
        question = talk.next_question()
        if question.data[-1] == 4:
            shown |= {row.identifier for row in talk.registers(question, address_of(question))}
        elif answer == "an exception":
            talk.answer(question, b"\x83\x02")
    assert shown == set(range(5))


def test_a_late_reply_is_not_joined_with_registers_of_a_later_cycle() -> None:
    talk = Conversation(Registers(0, 200), over_tcp=True)
    talk.registers(talk.next_question())
    late = talk.next_question()
    first = talk.next_question()
    while address_of(first) != 0:
        first = talk.next_question()
    talk.registers(first)
    assert talk.registers(late, 125) == []


def test_replies_to_questions_from_before_the_schedule_changed_are_shown_for_no_other_registers(over_tcp: bool) -> None:
    talk = Conversation(*ALIKE, over_tcp=over_tcp)
    before, late = talk.master.unanswered, talk.next_question()
    talk.master = Master(
        Wanted(ALIKE[1:]),
        Timing(PERIOD, TIMEOUT, TURNAROUND),
        talk.counters,
        over_tcp=over_tcp,
        name="bus",
        begun_ns=talk.now,
        before=before,
    )
    probe = talk.next_question()
    assert talk.registers(late) == []
    assert talk.counters.polls_late == 0
    assert talk.registers(probe) == []
    question = talk.next_question()
    assert address_of(question) == 200
    assert [row.identifier for row in talk.registers(question)] == [0]


def test_without_a_late_reply_it_goes_on_after_a_while() -> None:
    talk = Conversation(*TWO)
    talk.next_question()
    asked = talk.now
    assert address_of(talk.next_question()) == 300
    assert talk.now == asked + 2 * TIMEOUT


def test_half_a_reply_is_dropped_with_its_question() -> None:
    talk = Conversation(*TWO)
    half = wire.rtu_frame(Message(1, reply_of(range(4))))[:7]
    talk.next_question()
    talk.hear(half)
    second = talk.next_question()
    assert [row.identifier for row in talk.registers(second)] == [1]
    framing = talk.counters.framing
    assert framing.skipped_bytes == len(half)
    assert framing.bytes_in == framing.frame_bytes + framing.skipped_bytes


def test_a_reply_with_a_wrong_checksum_is_asked_for_again_up_to_three_times() -> None:
    talk = Conversation(*TWO)
    damaged = bytearray(wire.rtu_frame(Message(1, reply_of(range(4)))))
    damaged[5] ^= 1
    begun = talk.now
    for _ in range(3):
        assert address_of(talk.next_question()) == 100
        talk.hear(bytes(damaged))
        assert talk.rows() == []
    assert [row.identifier for row in talk.registers(talk.next_question())] == [1]
    assert (talk.counters.framing.checksum_errors, talk.counters.polls_unanswered) == (3, 0)
    assert talk.now < begun + PERIOD


def test_what_nobody_asked_for_is_dropped() -> None:
    talk = Conversation(*ONE)
    talk.registers(talk.next_question())
    talk.hear(wire.rtu_frame(Message(1, reply_of(range(4)))))
    assert talk.rows() == []
    assert len(talk.registers(talk.next_question())) == 1


@pytest.mark.parametrize("arrived", [3, 8, 13])
def test_of_two_replies_to_one_question_none_is_shown(arrived: int) -> None:
    """One of them is old; the second has come in part, or as a whole."""
    talk = Conversation(*ONE)
    question = talk.next_question()
    old, present = (wire.rtu_frame(Message(1, reply_of(range(first, first + 4)))) for first in (0, 50))
    talk.hear(old + present[:arrived])
    talk.hear(present[arrived:])
    assert talk.rows() == []
    assert talk.counters.refused == 1
    assert talk.next_question() == question
    assert [row.payload[1] for row in talk.registers(question, 51)] == [51]


def test_a_byte_of_noise_behind_a_reply_costs_nothing() -> None:
    talk = Conversation(*ONE)
    talk.next_question()
    talk.hear(wire.rtu_frame(Message(1, reply_of(range(4)))) + b"\x01\x03")
    assert len(talk.rows()) == 1


# Exceptions


@pytest.mark.parametrize("code", [wire.ACKNOWLEDGE, wire.BUSY])
def test_a_busy_device_is_asked_again_soon(code: int, over_tcp: bool) -> None:
    talk = Conversation(*TWO, over_tcp=over_tcp)
    for _ in range(2):
        question = talk.next_question()
        assert address_of(question) == 100
        talk.answer(question, bytes([0x83, code]))
    assert len(talk.registers(talk.next_question())) == 1
    assert talk.counters.errors == 2


def test_a_device_that_is_always_busy_does_not_hold_up_the_rest() -> None:
    talk = Conversation(*TWO)
    asked = []
    for _ in range(12):
        question = talk.next_question()
        asked.append(address_of(question))
        if asked[-1] == 100:
            talk.answer(question, b"\x83\x06")
        else:
            talk.registers(question)
    assert asked[:4] == [100, 100, 100, 300]
    assert asked.count(300) >= 3


def test_registers_that_are_not_there_are_told_once_and_asked_for_rarely(caplog: pytest.LogCaptureFixture) -> None:
    talk = Conversation(*TWO)
    begun, asked = talk.now, 0
    while talk.now < begun + 100 * PERIOD:
        question = talk.next_question()
        if address_of(question) == 100:
            asked += 1
            talk.answer(question, b"\x83\x02")
        else:
            talk.registers(question)
    assert 4 <= asked <= 9
    assert caplog.text.count("no such registers") == 1
    assert "4 registers from 100" in caplog.text


@pytest.mark.parametrize(
    ("block", "code", "told"),
    [
        (Registers(100, 4), 1, "it was asked with function 3: try 4"),
        (Registers(100, 4, function=4), 1, "it was asked with function 4: try 3"),
        (Registers(40001, 4), 2, "a manual's 30001 or 40001 is 0"),
    ],
)
def test_what_is_usually_the_reason_of_an_exception_is_told(
    caplog: pytest.LogCaptureFixture, block: Registers, code: int, told: str
) -> None:
    talk = Conversation(block)
    question = talk.next_question()
    talk.answer(question, bytes([question.data[0] | 0x80, code]))
    assert told in caplog.text


def test_a_dead_unit_is_asked_more_and_more_rarely_and_comes_back() -> None:
    talk = Conversation(*UNITS)
    begun, asked = talk.now, {1: 0, 2: 0}
    while talk.now < begun + 200 * PERIOD:
        question = talk.next_question()
        asked[question.unit] += 1
        if question.unit == 1:
            talk.registers(question)
    assert 4 <= asked[2] <= 12
    assert asked[1] > 190
    while (question := talk.next_question()).unit != 2:
        talk.registers(question)
    talk.registers(question)
    talk.registers(talk.next_question())
    assert talk.next_question().unit == 2


def test_a_unit_that_is_alone_is_asked_again_within_a_second() -> None:
    talk = Conversation(*ONE)
    for _ in range(20):
        begun = talk.now
        talk.next_question()
        assert talk.now <= begun + 1000 * MS + TIMEOUT + PERIOD


# Questions of the driver's own


def test_a_question_of_the_driver_comes_between_two_reads(over_tcp: bool) -> None:
    talk = Conversation(*TWO, over_tcp=over_tcp)
    first = talk.next_question()
    write = Message(1, bytes.fromhex("06 0010 1234"))
    assert talk.master.command(write)
    talk.registers(first)
    question = talk.next_question()
    assert (question.unit, question.data) == (1, write.data)
    assert [(row.identifier, row.payload) for row in talk.answer(question, write.data)] == [(ANSWERS | 1, write.data)]
    assert address_of(talk.next_question()) == 300


def test_there_is_an_end_to_questions() -> None:
    talk = Conversation(*ONE)
    taken = [talk.master.command(Message(1, b"\x06\0\0\0\0")) for _ in range(100)]
    assert taken == [True] * 64 + [False] * 36


# Listening


def overhear(*blocks: Registers) -> tuple[Listener, BusCounters]:
    counters = BusCounters()
    return Listener(Wanted(blocks), counters), counters


def said(talk: Talk, data: bytes, time_ns: int = 1000 * MS) -> list[Reply]:
    talk.heard(data, time_ns)
    rows = list(talk.rows)
    talk.rows.clear()
    return rows


def exchange(unit: int, address: int, values: range) -> bytes:
    question = wire.question_to_read(3, address, len(values))
    return wire.rtu_frame(Message(unit, question)) + wire.rtu_frame(Message(unit, reply_of(values)))


@pytest.mark.parametrize("size", [1, 3, 1000])
def test_another_master_is_overheard(size: int) -> None:
    listener, counters = overhear(Registers(102, 4), Registers(200, 2, unit=2, patch=2))
    stream = exchange(1, 100, range(10)) + exchange(2, 200, range(50, 52)) + exchange(3, 100, range(10))
    rows = [row for at in range(0, len(stream), size) for row in said(listener, stream[at : at + size])]
    assert [(row.identifier, row.payload) for row in rows] == [
        (0, np.arange(2, 6, dtype=">u2").tobytes()),
        (1, np.arange(50, 52, dtype=">u2").tobytes()),
    ]
    assert counters.framing.skipped_bytes == 0
    assert listener.say(0) == b""
    assert listener.due_ns is None


def test_replies_whose_question_was_not_heard_are_not_used() -> None:
    listener, counters = overhear(Registers(100, 4))
    reply = wire.rtu_frame(Message(1, reply_of(range(4))))
    assert said(listener, reply + reply) == []
    assert len(said(listener, exchange(1, 100, range(4)))) == 1
    assert counters.framing.skipped_bytes == 2 * len(reply)


def test_a_reply_that_is_missing_or_damaged_is_not_taken_from_the_next() -> None:
    listener, _ = overhear(Registers(100, 4), Registers(300, 4))
    question = wire.rtu_frame(Message(1, wire.question_to_read(3, 100, 4)))
    assert [row.identifier for row in said(listener, question + exchange(1, 300, range(4)))] == [1]
    damaged = bytearray(exchange(1, 100, range(4)))
    damaged[-4] ^= 1
    assert said(listener, bytes(damaged)) == []
    assert [row.identifier for row in said(listener, exchange(1, 100, range(4)), 2000 * MS)] == [0]


def test_writes_and_exceptions_of_the_controller_go_by() -> None:
    listener, counters = overhear(Registers(100, 4))
    write = wire.rtu_frame(Message(1, bytes.fromhex("06 0010 1234")))
    many = wire.rtu_frame(Message(1, bytes.fromhex("10 0FA0 0002 04 0001 0002")))
    done = wire.rtu_frame(Message(1, bytes.fromhex("10 0FA0 0002")))
    refused = wire.rtu_frame(Message(1, wire.question_to_read(3, 100, 4))) + wire.rtu_frame(Message(1, b"\x83\x04"))
    stream = write + write + many + done + refused + exchange(1, 100, range(4))
    assert [row.identifier for row in said(listener, stream)] == [0]
    assert (counters.errors, counters.framing.skipped_bytes) == (1, 0)


def test_a_block_of_two_reads_is_joined_only_within_a_second() -> None:
    listener, _ = overhear(Registers(100, 8))
    assert said(listener, exchange(1, 100, range(4)), 1000 * MS) == []
    assert len(said(listener, exchange(1, 104, range(4, 8)), 1500 * MS)) == 1
    assert said(listener, exchange(1, 100, range(4)), 3000 * MS) == []
    assert said(listener, exchange(1, 104, range(4, 8)), 5000 * MS) == []


def test_what_is_overheard_of_two_cycles_is_not_joined() -> None:
    listener, _ = overhear(Registers(0, 200))
    first, second = exchange(1, 0, range(125)), exchange(1, 125, range(75))
    assert said(listener, second, 1000 * MS) == []  # it listens from the middle of a cycle on
    assert said(listener, first, 1020 * MS) == []
    [row] = said(listener, second, 1021 * MS)
    assert row.time_ns == 1020 * MS
    assert said(listener, first, 1040 * MS) == []
    assert len(said(listener, second, 1041 * MS)) == 1


@pytest.mark.parametrize("begins", [0, 1, 2])
def test_a_recording_that_begins_in_the_middle_of_a_cycle_is_not_torn(begins: int, over_tcp: bool) -> None:
    """Or that lost a reply: no frame has registers of two cycles."""
    wanted = Wanted([Registers(0, 300)])
    recorded = RecordedConversation(wanted, BusCounters(), over_tcp=over_tcp)
    asked = [(read.address, read.count) for read in wanted.reads()]
    everything = [(cycle, *one) for cycle in range(1, 12) for one in asked][begins:]
    lost = {(4, 125), (8, 250)}
    found = []
    for number, (cycle, address, count) in enumerate(everything):
        reply = reply_of([cycle] * count)
        for is_sent, data in ((True, wire.question_to_read(3, address, count)), (False, reply)):
            if not is_sent and (cycle, address) in lost:
                continue
            message = Message(1, data, number + 1)
            frame = wire.tcp_frame(message) if over_tcp else wire.rtu_frame(message)
            recorded.take(frame, (1000 + 20 * cycle + address // 125) * MS, is_sent=is_sent)
        found += [np.frombuffer(row.payload, ">u2") for row in recorded.rows]
        recorded.rows.clear()
    assert all((row == row[0]).all() for row in found)
    assert [int(row[0]) for row in found] == [cycle for cycle in range(1 + bool(begins), 12) if cycle not in (4, 8)]
