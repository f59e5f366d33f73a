"""Ask for registers on a line, one question at a time, cycle after cycle; or overhear another master.

Both take bytes and return bytes and rows. They read no clock and know no port, so that tests choose every moment.
"""

from __future__ import annotations

import logging
from collections import defaultdict, deque
from typing import NamedTuple

from skinware.realtime import NS_PER_S
from skinware_drivers.counters import BusCounters
from skinware_drivers.fields import Reply
from skinware_drivers.modbus import wire
from skinware_drivers.modbus.gateway import Guests
from skinware_drivers.modbus.registers import Image, Read, Wanted
from skinware_drivers.modbus.unanswered import PROBE, SentQuestion, Unanswered
from skinware_drivers.modbus.wire import Message
from skinware_drivers.running.guard import Backoff, pauses_of_device

log: logging.Logger = logging.getLogger("skinware.driver")

ANSWERS = 0x700
"""Identifier of the frame that answers a driver's own question: this plus the unit. Its payload is the message."""
_BUSY_NS, _SILENCE_NS = NS_PER_S // 100, NS_PER_S // 500
_OVERHEARD_NS = NS_PER_S
"""Registers that another master read longer ago are not joined with newer ones."""
_MOST_TRIES = 3
_MOST_COMMANDS = 64
_COMMAND, _GUEST = -1, -2
"""In place of the number of a read: a question of the driver's own, and one of another program."""
_OLD_NS = NS_PER_S
"""Registers in a reply that is later are not used."""
_MANUALS_COUNT_FROM = 30_001


class Timing(NamedTuple):
    """How a device is asked, ns."""

    period_ns: int
    timeout_ns: int
    turnaround_ns: int
    """From a reply to the next question."""


class Schedule:
    """The reads of a cycle in order, and a cycle in every period, at absolute deadlines.

    A unit that has not answered three times in a row is asked more and more rarely if there are others; so is a read
    that is answered by an exception.

    Attributes:
        cycle: number of the present cycle; -1 before the first.
        cycle_ns: when it began.
        retries: of units ("unit", unit) and reads ("read", position) that fail.
    """

    def __init__(self, reads: list[Read], period_ns: int, begun_ns: int) -> None:
        self.reads = reads
        self.questions = [Message(read.unit, read.question) for read in reads]
        self.cycle, self.cycle_ns, self.deadline_ns = -1, begun_ns, begun_ns
        self.next = len(reads)
        self.retries: defaultdict[tuple[str, int], Backoff] = defaultdict(pauses_of_device)
        self._period_ns = period_ns

    @property
    def is_within_cycle(self) -> bool:
        return self.next < len(self.reads)

    def is_due(self, time_ns: int) -> bool:
        return self.is_within_cycle or (time_ns >= self.deadline_ns and bool(self.reads))

    def take(self, time_ns: int, counters: BusCounters) -> int | None:
        """Return the position of the read to be asked now, if any; a new cycle begins when it is due."""
        if not self.is_within_cycle and self.is_due(time_ns):
            missed = (time_ns - self.deadline_ns) // self._period_ns
            counters.polls_missed += missed
            self.deadline_ns += (missed + 1) * self._period_ns
            self.cycle_ns, self.next = time_ns, 0
            self.cycle += 1
        while self.is_within_cycle:
            position, self.next = self.next, self.next + 1
            if self.cycle % self.reads[position].every == 0 and not self._rests(position, time_ns):
                return position
        return None

    def _rests(self, position: int, time_ns: int) -> bool:
        """Return whether a read has failed again and again, and there are others to ask for."""
        own, unit = self.retries.get(("read", position)), self.reads[position].unit
        if own is not None and time_ns < own.not_before_ns and len(self.reads) > 1:
            return True
        of_unit = self.retries.get(("unit", unit))
        others = any(other.unit != unit for other in self.reads)
        return others and of_unit is not None and time_ns < of_unit.not_before_ns


