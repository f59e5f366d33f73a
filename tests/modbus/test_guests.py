"""Other programs that ask through our line: whose turn it is, what is refused, and what becomes of silence."""

from __future__ import annotations

import itertools
import random
from typing import Any

import pytest

from skinware_drivers.modbus import wire
from skinware_drivers.modbus.gateway import Guest, Guests
from skinware_drivers.modbus.wire import Message
from tests.modbus.conversation import MS, ONE, TWO, UNITS, Conversation, address_of, reply_of

READ = wire.question_to_read(3, 7000, 2)
WRITE = bytes.fromhex("06 1388 0001")
WRITES = [
    bytes.fromhex(text)
    for text in (
        "05 0001 FF00",
        "06 1388 0001",
        "0F 0001 000A 02 CD01",
        "10 1388 0002 04 0001 0002",
        "16 0004 00F2 0025",
        "17 0003 0006 000E 0003 06 00FF 00FF 00FF",
    )
]
"""Of every kind, as in the specification."""


class Program(Guest):
    """Keeps the replies to it."""

    def __init__(self) -> None:
        super().__init__()
        self.told: list[Message] = []

    def reply(self, message: Message) -> None:
        self.told.append(message)


class Room:
    """A conversation with guests in it."""

    def __init__(self, *blocks: Any, count: int = 1, may_write: bool = True, over_tcp: bool = False) -> None:
        self.guests = Guests(may_write=may_write, over_tcp=over_tcp)
        self.talk = Conversation(*blocks, over_tcp=over_tcp, guests=self.guests)
        self.programs = [Program() for _ in range(count)]
        for program in self.programs:
            self.guests.join(program)

    def ask(self, data: bytes, *, who: int = 0, unit: int = 1, number: int = 1) -> None:
        self.guests.ask(self.programs[who], Message(unit, data, number))


@pytest.fixture(params=[False, True], ids=["rtu", "tcp"])
def over_tcp(request: pytest.FixtureRequest) -> bool:
    return bool(request.param)


def test_a_question_goes_between_two_reads_and_its_reply_to_whoever_asked(over_tcp: bool) -> None:
    room = Room(*TWO, count=2, over_tcp=over_tcp)
    first = room.talk.next_question()
    room.ask(READ, who=1, unit=9, number=77)
    room.talk.registers(first)
    asked = room.talk.next_question()
    assert (asked.unit, asked.data) == (9, READ)
    assert room.talk.answer(asked, reply_of([5, 6])) == []
    assert room.programs[1].told == [Message(9, reply_of([5, 6]), 77)]
    assert room.programs[0].told == []
    assert address_of(room.talk.next_question()) == 300


def test_a_flood_takes_every_second_turn_and_no_more() -> None:
    room = Room(*TWO, count=3)
    begun, asked = room.talk.now, []
    for _ in range(300):
        for who in range(3):
            while len(room.programs[who].waiting) < 5:
                room.ask(WRITE if who else READ, who=who)
        question = room.talk.next_question()
        asked.append(question.data)
        room.talk.answer(question, reply_of([0] * 4) if question.data[0] == 3 else question.data)
        if address_of(question) == 300:
            room.talk.rows()
    own = [data for data in asked if address_of(Message(1, data)) in (100, 300)]
    in_cycles = (room.talk.now - begun) / (20 * MS) * 2
    assert len(own) >= min(140, in_cycles - 2)
    assert len(room.programs[0].told) > 60
    assert len(room.programs[1].told) > 20
    assert len(room.programs[2].told) > 20


def test_own_reads_come_every_second_time_where_they_are_always_due() -> None:
    room = Room(*ONE)
    kinds = []
    for _ in range(40):
        room.ask(WRITE)
        question = room.talk.next_question()
        kinds.append(question.data[0])
        room.talk.now += 30 * MS if question.data[0] == 6 else 0  # the next cycle is due
        room.talk.answer(question, question.data if question.data[0] == 6 else reply_of(range(4)))
    assert all(one != other for one, other in itertools.pairwise(kinds))


def test_writes_come_first_but_not_twice_in_a_row() -> None:
    room = Room(count=3)
    room.ask(READ, who=0)
    for _ in range(3):
        room.ask(WRITE, who=1)
        room.ask(WRITE, who=2)
    asked = []
    for _ in range(7):
        question = room.talk.next_question()
        asked.append(question.data[0])
        room.talk.answer(question, question.data if question.data[0] == 6 else reply_of([1, 2]))
    assert asked == [6, 3, 6, 6, 6, 6, 6]


def test_a_guest_is_asked_for_in_its_own_order() -> None:
    room = Room()
    for number, data in enumerate([READ, WRITE, READ, WRITE]):
        room.ask(data, number=number)
    for _ in range(4):
        question = room.talk.next_question()
        room.talk.answer(question, question.data if question.data[0] == 6 else reply_of([1, 2]))
    assert [reply.number for reply in room.programs[0].told] == [0, 1, 2, 3]


@pytest.mark.parametrize("data", WRITES)
def test_a_gateway_that_may_not_write_refuses_every_write(data: bytes) -> None:
    room = Room(may_write=False)
    room.ask(data)
    assert room.programs[0].told == [Message(1, bytes([data[0] | 0x80, 1]), 1)]
    assert not room.guests.are_waiting
    allowed = Room(may_write=True)
    allowed.ask(data)
    assert allowed.talk.next_question().data == data


