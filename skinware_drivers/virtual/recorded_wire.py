"""What went over a wire when it was recorded, again: with the times that it had, and answers after questions."""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

from skinware_drivers.bus import ERROR_FLAG, REMOTE_FLAG
from skinware_drivers.serial.ports import Port
from skinware_drivers.virtual.hand_clock import MonotonicTimer, Timer
from skinware_drivers.virtual.hardware import WireFrame

if TYPE_CHECKING:
    from skinware.recording import WireItem

log: logging.Logger = logging.getLogger("skinware.driver")

SENT = 1
"""Identifier of what was sent, where that is given too."""
Note = Callable[[int, int], None]
"""Takes the time stamp of what is given, and the time that it had when it was recorded."""
_PATIENCE_NS = 2_000_000_000
"""So long a question is waited for that was asked when it was recorded; the next one of its kind is not, after that."""
_EARLIEST_NS = 250_000_000
"""A question may come so long before its time."""
_ANSWERED_WITHIN_NS = 20_000_000
"""An answer comes so soon after its question, or sooner: one that came later was read late, or this device is slow."""


class RecordedWire:
    """The devices at the other end of a recorded wire; see :class:`.hardware.EmulatedHardware`.

    Args:
        items: what went over it, by time.
        first_ns: time of the recording, CLOCK_MONOTONIC of then, at which it begins.
        speed: 2.0: twice as fast.
        waits: for the questions that were asked when it was recorded.
        with_sent: what was sent is given too, with the identifier :data:`SENT`.
        name: that the end is logged under; empty: it is not.
        note: is told of all that is given.
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
        self._items, self._speed, self._waits, self._name, self._note = items, speed, waits, name, note
        self._with_sent = with_sent
        self._next: WireItem | None = None
        self._first_ns = first_ns
        self._begun_ns = self._given_ns = self._looked_ns = 0
        self._has_begun = self._is_over = False
        self._asked_ns = self._met_ns = 0
        self._is_unanswered = False
        self._asked: dict[int, deque[tuple[int, bytes]]] = {}
        self._answered: dict[int, bytes] = {}
        self._unasked: set[int] = set()
        self._counts = {"frames": 0, "bursts": 0, "commands": 0}

    def receive(self, identifier: int, payload: bytes, now_ns: int) -> None:
        self._counts["commands"] += 1
        self._asked_ns = now_ns
        self._asked.setdefault(identifier, deque(maxlen=1000)).append((now_ns, payload))
        self._unasked.discard(identifier)

    def next_due_ns(self) -> int | None:
        """When there is something, or a question was waited for long enough; None: at the end."""
        item = self._next
        if item is None or not self._has_begun:
            return None
        due_ns = self._due_ns(item)
        if not self._is_waited_for(item):
            return min(due_ns, self._asked_ns) if self._is_missed(item) else due_ns
        asked = self._questions(item)
        if not asked:
            return due_ns + _PATIENCE_NS
        is_early = asked[0][1] == item.data and asked[0][0] > self._looked_ns - _EARLIEST_NS
        return asked[0][0] if is_early else max(due_ns, asked[0][0])

    def emit(self, now_ns: int) -> list[WireFrame]:
        found: list[WireFrame] = []
        self._looked_ns = now_ns
        while (item := self._next) is not None and (self._due_ns(item) <= now_ns or self._is_hurried(item, now_ns)):
            if item.is_sent:
                if self._is_waited_for(item) and not self._is_asked(item, now_ns):
                    break
                if self._with_sent:
                    found.append(self._given(item, SENT))
            elif item.identifier is None or not item.identifier & (ERROR_FLAG | REMOTE_FLAG):
                found.append(self._given(item, item.identifier or 0))
                self._is_unanswered = False
            self._take_next()
            if item.is_sent:
                self._hasten(item)
        self._counts["frames"] += len(found)
        return found

    def skip(self, now_ns: int) -> int:
        """Begin; later, leave out what is due."""
        if self._has_begun:
            return len(self.emit(now_ns))
        self._has_begun, self._begun_ns = True, now_ns
        self._take_next()
        return 0

    @property
    def is_over(self) -> bool:
        return self._is_over

    def totals(self) -> dict[str, int]:
        return dict(self._counts)

    def _due_ns(self, item: WireItem) -> int:
        return self._begun_ns + round((item.time_ns - self._first_ns) / self._speed)

    def _given(self, item: WireItem, identifier: int) -> WireFrame:
        self._given_ns = max(self._given_ns, self._due_ns(item))
        if self._note is not None:
            self._note(self._given_ns, item.time_ns)
        return WireFrame(self._given_ns, identifier, item.data)

    def _is_waited_for(self, item: WireItem) -> bool:
        return self._waits and item.is_sent and _kind(item) not in self._unasked

    def _is_asked(self, item: WireItem, now_ns: int) -> bool:
        """Whether the question was asked, or is waited for no more; if it was asked late, all that follows is late."""
        due_ns, asked = self._due_ns(item), self._questions(item)
        while asked and asked[0][0] < due_ns - _EARLIEST_NS:
            asked.popleft()
            asked = self._questions(item)
        if asked:
            asked_ns, self._answered[_kind(item)] = asked.popleft()
            self._begun_ns += max(0, asked_ns - due_ns)
            self._met_ns, self._is_unanswered = now_ns, True
            return True
        if now_ns < due_ns + _PATIENCE_NS:
            return False
        self._begun_ns += _PATIENCE_NS
        self._unasked.add(_kind(item))
        return True

    def _is_hurried(self, item: WireItem, now_ns: int) -> bool:
        """Whether it has to come before its time; all that follows is earlier then.

        A driver that was held up when it was recorded asked late, and read an answer late that was there in time. This
        driver asks when it should, and would give up an answer that came as late as it was read.
        """
        if self._is_missed(item):
            self._begun_ns -= max(0, self._due_ns(item) - self._asked_ns)
            return True
        asked = self._questions(item) if self._is_waited_for(item) else deque()
        if not asked or asked[0][1] != item.data:
            return False
        asked_ns = asked[0][0]
        if asked_ns < now_ns - _EARLIEST_NS:
            return False
        self._begun_ns -= self._due_ns(item) - asked_ns
        return True

    def _is_missed(self, item: WireItem) -> bool:
        """Whether it is the answer to a question after which this driver has asked again already."""
        return not item.is_sent and self._is_unanswered and self._asked_ns > self._met_ns

    def _hasten(self, question: WireItem) -> None:
        """Where nothing was asked between a question and its answer, the driver of then had not given it up.

        However late the answer was read, by a driver that was held up: this one has not to wait for it for so long.
        """
        if self._is_unanswered and self._next is not None and not self._next.is_sent:
            later_ns = self._due_ns(self._next) - self._due_ns(question)
            self._begun_ns -= max(0, later_ns - _ANSWERED_WITHIN_NS)

    def _questions(self, item: WireItem) -> deque[tuple[int, bytes]]:
        """What was asked of its kind, when.

        One that was asked again before its answer came is none, unless this is where it was so when it was recorded.
        """
        asked, answered = self._asked.setdefault(_kind(item), deque(maxlen=1000)), self._answered.get(_kind(item))
        while asked and asked[0][1] == answered != item.data:
            asked.popleft()
        return asked

    def _take_next(self) -> None:
        self._next = next(self._items, None)
        if self._next is None and not self._is_over:
            self._is_over = True
            if self._name:
                log.warning("%s: the recording is over", self._name)


def _kind(item: WireItem) -> int:
    return item.identifier or 0


class RecordedPort(Port):
    """A port that gives what was read, read by read.

    Args:
        wire: that is read.
        clock: tells CLOCK_MONOTONIC ns.
        make_timer: makes what wakes the reader; another clock needs another timer.

    Attributes:
        read_ns: when what was given last was read.
    """

    def __init__(
        self,
        wire: RecordedWire,
        clock: Callable[[], int] = time.monotonic_ns,
        make_timer: Callable[[], Timer] = MonotonicTimer,
    ) -> None:
        self._wire, self._clock = wire, clock
        self._timer = make_timer()
        self._reads: deque[WireFrame] = deque()
        self.read_ns: int = 0
        wire.skip(self._clock())
        self._wake_when_due()

    def fileno(self) -> int:
        return self._timer.fileno()

    def read(self, size: int) -> bytes:  # noqa: ARG002
        frame = self.next_frame()
        return b"" if frame is None else frame.payload

    def next_frame(self) -> WireFrame | None:
        self._reads += self._wire.emit(self._clock())
        frame = self._reads.popleft() if self._reads else None
        self._wake_when_due()
        if frame is not None:
            self.read_ns = frame.time_ns
        return frame

    def write(self, data: bytes) -> int:
        self._wire.receive(0, data, self._clock())
        self._wake_when_due()
        return len(data)

    def wake(self) -> None:
        self._timer.wake_at(0)

    def close(self) -> None:
        self._timer.close()

    def _wake_when_due(self) -> None:
        self._timer.wake_at(0 if self._reads else self._wire.next_due_ns())