class Master:
    """Ask for the registers of a schedule, and in between for what the driver and other programs ask.

    After a timeout, nothing is asked until the late reply has come or as much time again has passed; more behind a slow
    link. :class:`Unanswered` says which question a reply answers; one that may answer others, too, is dropped, with
    those that follow it.

    Between two reads that are due, one question of other programs is asked. Those are never repeated.

    Args:
        over_tcp: the line is a connection, not a serial line.
        before: the questions that another master asked on this line until now.

    Attributes:
        unanswered: the questions whose replies may still come.
        rows: frames that have become whole; the reader removes them.
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
        before: Unanswered | None = None,
    ) -> None:
        self.rows: deque[Reply] = deque()
        self._timing, self._counters, self._name = timing, counters, name
        self._guests = guests or Guests(may_write=False, over_tcp=over_tcp)
        self._image = Image(wanted)
        self._schedule = Schedule(wanted.reads(), timing.period_ns, begun_ns)
        self._line = wire.TcpMessages(counters.framing) if over_tcp else wire.RtuMessages(counters.framing)
        self._commands: deque[Message] = deque()
        self.unanswered = Unanswered(timing.timeout_ns)
        self._again: SentQuestion | None = None
        self._free_ns = begun_ns
        if before is not None:
            self.unanswered.inherit(before)

    def command(self, message: Message) -> bool:
        """Queue a question of the driver's own before the next read; return False if too many wait already."""
        if len(self._commands) < _MOST_COMMANDS:
            self._commands.append(message)
            return True
        return False

    @property
    def pending(self) -> int:
        return self._line.pending

    @property
    def due_ns(self) -> int | None:
        """Time of a timeout, of the end of a pause, or of the beginning of a cycle."""
        if self.unanswered.open is not None:
            return self.unanswered.open.until_ns
        if self._commands or self._again is not None or self._schedule.is_within_cycle or self._guests.are_waiting:
            return self._free_ns
        return max(self._free_ns, self._schedule.deadline_ns) if self._schedule.reads else None

    def say(self, time_ns: int) -> bytes:
        """Return the bytes to be sent now; none if nothing is due."""
        asked = self.unanswered.open
        if asked is not None and time_ns >= asked.until_ns:
            self._give_up(asked, time_ns)
        if self.unanswered.open is not None or time_ns < self._free_ns:
            return b""
        if self.unanswered.drains:
            self.unanswered.clear()
        if self._again is not None:
            again, self._again = self._again, None
            return self._ask_surely(again.message, again.read, time_ns, again.tries)
        if self._commands:
            return self._ask_surely(self._commands.popleft(), _COMMAND, time_ns)
        question = self._guests.next(time_ns, is_read_due=self._schedule.is_due(time_ns))
        if question is not None:
            return self._ask_surely(question, _GUEST, time_ns)
        read = self._schedule.take(time_ns, self._counters)
        return b"" if read is None else self._ask_surely(self._schedule.questions[read], read, time_ns)

    def heard(self, chunk: bytes, time_ns: int) -> None:
        """Take bytes that have come, and look for replies.

        Raises:
            ValueError: they are no Modbus, and bytes that follow could not be understood either.
        """
        if isinstance(self._line, wire.TcpMessages):
            for message in self._line.feed(chunk):
                self._take(message, time_ns)
            return
        self._line.feed(chunk)
        damaged = self._counters.framing.checksum_errors
        while not self.unanswered.drains and (asked := self.unanswered.messages):
            found = self._line.reply_to(asked)
            if found is None:
                break
            self._take(found, time_ns, is_alone=len(asked) > 1 or not self._line.repeats(asked[0]))
        else:
            self._line.drop()  # no unit may speak unasked
        question = self.unanswered.open
        if question is not None and self._counters.framing.checksum_errors > damaged:
            # bytes as long as the reply, which are none: ask again, once the line is silent
            self.unanswered.end_open()
            self._free_ns = time_ns + self._timing.turnaround_ns + _SILENCE_NS
            if question.read == _GUEST:
                self._guests.answer(None, time_ns)
            elif question.read != PROBE and question.tries < _MOST_TRIES:
                self._again = question

    def _take(self, message: Message, time_ns: int, *, is_alone: bool = True) -> None:
        line = self.unanswered
        asked = line.open
        if line.drains:
            self._counters.refused += 1
            return
        is_numbered = isinstance(self._line, wire.TcpMessages)
        answered = line.take(message, time_ns, is_numbered=is_numbered, is_alone=is_alone)
        if answered is None:
            if asked is None or (message.number, message.unit) != (asked.message.number, asked.message.unit):
                self._counters.refused += 1
                return
            line.end_open()
            self._free_ns = time_ns + self._timing.turnaround_ns
            self._counters.framing.refused += 1
            if asked.read == _GUEST:
                self._guests.answer(None, time_ns)
            return
        question = answered.question
        self._schedule.retries.pop(("unit", message.unit), None)
        if not answered.is_sure:
            self._counters.refused += 1
            self._free_ns = line.drain(time_ns)
            if asked is not None and asked.read == _GUEST:
                self._guests.answer(None, time_ns)
            elif asked is not None and asked.read >= 0:
                self._again = asked
            return
        if line.open is None:
            self._free_ns = time_ns + self._timing.turnaround_ns
        if question is not asked:
            if time_ns > question.until_ns:  # else its schedule has ended
                self._count_late(question, time_ns)
            if question.read >= 0 and time_ns - question.until_ns <= _OLD_NS and not wire.exception_of(message.data):
                self._take_registers(question, answered.earliest_ns, message, time_ns)
        elif question.read == _GUEST:
            self._guests.answer(message.data, time_ns)
        elif question.read == _COMMAND:
            self.rows.append(Reply(time_ns, ANSWERS | message.unit, message.data))
        elif question.read >= 0 and (code := wire.exception_of(message.data)):
            self._take_exception(question, code, time_ns)
        elif question.read >= 0:
            self._schedule.retries.pop(("read", question.read), None)
            self._take_registers(question, answered.earliest_ns, message, time_ns)

    def _take_registers(self, asked: SentQuestion, earliest_ns: int, message: Message, time_ns: int) -> None:
        read, cycle_ns = self._schedule.reads[asked.read], self._schedule.cycle_ns
        time_ns = min(time_ns, asked.until_ns)  # the time of a value is at most a timeout after the value
        is_of_cycle = earliest_ns >= cycle_ns
        since_ns = cycle_ns if is_of_cycle else time_ns
        self.rows += self._image.put(read.area, read.first, message.data[2:], time_ns, since_ns)
        if not is_of_cycle:  # not to be joined with others of this cycle
            self._image.areas[read.area].heard_ns[read.first : read.first + read.count] = earliest_ns

    def _count_late(self, asked: SentQuestion, time_ns: int) -> None:
        self._counters.polls_late += 1
        if self._counters.polls_late == 1:
            log.warning(
                "%s: unit %d answers %.3g ms after timeout_s = %.3g ms, and others wait for it: make it longer, such as"
                " ?timeout_ms=%.0f; logged once",
                self._name,
                asked.message.unit,
                (time_ns - asked.until_ns) / 1e6,
                self._timing.timeout_ns / 1e6,
                2 * (time_ns - asked.asked_ns) / 1e6,
            )

    def _take_exception(self, asked: SentQuestion, code: int, time_ns: int) -> None:
        self._counters.errors += 1
        if code in (wire.BUSY, wire.ACKNOWLEDGE) and asked.tries < _MOST_TRIES:
            self._again, self._free_ns = asked, time_ns + _BUSY_NS
            return
        retry = self._schedule.retries["read", asked.read]
        if not retry.begun:
            read = self._schedule.reads[asked.read]
            what = f"unit {read.unit}, {read.count} registers from {read.address}"
            advice = ""
            if code == wire.NO_FUNCTION:
                other = wire.READ_INPUT if read.function == wire.READ_HOLDING else wire.READ_HOLDING
                advice = f"; it was asked with function {read.function}: try {other}"
            elif code == wire.NO_REGISTERS and read.address >= _MANUALS_COUNT_FROM:
                advice = "; addresses count from 0: a manual's 30001 or 40001 is 0"
            log.warning("%s: %s: %s%s", self._name, what, wire.exception_text(code), advice)
        retry.begin(time_ns)

    def _give_up(self, asked: SentQuestion, time_ns: int) -> None:
        self._counters.polls_unanswered += 1
        if asked.read >= 0 or asked.read == PROBE:
            self._schedule.retries["unit", asked.message.unit].begin(time_ns)
        if asked.read == PROBE and self._again is not None:
            asked, self._again = self._again, None
        if asked.read == _GUEST:
            self._guests.answer(None, time_ns)
        self._free_ns = time_ns + self.unanswered.give_up()
        self._drop_from_line()

    def _drop_from_line(self) -> None:
        """Drop half a message from a serial line, where no number says which question a reply answers."""
        if isinstance(self._line, wire.RtuMessages):
            self._line.drop()

    def _ask_surely(self, message: Message, read: int, time_ns: int, tries: int = 0) -> bytes:
        """Ask a question, or first the one whose reply shows that no other can be taken for the reply to this one."""
        probe = self.unanswered.probe_before(message)
        if probe is None:
            return self._ask(message, read, time_ns, tries)
        self._again = SentQuestion(message, read, time_ns, time_ns, tries)
        return self._ask(probe, PROBE, time_ns)

    def _ask(self, message: Message, read: int, time_ns: int, tries: int = 0) -> bytes:
        self._drop_from_line()
        over_tcp = isinstance(self._line, wire.TcpMessages)
        if over_tcp:
            self.unanswered.number = self.unanswered.number % 0xFFFF + 1
        message = message._replace(number=self.unanswered.number)
        self.unanswered.ask(SentQuestion(message, read, time_ns, time_ns + self._timing.timeout_ns, tries + 1))
        self._counters.sent += 1
        return wire.tcp_frame(message) if over_tcp else wire.rtu_frame(message)


