"""A master, and the hand of whoever answers it, at moments of our own."""

from __future__ import annotations

import numpy as np

from skinware_drivers.counters import BusCounters
from skinware_drivers.fields import Reply
from skinware_drivers.modbus import wire
from skinware_drivers.modbus.gateway import Guests
from skinware_drivers.modbus.master import Master, Timing
from skinware_drivers.modbus.registers import Registers, Wanted
from skinware_drivers.modbus.wire import Message

MS = 1_000_000
PERIOD, TIMEOUT, TURNAROUND = 20 * MS, 5 * MS, 1 * MS
ONE = (Registers(100, 4),)
TWO = (Registers(100, 4), Registers(300, 2))
UNITS = (Registers(100, 4, unit=1, patch=1), Registers(100, 4, unit=2, patch=2))


class Conversation:
    """A master and the hand of whoever answers."""

    def __init__(
        self, *blocks: Registers, over_tcp: bool = False, guests: Guests | None = None, **wanted: object
    ) -> None:
        self.now = 1000 * MS
        self.counters = BusCounters()
        self.over_tcp = over_tcp
        self.master = Master(
            Wanted(blocks, **wanted),  # type: ignore[arg-type]
            Timing(PERIOD, TIMEOUT, TURNAROUND),
            self.counters,
            over_tcp=over_tcp,
            name="bus",
            begun_ns=self.now,
            guests=guests,
        )

    def next_question(self) -> Message:
        """Let time pass until something is asked."""
        for _ in range(1000):
            if said := self.master.say(self.now):
                return self._message(said)
            assert self.master.due_ns is not None
            assert self.master.due_ns >= self.now or self.master.say(self.now) == b""
            self.now = max(self.now, self.master.due_ns)
        raise AssertionError("it asks no more")

    def answer(self, question: Message, data: bytes) -> list[Reply]:
        message = question._replace(data=data)
        self.hear(wire.tcp_frame(message) if self.over_tcp else wire.rtu_frame(message))
        return self.rows()

    def registers(self, question: Message, first: int = 0) -> list[Reply]:
        """The registers that it asks for: ascending numbers."""
        count = int.from_bytes(question.data[3:5], "big")
        return self.answer(question, reply_of(range(first, first + count)))

    def hear(self, chunk: bytes) -> None:
        self.now += MS // 10
        self.master.heard(chunk, self.now)

    def rows(self) -> list[Reply]:
        found = list(self.master.rows)
        self.master.rows.clear()
        return found

    def _message(self, said: bytes) -> Message:
        if not self.over_tcp:
            assert said == wire.rtu_frame(Message(said[0], said[1:-2]))
            return Message(said[0], said[1:-2])
        return Message(said[6], said[7:], int.from_bytes(said[:2], "big"))


def reply_of(values: object) -> bytes:
    data = np.array(list(values), ">u2").tobytes()  # type: ignore[call-overload]
    return bytes([3, len(data)]) + data


def address_of(question: Message) -> int:
    return int.from_bytes(question.data[1:3], "big")
