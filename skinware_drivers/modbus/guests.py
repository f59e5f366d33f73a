"""Choose which question of other programs goes out on our line next, and refuse those that cannot be asked.

As :mod:`.master`, it reads no clock and knows no socket.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import deque

from skinware.realtime import NS_PER_S
from skinware_drivers.modbus import wire
from skinware_drivers.modbus.wire import Message
from skinware_drivers.running.guard import Backoff

_NO_SUCH_FUNCTION, _BAD_VALUE, _NO_WAY, _NO_ANSWER = 1, 3, 10, 11
_EVERY_UNIT = 0
_PATIENT_TIMES = 3
_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.25, 2.0


class Retry:
    """Space the attempts at something that fails again and again.

    Attributes:
        times: failures in a row.
        until_ns: when the next attempt may be made.
    """

    def __init__(self) -> None:
        self.times = 0
        self.until_ns = 0
        self._pauses = Backoff(_FIRST_PAUSE_S, _LONGEST_PAUSE_S)

    def failed(self, time_ns: int) -> None:
        self.times += 1
        if self.times >= _PATIENT_TIMES:
            self.until_ns = time_ns + round(self._pauses.next_s() * NS_PER_S)


class Guest(ABC):
    """A program that asks.

    Attributes:
        waiting: its questions in the order in which it asked, each with the number that the program gave it.
    """

    def __init__(self) -> None:
        self.waiting: deque[Message] = deque()

    @abstractmethod
    def reply(self, message: Message) -> None:
        """Send the program the reply to one of its questions."""


class Guests:
    """The programs that ask besides the master: one question goes out at a time, in each program's own order.

    Programs take turns. A write comes before a read, but not twice in a row. A unit that has left three questions of
    programs in a row unanswered is asked more and more rarely, because each silence costs the line two timeouts.

    Args:
        may_write: False: refuse every write.
        over_tcp: the line is a connection. On a serial line, unit 0 means every unit, and none answers.
    """

    def __init__(self, *, may_write: bool, over_tcp: bool) -> None:
        self._may_write, self._over_tcp = may_write, over_tcp
        self._guests: list[Guest] = []  # the one that was served longest ago comes first
        self._open: tuple[Guest, Message] | None = None
        self._has_written = False
        self._silent: dict[int, Retry] = {}

    @property
    def are_waiting(self) -> bool:
        return any(guest.waiting for guest in self._guests)

    def join(self, guest: Guest) -> None:
        self._guests.append(guest)

    def leave(self, guest: Guest) -> None:
        """Forget the guest's questions, and drop the reply to its open one when it comes."""
        guest.waiting.clear()
        self._guests.remove(guest)

    def ask(self, guest: Guest, question: Message) -> None:
        """Queue a question. One that cannot be asked is refused after the guest's earlier ones are answered."""
        guest.waiting.append(question)
        if self._open is None or self._open[0] is not guest:
            self._refuse_first(guest)

    def next(self, time_ns: int) -> Message | None:
        """Take the question that is to be asked now, if any; call ``answer`` when it is over."""
        while waiting := [guest for guest in self._guests if guest.waiting]:
            waiting.sort(key=lambda guest: wire.is_write(guest.waiting[0].data) is self._has_written)
            guest = waiting[0]
            self._guests.remove(guest)
            self._guests.append(guest)
            question = guest.waiting.popleft()
            retry = self._silent.get(question.unit)
            if retry is not None and time_ns < retry.until_ns:
                self._refuse(guest, question, _NO_ANSWER)
                self._refuse_first(guest)
                continue
            self._has_written = wire.is_write(question.data)
            self._open = guest, question
            return question
        return None

    def give_up(self) -> None:
        """Refuse the open question: its reply will not come."""
        if self._open is not None:
            (guest, question), self._open = self._open, None
            self._refuse(guest, question, _NO_ANSWER)
            self._refuse_first(guest)

    def answer(self, reply: bytes | None, time_ns: int) -> None:
        """End the open question, if there is one.

        Args:
            reply: what the unit answered, which may be an exception; None: nothing.
        """
        if self._open is None:
            return
        guest, question = self._open
        if reply is None:
            self._silent.setdefault(question.unit, Retry()).failed(time_ns)
            self.give_up()
            return
        self._open = None
        self._silent.pop(question.unit, None)
        if guest in self._guests:
            guest.reply(question._replace(data=reply))
        self._refuse_first(guest)

    def _refuse_first(self, guest: Guest) -> None:
        """Refuse the questions at the head of a guest's queue that cannot be asked."""
        while guest.waiting:
            question = guest.waiting[0]
            if not wire.is_known(question.data) or (wire.is_write(question.data) and not self._may_write):
                code = _NO_SUCH_FUNCTION
            elif not wire.is_question(question.data):
                code = _BAD_VALUE
            elif question.unit == _EVERY_UNIT and not self._over_tcp:
                code = _NO_WAY
            else:
                return
            self._refuse(guest, guest.waiting.popleft(), code)

    def _refuse(self, guest: Guest, question: Message, code: int) -> None:
        if guest in self._guests:
            guest.reply(question._replace(data=bytes([question.data[0] | wire.FAILED, code])))