@pytest.mark.parametrize(
    ("data", "code"),
    [
        (b"\x2b\x0e\x01\x00", 1),
        (b"\x08\x00\x00\x12\x34", 1),
        (b"\x83\x00\x00\x00\x01", 1),
        (b"\x03\x00\x00\x00\x00", 3),
        (b"\x03\x00\x00\x00\x7e", 3),
        (b"\x03\x00\x00", 3),
        (b"\x03", 3),
        (b"\x01\x00\x00\x07\xd1", 3),
        (b"\x06\x00\x00\x00", 3),
        (b"\x10\x00\x00\x00\x02\x04\x00\x01", 3),
        (b"\x10\x00\x00\x00\x02\x03\x00\x01\x00\x02", 3),
        (b"\x10\x00\x00\x00\x00\x00", 3),
        (b"\x0f\x00\x00\x00\x09\x01\xff", 3),
        (b"\x17\x00\x00\x00\x01\x00\x00\x00\x01\x02\x00", 3),
    ],
)
def test_what_is_no_question_is_refused_at_once(data: bytes, code: int) -> None:
    room = Room()
    room.ask(data, number=9)
    assert room.programs[0].told == [Message(1, bytes([data[0] | 0x80, code]), 9)]


def test_unit_0_is_everybody_on_a_line() -> None:
    room = Room()
    room.ask(WRITE, unit=0)
    assert room.programs[0].told == [Message(0, b"\x86\x0a", 1)]
    over_tcp = Room(over_tcp=True)
    over_tcp.ask(WRITE, unit=0)
    assert over_tcp.talk.next_question().unit == 0


def test_an_exception_is_handed_on_and_not_counted(over_tcp: bool) -> None:
    room = Room(over_tcp=over_tcp)
    room.ask(READ)
    room.talk.answer(room.talk.next_question(), b"\x83\x06")
    assert room.programs[0].told == [Message(1, b"\x83\x06", 1)]
    assert room.talk.counters.errors == 0


def test_silence_is_told_and_a_silent_unit_does_not_hold_up_the_skin(over_tcp: bool) -> None:
    room = Room(*UNITS, over_tcp=over_tcp)
    begun, asked, own = room.talk.now, 0, 0
    while room.talk.now < begun + 2000 * MS:
        if not room.programs[0].waiting:
            room.ask(READ, unit=9)
        question = room.talk.next_question()
        if question.unit == 9:
            asked += 1
            continue  # it says nothing
        own += 1
        room.talk.registers(question)
    assert 4 <= asked <= 12
    assert own > 150
    assert {reply.data for reply in room.programs[0].told} == {b"\x83\x0b"}
    assert len(room.programs[0].told) > 50
    while (question := room.talk.next_question()).unit != 9:
        if not room.programs[0].waiting:
            room.ask(READ, unit=9)
        room.talk.registers(question)
    room.talk.answer(question, reply_of([1, 2]))
    assert room.programs[0].told[-1].data == reply_of([1, 2])


def test_a_damaged_reply_is_told_and_the_question_not_repeated() -> None:
    room = Room()
    room.ask(WRITE)
    room.talk.next_question()
    room.talk.hear(wire.rtu_frame(Message(1, WRITE))[:-1] + b"\0")
    assert room.programs[0].told == [Message(1, b"\x86\x0b", 1)]
    assert room.talk.master.due_ns is None
    assert room.talk.master.say(room.talk.now + 1000 * MS) == b""


def test_who_has_left_is_told_nothing(over_tcp: bool) -> None:
    room = Room(*TWO, count=2, over_tcp=over_tcp)
    room.ask(READ, who=0)
    room.ask(READ, who=0)
    question = room.talk.next_question()
    room.guests.leave(room.programs[0])
    room.talk.answer(question, reply_of([1, 2]))
    assert room.programs[0].told == []
    assert address_of(room.talk.next_question()) == 100
    assert not room.guests.are_waiting


def test_every_question_has_one_reply_whatever_is_answered(over_tcp: bool) -> None:
    rng = random.Random(7)
    room = Room(*UNITS, count=4, over_tcp=over_tcp)
    asked: dict[int, list[int]] = {who: [] for who in range(4)}
    for number in range(1500):
        who = rng.randrange(4)
        data = rng.choice([READ, *WRITES, rng.randbytes(rng.randint(1, 12))])
        room.ask(data, who=who, unit=rng.randrange(1, 4), number=number)
        asked[who].append(number)
        if rng.random() < 0.6:
            continue
        question = room.talk.next_question()
        what = rng.randrange(5)
        if what == 0 and not over_tcp:  # there, it would end the connection
            room.talk.hear(rng.randbytes(rng.randint(1, 30)))
        elif what == 1:
            room.talk.answer(question, bytes([question.data[0] | 0x80, rng.randint(1, 11)]))
        elif what < 4 and question.data[0] in (3, 23):
            count = int.from_bytes(question.data[3:5], "big")
            room.talk.answer(question, bytes([question.data[0], 2 * count]) + bytes(2 * count))
        elif what < 4:
            room.talk.answer(question, question.data[: wire.reply_size(question.data)])
    while room.guests.are_waiting:
        room.talk.next_question()
    room.talk.now += 1000 * MS
    room.talk.master.say(room.talk.now)  # which gives up the last one
    for who, program in enumerate(room.programs):
        assert [reply.number for reply in program.told] == asked[who]
