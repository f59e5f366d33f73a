"""Play the recorded traffic of a wire again, with its own times, and answers after this driver's questions."""

from __future__ import annotations

import logging
import math
import sys
from collections import deque
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

from skinware_drivers.bus import ERROR_FLAG, REMOTE_FLAG
from skinware_drivers.virtual.hardware import WireFrame

if TYPE_CHECKING:
    from skinware.recording import WireItem

log: logging.Logger = logging.getLogger("skinware.driver")

SENT = 1
"""Identifier of sent frames, where those are returned too."""
Note = Callable[[int, int], None]
"""Takes the time stamp of a returned frame, and its time in the recording."""
_PATIENCE_NS = 2_000_000_000
"""Longest wait for a question that was asked in the recording; later ones of its kind are not waited for then."""
_EARLIEST_NS = 250_000_000
"""Longest time by which a question may come early."""
_ANSWERED_WITHIN_NS = 20_000_000
"""Longest time from a question to its answer; a later one was read late, or this device is slow."""
_MOST_QUESTIONS = 1000
_AT_ONCE = 2048
"""Items that are returned together where nothing but room limits them."""


class Questions:
    """The questions of this driver, by identifier, and the recorded ones that they meet.

    Attributes:
        last_ns: when this driver asked last.
        is_unanswered: the answer to the last question that met a recorded one has not come.
    """

    def __init__(self, *, waits: bool) -> None:
        self._waits = waits
        self.last_ns = 0
        self.is_unanswered = False
        self._asked: dict[int, deque[tuple[int, bytes]]] = {}
        self._answered: dict[int, bytes] = {}
        self._given_up: set[int] = set()
        self._met_ns = 0

    def ask(self, identifier: int, payload: bytes, now_ns: int) -> None:
        self.last_ns = now_ns
        self._asked.setdefault(identifier, deque(maxlen=_MOST_QUESTIONS)).append((now_ns, payload))
        self._given_up.discard(identifier)

    def like(self, item: WireItem) -> deque[tuple[int, bytes]]:
        """Return time and payload of the questions with the identifier of a recorded one.

        A question that was asked again before its answer came counts only where the recording repeats it, too.
        """
        kind = item.identifier or 0
        asked, answered = self._asked.setdefault(kind, deque(maxlen=_MOST_QUESTIONS)), self._answered.get(kind)
        while asked and asked[0][1] == answered != item.data:
            asked.popleft()
        return asked

    def is_awaited(self, item: WireItem) -> bool:
        return self._waits and item.is_sent and (item.identifier or 0) not in self._given_up

    def meet(self, item: WireItem, now_ns: int) -> int:
        """Let the first question like a recorded one meet it; return when it was asked."""
        asked_ns, self._answered[item.identifier or 0] = self.like(item).popleft()
        self._met_ns, self.is_unanswered = now_ns, True
        return asked_ns

    def give_up(self, item: WireItem) -> None:
        self._given_up.add(item.identifier or 0)

    def is_missed(self, item: WireItem) -> bool:
        """Return whether an item is the answer to a question after which this driver has asked again already."""
        return not item.is_sent and self.is_unanswered and self.last_ns > self._met_ns


