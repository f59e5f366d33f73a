"""Who asks on a line: one question at a time, cycle after cycle; and who only overhears another master.

Both take bytes and give bytes and rows. They read no clock and know no port, so every moment can be tested.
"""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Hashable
from typing import NamedTuple

from skinware.realtime import NS_PER_S
from skinware_drivers.counters import BusCounters
from skinware_drivers.modbus import wire
from skinware_drivers.modbus.guests import Guests
from skinware_drivers.modbus.registers import Image, Read, Row, Wanted
from skinware_drivers.modbus.trouble import Trouble
from skinware_drivers.modbus.wire import Message

log: logging.Logger = logging.getLogger("skinware.driver")

ANSWERS = 0x700
"""Identifier of the frame that answers a driver's own question: this, and the unit. Its payload is the message."""
_BUSY_NS, _SILENCE_NS = NS_PER_S // 100, NS_PER_S // 500
_MOST_TRIES = 3
_MOST_COMMANDS = 64
_COMMAND, _GUEST = -1, -2
"""In the place of a read: a question of the driver's own, and one of another program."""
_MANUALS_COUNT_FROM = 30_001
_OVERHEARD_NS = NS_PER_S
"""Registers that another master has read longer ago are not joined with newer ones."""


class Timing(NamedTuple):
    """How a device wants to be asked, ns."""

    period_ns: int
    timeout_ns: int
    turnaround_ns: int
    """From a reply to the next question."""


class Talk(ABC):
    """What happens on one line.

    Attributes:
        rows: frames that have become whole; whoever takes them removes them.
    """

    def __init__(self) -> None:
        self.rows: deque[Row] = deque()

    @abstractmethod
    def heard(self, chunk: bytes, time_ns: int) -> None:
        """Take what has come.

        Raises:
            ValueError: it is no Modbus, and nothing that follows could be understood.
        """

    @abstractmethod
    def say(self, time_ns: int) -> bytes:
        """What is to be sent now; nothing: it is not the time."""

    @property
    @abstractmethod
    def due_ns(self) -> int | None:
        """When ``say`` has something to do; None: not before something is heard."""


class Open(NamedTuple):
    """A question that waits for its reply."""

    message: Message
    read: int  # below 0: another question
    until_ns: int
    tries: int


