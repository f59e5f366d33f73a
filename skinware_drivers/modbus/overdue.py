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

    A question is mute once a later one was answered and then the line stayed silent: replies keep the order of their
    questions, so that its own will not come. Until it is answered again, its losses make no other reply doubtful.

    Args:
        timeout_ns: from a question to its timeout.

    Attributes:
        drains: all replies are dropped until the line is silent: nothing says which questions they answer.
    """

    def __init__(self, timeout_ns: int) -> None:
        self._timeout_ns = self._pace_ns = timeout_ns
        self._longest_ns = max(_FARTHEST_NS, timeout_ns)
        self._kinds: dict[tuple[int, int, int], bytes | None] = {}  # None: several questions
        self._lost: set[tuple[int, bytes]] = set()
        self._mute: set[tuple[int, bytes]] = set()
        self._losses = 0
        self._oldest_ns = 0  # when the first of them was asked
        self.drains = False

    @property
    def is_none(self) -> bool:
        """Whether all replies came, and in time."""
        return not (self._kinds or self._mute or self.drains) and self._pace_ns == self._timeout_ns

    @property
    def wait_ns(self) -> int:
        """How long to wait for a reply after its timeout: as for others, and longer if nothing answers at all."""
        doubled = self._timeout_ns << min(max(self._losses - _FREE, 0), 20)
        return min(max(self._pace_ns, doubled), self._longest_ns)

    def lose(self, question: Message, asked_ns: int, *, may_be_mute: bool) -> None:
        """Remember a question that is given up."""
        self._losses += 1
        if (question.unit, question.data) in self._mute:
            return
        if not self._kinds:
            self._oldest_ns = asked_ns
        kind = _kind_of(question)
        self._kinds[kind] = question.data if self._kinds.get(kind, question.data) == question.data else None
        if may_be_mute:
            self._lost.add((question.unit, question.data))

    def confuses(self, question: Message) -> bool:
        """Return whether what looks like the reply to a question may answer an earlier one, about other registers."""
        return bool(self._kinds) and self._kinds.get(_kind_of(question), question.data) != question.data

    def drain(self, asked_ns: int, time_ns: int) -> int:
        """Begin to drop all replies, the one to a question among them; return when all must have come, ns."""
        self._keep_pace(time_ns - self._oldest_ns)
        self.drains = True
        return time_ns + min(asked_ns - self._oldest_ns, self._longest_ns) + self._timeout_ns

    def hear(self) -> None:
        """Note that something came: a reply that is overdue, perhaps."""
        self._lost.clear()

    def end(self) -> None:
        """Forget all questions: their replies came, or never will."""
        if self.drains:
            self._mute |= self._lost
        self._kinds.clear()
        self._lost.clear()
        self._losses, self.drains = 0, False

    def take(self, question: Message) -> None:
        """Note a reply in time: replies keep the order of their questions."""
        self._pace_ns = max(self._pace_ns // 2, self._timeout_ns)
        self._mute.discard((question.unit, question.data))
        self.end()

    def take_late(self, question: Message, late_ns: int) -> None:
        """Note a reply that came so long after its timeout."""
        self._keep_pace(2 * late_ns)
        self._mute.discard((question.unit, question.data))
        self.end()

    def _keep_pace(self, wait_ns: int) -> None:
        self._pace_ns = min(max(self._pace_ns, wait_ns), self._longest_ns)


def _kind_of(question: Message) -> tuple[int, int, int]:
    """Return what a reply shows of its question: unit, function and size."""
    return question.unit, question.data[0], wire.reply_size(question.data)
