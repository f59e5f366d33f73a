"""Other programs that ask through our line: whose question is next, and what is refused.

Like :mod:`.master`, it reads no clock and knows no socket.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import deque

from skinware_drivers.modbus import wire
from skinware_drivers.modbus.trouble import Trouble
from skinware_drivers.modbus.wire import Message

_NO_SUCH_FUNCTION, _BAD_VALUE, _NO_WAY, _NO_ANSWER = 1, 3, 10, 11
_EVERY_UNIT = 0


class Guest(ABC):
    """A program that asks.

    Attributes:
        waiting: its questions, in the order in which it asked; each with its own number.
    """

    def __init__(self) -> None:
        self.waiting: deque[Message] = deque()

    @abstractmethod
    def tell(self, reply: Message) -> None:
        """Hand it the reply to a question."""


class Guests:
    """Who asks besides the master. One question at a time goes out, and each guest's in the order in which it asked.

    Guests take turns; who wants to write comes before who wants to read, but not twice in a row. A unit that does not
    answer guests three times in a row is asked more and more rarely: each silence costs the line two timeouts.

    Args:
        may_write: False: every write is refused.
        over_tcp: the line is a connection; else unit 0 is everybody, and nobody answers.
    """

    def __init__(self, *, may_write: bool, over_tcp: bool) -> None:
        self._may_write, self._over_tcp = may_write, over_tcp
        self._guests: list[Guest] = []  # who was served longest ago comes first
        self._asked: tuple[Guest, Message] | None = None
        self._has_written = False
        self._silent: dict[int, Trouble] = {}

    @property
    def are_waiting(self) -> bool:
        return any(guest.waiting for guest in self._guests)

    def come(self, guest: Guest) -> None:
        self._guests.append(guest)

    def leave(self, guest: Guest) -> None:
        """It is not any more: its questions are forgotten. The reply to the open one will be for nobody."""
        guest.waiting.clear()
        self._guests.remove(guest)

    def ask(self, guest: Guest, question: Message) -> None:
        """Take a question; what cannot be asked is refused when those that the guest asked before are answered."""
        guest.waiting.append(question)
        if self._asked is None or self._asked[0] is not guest:
            self._refuse_first(guest)

    def next(self, time_ns: int) -> Message | None:
        """The question that is to be asked now, if there is one: ``answer`` is called when it is over."""
        while (guest := self._next_guest()) is not None:
            self._guests.remove(guest)
            self._guests.append(guest)
            question = guest.waiting.popleft()
            trouble = self._silent.get(question.unit)
            if trouble is not None and time_ns < trouble.until_ns:
                self._refuse(guest, question, _NO_ANSWER)
                self._refuse_first(guest)
                continue
            self._has_written = wire.is_write(question.data)
            self._asked = guest, question
            return question
        return None

    def give_up(self) -> None:
        """Nobody will tell the reply to the open question."""
        if self._asked is not None:
            (guest, question), self._asked = self._asked, None
            self._refuse(guest, question, _NO_ANSWER)
            self._refuse_first(guest)

    def answer(self, reply: bytes | None, time_ns: int) -> None:
        """The open question is over, if there is one.

        Args:
            reply: what was answered, also an exception; None: nothing.
            time_ns: now.
        """
        if self._asked is None:
            return
        guest, question = self._asked
        if reply is None:
            self._silent.setdefault(question.unit, Trouble()).again(time_ns)
            self.give_up()
            return
        self._asked = None
        self._silent.pop(question.unit, None)
        if guest in self._guests:
            guest.tell(question._replace(data=reply))
        self._refuse_first(guest)

    def _next_guest(self) -> Guest | None:
        waiting = [guest for guest in self._guests if guest.waiting]
        writing = [guest for guest in waiting if wire.is_write(guest.waiting[0].data)]
        reading = [guest for guest in waiting if guest not in writing]
        first = reading + writing if self._has_written else writing + reading
        return first[0] if first else None

    def _refuse_first(self, guest: Guest) -> None:
        while guest.waiting and (code := self._refusal(guest.waiting[0])):
            self._refuse(guest, guest.waiting.popleft(), code)

    def _refusal(self, question: Message) -> int:
        if not wire.is_known(question.data) or (wire.is_write(question.data) and not self._may_write):
            return _NO_SUCH_FUNCTION
        if not wire.is_question(question.data):
            return _BAD_VALUE
        return _NO_WAY if question.unit == _EVERY_UNIT and not self._over_tcp else 0

    def _refuse(self, guest: Guest, question: Message, code: int) -> None:
        if guest in self._guests:
            guest.tell(question._replace(data=bytes([question.data[0] | wire.FAILED, code])))