class Master(Talk):
    """Asks for the registers of a plan, cycle after cycle, at absolute deadlines, and in between what it is told.

    A unit that does not answer three times in a row is asked more and more rarely if there are others; so is a read
    that is answered by an exception.

    After a timeout nothing is asked until the late reply has come, or as much time again has passed. On a serial line,
    replies do not tell what they answer. Over TCP they have the number of their question; but there are servers which,
    when two questions are open, answer the first with the number of the second (pymodbus 3.16).

    Between two reads that are due, one question of other programs is asked. Those are never repeated.

    Args:
        wanted: what is asked for.
        timing: how.
        counters: of the bus.
        over_tcp: in a connection; else on a serial line.
        name: of the bus, for messages.
        begun_ns: now.
        guests: other programs.
    """

    def __init__(
        self,
        wanted: Wanted,
        timing: Timing,
        counters: BusCounters,
        *,
        over_tcp: bool,
        name: str,
        begun_ns: int,
        guests: Guests | None = None,
    ) -> None:
        super().__init__()
        self._timing, self._counters, self._name = timing, counters, name
        self._image = Image(wanted)
        self._reads = wanted.reads()
        self._questions = [Message(read.unit, read.question) for read in self._reads]
        self._tcp = wire.TcpMessages(counters.framing) if over_tcp else None
        self._rtu = None if over_tcp else wire.RtuMessages(counters.framing)
        self._commands: deque[Message] = deque()
        self._guests = guests
        self._was_guest = False
        self._troubles: dict[Hashable, Trouble] = {}
        self._open: Open | None = None
        self._late: Open | None = None
        self._has_told_late = False
        self._again: Open | None = None
        self._number = 0
        self._free_ns = self._cycle_ns = begun_ns
        self._deadline_ns = begun_ns
        self._cycle = -1
        self._next = len(self._reads)

    def command(self, message: Message) -> bool:
        """Have something asked before the next read; False: there are too many already."""
        if len(self._commands) < _MOST_COMMANDS:
            self._commands.append(message)
            return True
        return False

    @property
    def _has_guests(self) -> bool:
        return self._guests is not None and self._guests.are_waiting

    @property
    def _holds_back(self) -> bool:
        """Whether something has come that is no whole message."""
        found = self._tcp if self._rtu is None else self._rtu
        return found is not None and found.pending > 0

    @property
    def due_ns(self) -> int | None:
        """A timeout, the end of a pause, or the beginning of a cycle."""
        if self._open is not None:
            return self._open.until_ns
        if self._commands or self._again is not None or self._next < len(self._reads) or self._has_guests:
            return self._free_ns
        return max(self._free_ns, self._deadline_ns) if self._reads else None

    def say(self, time_ns: int) -> bytes:
        if self._open is not None and time_ns >= self._open.until_ns:
            self._give_up(self._open, time_ns)
        if self._open is not None or time_ns < self._free_ns:
            return b""
        self._end_lateness()
        if self._again is not None:
            again, self._again = self._again, None
            return self._ask(again.message, again.read, time_ns, again.tries)
        if self._commands:
            return self._ask(self._commands.popleft(), _COMMAND, time_ns)
        is_due = self._next < len(self._reads) or (time_ns >= self._deadline_ns and bool(self._reads))
        if self._guests is not None and not (is_due and self._was_guest):
            question = self._guests.next(time_ns)
            if question is not None:
                self._was_guest = True
                return self._ask(question, _GUEST, time_ns)
        self._was_guest = False
        if self._next == len(self._reads) and time_ns >= self._deadline_ns and self._reads:
            self._begin_cycle(time_ns)
        while self._next < len(self._reads):
            read, self._next = self._next, self._next + 1
            if self._cycle % self._reads[read].every == 0 and not self._is_left_alone(read, time_ns):
                return self._ask(self._questions[read], read, time_ns)
        return b""

    def heard(self, chunk: bytes, time_ns: int) -> None:
        """Look for the reply; see :meth:`Talk.heard`."""
        if self._tcp is not None:
            for message in self._tcp.feed(chunk):
                self._take(message, time_ns)
        elif self._rtu is not None:
            self._rtu.feed(chunk)
            self._look_on_line(self._rtu, time_ns)

    def _look_on_line(self, line: wire.RtuMessages, time_ns: int) -> None:
        if self._late is not None:
            found = line.reply_to(self._late.message.unit, self._late.message.data)
            if found is not None:
                self._take_late(self._late, found, time_ns)
        elif self._open is None:
            line.drop()
        else:
            asked, damaged = self._open, self._counters.framing.checksum_errors
            found = line.reply_to(asked.message.unit, asked.message.data)
            if found is not None:
                self._take(found, time_ns)
                line.drop()  # nobody may speak unasked
            elif self._counters.framing.checksum_errors > damaged:
                self._take_damaged(asked, time_ns)

    def _take(self, message: Message, time_ns: int) -> None:
        asked = self._open
        if asked is None or message.number != asked.message.number or message.unit != asked.message.unit:
            if self._late is not None and message.number == self._late.message.number:
                self._take_late(self._late, message, time_ns)
            else:
                self._counters.refused += 1
            return
        self._open = None
        self._free_ns = time_ns + self._timing.turnaround_ns
        self._troubles.pop(("unit", message.unit), None)
        code = wire.exception_of(message.data)
        if not wire.is_reply(asked.message.data, message.data):
            self._counters.framing.refused += 1
            self._answer_guest(asked, None, time_ns)
        elif asked.read == _GUEST:
            self._answer_guest(asked, message.data, time_ns)
        elif asked.read == _COMMAND:
            self.rows.append(Row(time_ns, ANSWERS | message.unit, message.data))
        elif code:
            self._take_exception(asked, code, time_ns)
        else:
            self._troubles.pop(("read", asked.read), None)
            read = self._reads[asked.read]
            self.rows += self._image.put(read.area, read.first, message.data[2:], time_ns, self._cycle_ns)

    def _take_late(self, asked: Open, message: Message, time_ns: int) -> None:
        """A reply after its timeout: the device lives, and what it says is shown."""
        self._late, self._free_ns = None, time_ns + self._timing.turnaround_ns
        self._counters.polls_late += 1
        self._troubles.pop(("unit", message.unit), None)
        if not self._has_told_late:
            self._has_told_late = True
            late_ms, timeout_ms = (time_ns - asked.until_ns) / 1e6, self._timing.timeout_ns / 1e6
            log.warning(
                "%s: unit %d answers %.3g ms after timeout_s = %.3g ms: make timeout_s longer; logged once",
                self._name,
                message.unit,
                late_ms,
                timeout_ms,
            )
        is_good = wire.is_reply(asked.message.data, message.data) and not wire.exception_of(message.data)
        if asked.read >= 0 and is_good:
            read = self._reads[asked.read]
            self.rows += self._image.put(read.area, read.first, message.data[2:], time_ns, self._cycle_ns)

    def _take_damaged(self, asked: Open, time_ns: int) -> None:
        """What came is as long as the reply, and is none: ask again once the line is silent."""
        self._open, self._free_ns = None, time_ns + self._timing.turnaround_ns + _SILENCE_NS
        if asked.read == _GUEST:
            self._answer_guest(asked, None, time_ns)
        elif asked.tries < _MOST_TRIES:
            self._again = asked

    def _answer_guest(self, asked: Open, reply: bytes | None, time_ns: int) -> None:
        if asked.read == _GUEST and self._guests is not None:
            self._guests.answer(reply, time_ns)

    def _take_exception(self, asked: Open, code: int, time_ns: int) -> None:
        self._counters.errors += 1
        if code in (wire.BUSY, wire.ACKNOWLEDGE) and asked.tries < _MOST_TRIES:
            self._again, self._free_ns = asked, time_ns + _BUSY_NS
            return
        trouble = self._troubles.setdefault(("read", asked.read), Trouble())
        if not trouble.times:
            read = self._reads[asked.read]
            what = f"unit {read.unit}, {read.count} registers from {read.address}"
            log.warning("%s: %s: %s%s", self._name, what, wire.exception_text(code), _advice(code, read))
        trouble.again(time_ns)

    def _give_up(self, asked: Open, time_ns: int) -> None:
        self._open = None
        self._counters.polls_unanswered += 1
        if asked.read >= 0:
            self._troubles.setdefault(("unit", asked.message.unit), Trouble()).again(time_ns)
        self._answer_guest(asked, None, time_ns)
        self._late, self._free_ns = asked, time_ns + self._timing.timeout_ns
        if self._rtu is not None:
            self._rtu.drop()

    def _end_lateness(self) -> None:
        """A reply that comes even later than this is taken for noise, or for the reply to the same question again."""
        if self._late is not None and self._rtu is not None:
            self._rtu.drop()
        self._late = None

    def _ask(self, message: Message, read: int, time_ns: int, tries: int = 0) -> bytes:
        until_ns = time_ns + self._timing.timeout_ns
        if self._tcp is not None:
            self._number = self._number % 0xFFFF + 1
        elif self._rtu is not None:
            self._rtu.drop()
        message = message._replace(number=self._number)
        self._open = Open(message, read, until_ns, tries + 1)
        self._counters.sent += 1
        return wire.rtu_frame(message) if self._tcp is None else wire.tcp_frame(message)

    def _begin_cycle(self, time_ns: int) -> None:
        period_ns = self._timing.period_ns
        missed = (time_ns - self._deadline_ns) // period_ns
        self._counters.polls_missed += missed
        self._deadline_ns += (missed + 1) * period_ns
        self._cycle_ns, self._next = time_ns, 0
        self._cycle += 1

    def _is_left_alone(self, read: int, time_ns: int) -> bool:
        """Whether it has failed again and again, and there are others."""
        unit = self._troubles.get(("unit", self._reads[read].unit))
        own = self._troubles.get(("read", read))
        if own is not None and time_ns < own.until_ns and len(self._reads) > 1:
            return True
        others = any(other.unit != self._reads[read].unit for other in self._reads)
        return others and unit is not None and time_ns < unit.until_ns