class RecordedWire:
    """The devices at the other end of a recorded wire; see :class:`.hardware.EmulatedHardware`.

    Args:
        first_ns: time of the recording, in its CLOCK_MONOTONIC, at which it begins.
        speed: 2.0: twice as fast; infinite: each item as soon as there is room for it, at the time of the caller.
        waits: for the questions that were asked in the recording.
        with_sent: return sent items too, with the identifier :data:`SENT`.
        name: for the log message at the end; empty: none.
    """

    def __init__(
        self,
        items: Iterator[WireItem],
        first_ns: int,
        *,
        speed: float = 1.0,
        waits: bool = True,
        with_sent: bool = False,
        name: str = "",
        note: Note | None = None,
    ) -> None:
        self._items, self._first_ns, self._speed = items, first_ns, speed
        self._with_sent, self._name, self._note = with_sent, name, note
        self._questions = Questions(waits=waits)
        self._next: WireItem | None = None
        self._begun_ns = self._given_ns = self._looked_ns = self._reached_ns = 0
        self._has_begun = self.is_over = False
        self._counts = {"frames": 0, "bursts": 0, "commands": 0}

    def receive(self, identifier: int, payload: bytes, now_ns: int) -> None:
        self._counts["commands"] += 1
        self._questions.ask(identifier, payload, now_ns)

    def next_due_ns(self) -> int | None:
        """Return when an item is due, or a question was waited for long enough; None: at the end."""
        item = self._next
        if item is None or not self._has_begun:
            return None
        due_ns = self._due_ns(item)
        if not self._questions.is_awaited(item):
            return min(due_ns, self._questions.last_ns) if self._questions.is_missed(item) else due_ns
        asked = self._questions.like(item)
        if not asked:
            return due_ns + _PATIENCE_NS
        is_early = asked[0][1] == item.data and asked[0][0] > self._looked_ns - _EARLIEST_NS
        return asked[0][0] if is_early else max(due_ns, asked[0][0])

    def emit(self, now_ns: int) -> list[WireFrame]:
        found: list[WireFrame] = []
        self._looked_ns = now_ns
        most = _AT_ONCE if math.isinf(self._speed) else sys.maxsize
        while (item := self._next) is not None and len(found) < most:
            if self._due_ns(item) > now_ns and not self._hurry(item, now_ns):
                break
            if item.is_sent:
                if self._questions.is_awaited(item) and not self._is_asked(item, now_ns):
                    break
                if self._with_sent:
                    found.append(self._given(item, SENT))
            elif item.identifier is None or not item.identifier & (ERROR_FLAG | REMOTE_FLAG):
                found.append(self._given(item, item.identifier or 0))
                self._questions.is_unanswered = False
            self._take_next()
            is_answer = self._next is not None and not self._next.is_sent and self._questions.is_unanswered
            if item.is_sent and self._next is not None and is_answer:
                # the recording driver waited for this answer, however late it read it; this one need not wait so long
                later_ns = self._due_ns(self._next) - self._due_ns(item)
                self._begun_ns -= max(0, later_ns - _ANSWERED_WITHIN_NS)
        self._counts["frames"] += len(found)
        return found

    def skip(self, now_ns: int) -> int:
        """Begin; later, leave out what is due: nothing, if items only wait for room."""
        if self._has_begun:
            return 0 if math.isinf(self._speed) else len(self.emit(now_ns))
        self._has_begun, self._begun_ns, self._looked_ns = True, now_ns, now_ns
        self._take_next()
        return 0

    def totals(self) -> dict[str, int]:
        return dict(self._counts)

    def _due_ns(self, item: WireItem) -> int:
        if math.isinf(self._speed):
            return self._reached_ns
        return self._begun_ns + round((item.time_ns - self._first_ns) / self._speed)

    def _given(self, item: WireItem, identifier: int) -> WireFrame:
        self._given_ns = max(self._given_ns, self._due_ns(item))
        if self._note is not None:
            self._note(self._given_ns, item.time_ns)
        return WireFrame(self._given_ns, identifier, item.data)

    def _is_asked(self, item: WireItem, now_ns: int) -> bool:
        """Return whether a question was asked, or is waited for no more; a late one delays all that follows."""
        due_ns, asked = self._due_ns(item), self._questions.like(item)
        while asked and asked[0][0] < due_ns - _EARLIEST_NS:
            asked.popleft()
            asked = self._questions.like(item)
        if asked:
            self._begun_ns += max(0, self._questions.meet(item, now_ns) - due_ns)
            return True
        if now_ns < due_ns + _PATIENCE_NS:
            return False
        self._begun_ns += _PATIENCE_NS
        self._questions.give_up(item)
        return True

    def _hurry(self, item: WireItem, now_ns: int) -> bool:
        """Return whether an item has to come before its time; then all that follows comes earlier, too.

        A driver that was held up in the recording asked late, and read late an answer that was there in time. This
        driver asks in time, and would give up an answer that came as late as it was read then.
        """
        if self._questions.is_missed(item):
            self._begun_ns -= max(0, self._due_ns(item) - self._questions.last_ns)
            return True
        asked = self._questions.like(item) if self._questions.is_awaited(item) else None
        if not asked or asked[0][1] != item.data or asked[0][0] < now_ns - _EARLIEST_NS:
            return False
        self._begun_ns -= self._due_ns(item) - asked[0][0]
        return True

    def _take_next(self) -> None:
        self._next, self._reached_ns = next(self._items, None), self._looked_ns
        if self._next is None and not self.is_over:
            self.is_over = True
            if self._name:
                log.warning("%s: the recording is over", self._name)
