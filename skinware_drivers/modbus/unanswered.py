"""The questions of a line whose replies may still come, and which of them a reply answers."""

from __future__ import annotations

from typing import NamedTuple

from skinware.realtime import NS_PER_S
from skinware_drivers.modbus import wire
from skinware_drivers.modbus.wire import Message

_LONGEST_NS = NS_PER_S
"""Longest wait for a late reply after its timeout."""
_LONGEST_GAP_NS = NS_PER_S // 5
"""The same as long as nothing says that the link is slow."""
_FREE = 2
"""So many losses in a row are no sign of a slow link."""
_FORGOTTEN_NS = 60 * NS_PER_S
PROBE = -3
"""In place of the number of a read."""
_MOST_PROBES = 12
"""After so many in a row without a reply, the question itself is asked: some devices may answer no probe."""


class SentQuestion(NamedTuple):
    """A question as it was asked; its timeout is at ``until_ns``."""

    message: Message
    read: int  # below 0: no read of the schedule
    asked_ns: int
    until_ns: int
    tries: int


class Answered(NamedTuple):
    """The newest question that a reply may answer.

    Attributes:
        earliest_ns: when the earliest such question was asked.
        is_sure: no other registers are meant.
    """

    question: SentQuestion
    earliest_ns: int
    is_sure: bool


class Unanswered:
    """The questions without a reply, in order. It reads no clock.

    Replies keep the order of their questions: a reply shows that those before its question came, or never will. As long
    as one that looks like it may come, a question waits for the reply to a *probe*, a read of another size.

    Args:
        timeout_ns: from a question to its timeout.

    Attributes:
        open: the newest question before its timeout.
        number: of the newest question; over TCP only.
        drains: all replies are dropped until the line is silent: nothing says which questions they answer.
    """

    def __init__(self, timeout_ns: int) -> None:
        self._timeout_ns = self._pace_ns = timeout_ns
        self._longest_ns = max(_LONGEST_NS, timeout_ns)
        self._asked: list[SentQuestion] = []
        self.open: SentQuestion | None = None
        self.number = 0
        self.drains = False
        self._probes = 0  # in a row without a reply

    @property
    def is_usual(self) -> bool:
        """Whether all replies came in time, but for that to the open question."""
        only = [] if self.open is None else [self.open]
        return self._asked == only and not self.drains and self._pace_ns == self._timeout_ns

    @property
    def messages(self) -> list[Message]:
        return [question.message for question in self._asked]

    def inherit(self, before: Unanswered) -> None:
        """Take over the questions of the line before its schedule changed; nothing uses their replies."""
        self._asked = [question._replace(read=PROBE) for question in before._asked]
        self._keep_pace(before._pace_ns)
        self.number = before.number

    def ask(self, question: SentQuestion) -> None:
        oldest_ns = question.asked_ns - _FORGOTTEN_NS
        self._asked = [*(earlier for earlier in self._asked if earlier.asked_ns > oldest_ns), question]
        self.open = question

    def clear(self) -> None:
        self._asked, self.open, self.drains = [], None, False

    def give_up(self) -> int:
        """Note that the timeout of the open question passed; return how long a late reply is waited for, ns."""
        self.open = None
        doubled_ns = self._timeout_ns << min(max(len(self._asked) - _FREE, 0), 20)
        return max(self._pace_ns, min(doubled_ns, _LONGEST_GAP_NS))

    def end_open(self) -> None:
        """Forget the open question, whose reply came damaged."""
        self._asked.pop()
        self.open = None

    def probe_before(self, message: Message) -> Message | None:
        """Return the question that is to be answered before another one is asked; None: ask that one."""
        kind, kinds = _kind_of(message), [_kind_of(other) for other in self.messages]
        alike = [n for n, other in enumerate(self.messages) if kinds[n] == kind and other.data != message.data]
        self._probes = (self._probes + 1) % (_MOST_PROBES + 1) if alike else self._probes
        if not alike or not self._probes:
            return None
        before, later = set(kinds[: alike[-1] + 1]), self.messages[alike[-1] + 1 :]
        for count in range(1, wire.MOST_REGISTERS + 1):
            probe = Message(message.unit, wire.probe_of(message.data, count))
            others = {_kind_of(other) for other in later if other.data != probe.data}
            if _kind_of(probe) not in before | others:
                return probe
        return None

    def take(self, reply: Message, time_ns: int, *, is_numbered: bool, is_alone: bool) -> Answered | None:
        """Return the question that a reply answers; None: it answers none.

        Args:
            is_alone: no other reply came with it, of which one is old.
            is_numbered: a reply has the number of its question, but some servers, when two questions are open, answer
                the first with the number of the second (pymodbus 3.16).
        """
        fitting = [
            n
            for n, message in enumerate(self.messages)
            if message.unit == reply.unit and wire.is_reply(message.data, reply.data)
        ]
        if is_numbered:
            numbers = [self._asked[n].message.number for n in fitting]
            fitting = fitting[: numbers.index(reply.number) + 1] if reply.number in numbers else []
        if not fitting:
            return None
        question = self._asked[fitting[-1]]
        if question.read == PROBE:
            self._probes = 0
        if question is self.open:
            self.open = None
            self._pace_ns = max(self._pace_ns // 2, self._timeout_ns)
        else:
            self._keep_pace(2 * (time_ns - question.until_ns))
        same = all(self._asked[n].message.data == question.message.data for n in fitting)
        is_sure = is_alone and (same or bool(wire.exception_of(reply.data)))
        answered = Answered(question, self._asked[fitting[0]].asked_ns, is_sure)
        if answered.is_sure:
            del self._asked[: fitting[0] + 1]
        return answered

    def drain(self, time_ns: int) -> int:
        """Begin to drop all replies; return when all must have come, ns."""
        oldest_ns, newest_ns = self._asked[0].asked_ns, self._asked[-1].asked_ns
        self._keep_pace(time_ns - oldest_ns)
        self.open, self.drains = None, True
        return time_ns + min(newest_ns - oldest_ns, self._longest_ns) + self._timeout_ns

    def _keep_pace(self, wait_ns: int) -> None:
        self._pace_ns = min(max(self._pace_ns, wait_ns), self._longest_ns)


def _kind_of(message: Message) -> tuple[int, int, bytes]:
    """Return what a good reply shows of its question."""
    return message.unit, wire.reply_size(message.data), wire.echo_of(message.data)