class Overheard:
    """Joins what another master reads.

    A master that asks what we would ask first begins its cycle there: what it has read before is then not joined with
    what comes after.

    Args:
        wanted: what is looked for in the replies.
    """

    def __init__(self, wanted: Wanted) -> None:
        self._image = Image(wanted)
        reads = wanted.reads()
        self._first = (reads[0].unit, reads[0].question) if reads else None
        self._cycle_ns = 0

    def take(self, asked: Message, registers: bytes, time_ns: int) -> list[Row]:
        """The frames that are whole now.

        Args:
            asked: the question.
            registers: bytes of what was replied.
            time_ns: when.
        """
        if (asked.unit, asked.data) == self._first:
            self._cycle_ns = time_ns
        since_ns = max(self._cycle_ns, time_ns - _OVERHEARD_NS)
        return self._image.overhear(asked.unit, asked.data, registers, time_ns, since_ns)


class Listener(Talk):
    """Pairs the questions of another master with their replies, on a line that it taps. It never says anything.

    A reply does not tell which registers it holds, so one whose question was not heard is not used.

    Args:
        wanted: what is looked for in the replies.
        counters: of the bus.
    """

    def __init__(self, wanted: Wanted, counters: BusCounters) -> None:
        super().__init__()
        self._counters = counters
        self._overheard = Overheard(wanted)
        self._line = wire.RtuMessages(counters.framing)
        self._asked: Message | None = None

    @property
    def due_ns(self) -> int | None:
        return None

    @property
    def pending(self) -> int:
        """Bytes that may still become part of a message."""
        return self._line.pending

    def say(self, time_ns: int) -> bytes:  # noqa: ARG002
        return b""

    def heard(self, chunk: bytes, time_ns: int) -> None:
        self._line.feed(chunk)
        while (message := self._line.next_of(self._asked)) is not None:
            asked = self._asked
            if asked is None or message.unit != asked.unit or not wire.is_reply(asked.data, message.data):
                self._asked = message
                continue
            self._asked = None
            if wire.exception_of(message.data):
                self._counters.errors += 1
            elif asked.data[0] in wire.READS:
                self.rows += self._overheard.take(asked, message.data[2:], time_ns)


def _advice(code: int, read: Read) -> str:
    if code == wire.NO_FUNCTION:
        other = wire.READ_INPUT if read.function == wire.READ_HOLDING else wire.READ_HOLDING
        return f"; it was asked with function {read.function}: try {other}"
    if code == wire.NO_REGISTERS and read.address >= _MANUALS_COUNT_FROM:
        return "; addresses count from 0: a manual's 30001 or 40001 is 0"
    return ""
