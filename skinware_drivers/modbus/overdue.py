"""Questions whose replies are overdue: which reply may be one of theirs, and how long to wait."""

from __future__ import annotations

from skinware.realtime import NS_PER_S
from skinware_drivers.modbus import wire
from skinware_drivers.modbus.wire import Message

_FARTHEST_NS = NS_PER_S
"""A reply that is not there so long after its timeout is lost."""
_FREE = 2
"""So many losses in a row are no sign of a slow link."""


class Overdue:
    """The overdue replies of a line. It reads no clock.

    Args:
        timeout_ns: from a question to its timeout.

    Attributes:
        drains: all replies are dropped until the line is silent: nothing says which questions they answer.
    """

    def __init__(self, timeout_ns: int) -> None:
        self._timeout_ns = self._pace_ns = timeout_ns
        self._longest_ns = max(_FARTHEST_NS, timeout_ns)
        self._kinds: dict[tuple[int, int, int], bytes | None] = {}  # None: several questions
        self._losses = 0
        self._oldest_ns = 0  # when the first of them was asked
        self.drains = False

    @property
    def is_none(self) -> bool:
        """Whether all replies came, and in time."""
        return not self._kinds and not self.drains and self._pace_ns == self._timeout_ns

    @property
    def wait_ns(self) -> int:
        """How long to wait for a reply after its timeout: as for others, and longer if nothing answers at all."""
        doubled = self._timeout_ns << min(max(self._losses - _FREE, 0), 20)
        return min(max(self._pace_ns, doubled), self._longest_ns)

    def lose(self, question: Message, asked_ns: int) -> None:
        """Remember a question that is given up."""
        if not self._kinds:
            self._oldest_ns = asked_ns
        kind = _kind_of(question)
        self._kinds[kind] = question.data if self._kinds.get(kind, question.data) == question.data else None
        self._losses += 1

    def confuses(self, question: Message) -> bool:
        """Return whether what looks like the reply to a question may answer an earlier one, about other registers."""
        return bool(self._kinds) and self._kinds.get(_kind_of(question), question.data) != question.data

    def drain(self, question: Message, asked_ns: int, time_ns: int) -> int:
        """Begin to drop all replies; return when those to all questions must have come, ns."""
        self.lose(question, asked_ns)
        self._keep_pace(time_ns - self._oldest_ns)
        self.drains = True
        return time_ns + min(asked_ns - self._oldest_ns, self._longest_ns) + self._timeout_ns

    def end(self) -> None:
        """Forget all questions: their replies came, or never will."""
        self._kinds.clear()
        self._losses, self.drains = 0, False

    def take(self) -> None:
        """Note a reply in time: replies keep the order of their questions."""
        self._pace_ns = max(self._pace_ns // 2, self._timeout_ns)
        self.end()

    def take_late(self, late_ns: int) -> None:
        """Note a reply that came so long after its timeout."""
        self._keep_pace(2 * late_ns)
        self.end()

    def _keep_pace(self, wait_ns: int) -> None:
        self._pace_ns = min(max(self._pace_ns, wait_ns), self._longest_ns)


def _kind_of(question: Message) -> tuple[int, int, int]:
    """Return what a reply shows of its question: unit, function and size."""
    return question.unit, question.data[0], wire.reply_size(question.data)