class Listener:
    """Pair the questions of another master with their replies, on a line that it taps; it sends nothing.

    A reply does not say which registers it holds, so a reply is dropped if its question was not heard. When that master
    asks our first question, its cycle begins: replies from before are not joined with later ones.
    """

    def __init__(self, wanted: Wanted, counters: BusCounters) -> None:
        self.rows: deque[Reply] = deque()
        self._counters = counters
        self._image = Image(wanted)
        reads = wanted.reads()
        self._first = (reads[0].unit, reads[0].question) if reads else None
        self._cycle_ns = 0
        self._line = wire.RtuMessages(counters.framing)
        self._asked: Message | None = None

    due_ns = None
    """It never has something to say."""

    @property
    def pending(self) -> int:
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
            self._pair(asked, message, time_ns)

    def _pair(self, asked: Message, reply: Message, time_ns: int) -> None:
        if wire.exception_of(reply.data):
            self._counters.errors += 1
        elif asked.data[0] in wire.READS and wire.is_reply(asked.data, reply.data):
            if (asked.unit, asked.data) == self._first:
                self._cycle_ns = time_ns
            since_ns = max(self._cycle_ns, time_ns - _OVERHEARD_NS)
            self.rows += self._image.overhear(asked.unit, asked.data, reply.data[2:], time_ns, since_ns)


Talk = Master | Listener
"""The conversation on one line."""
