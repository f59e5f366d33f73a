"""Keeps what others send from ending anything here: it is counted, and reported once for each kind of message."""

from __future__ import annotations

import threading
from collections.abc import Callable

from skinware.bridge.link import Question
from skinware.errors import BridgeError, SkinwareError
from skinware.limits import LIMITS

_LONGEST = 160
_MOST_KINDS = 256


class Guard:
    """Counts messages that cannot be taken.

    Args:
        report: gets (kind of message, why) of the first of each kind, in the thread that found it.

    Attributes:
        count: messages that could not be taken so far.
        last: kind and reason of the last one; empty: none so far.
    """

    def __init__(self, report: Callable[[str, str], object] = lambda _kind, _why: None) -> None:
        self._report = report
        self._lock = threading.Lock()
        self._reported: set[str] = set()
        self.count: int = 0
        self.last: str = ""

    def refuse(self, kind: str, why: str) -> None:
        with self._lock:
            self.count += 1
            self.last = f"{kind}: {why}"[:_LONGEST]
            is_new = kind not in self._reported and len(self._reported) < _MOST_KINDS
            if is_new:
                self._reported.add(kind)
        if is_new:
            self._report(kind, why)

    def run(self, kind: str, work: Callable[..., object], *arguments: object) -> bool:
        """Do what a message asks for; one that cannot be taken is counted.

        Returns:
            Whether it was done.
        """
        try:
            work(*arguments)
        except Exception as error:  # noqa: BLE001, whatever others send ends nothing here
            self.refuse(kind, _text(error))
            return False
        return True

    def of_messages(self, kind: str, heard: Callable[[str, bytes], None]) -> Callable[[str, bytes], None]:
        def guarded(key: str, payload: bytes) -> None:
            self.run(kind, heard, key, payload)

        return guarded

    def of_questions(self, kind: str, asked: Callable[[Question], None]) -> Callable[[Question], None]:
        """What answers questions, guarded: one that cannot be taken is answered with that."""

        def guarded(question: Question) -> None:
            if not self.run(kind, asked, question):
                question.fail(b"the question cannot be understood")

        return guarded


class Room:
    """Memory for what a robot has, shared by its services.

    Args:
        most: bytes for all of them.
    """

    def __init__(self, most: int = LIMITS.robot_size) -> None:
        self._most = most
        self._taken: dict[str, int] = {}

    def take(self, name: str, size: int) -> None:
        """Have ``size`` bytes for a service, in the place of what it had.

        Raises:
            BridgeError: that is more than the robot may have; nothing has changed.
        """
        others = sum(taken for one, taken in self._taken.items() if one != name)
        if others + size > self._most:
            raise BridgeError(
                f"it needs {size / 1e6:.1f} MB of memory, beside {others / 1e6:.1f} MB of other services; a robot may"
                f" have {self._most / 1e6:.0f} MB"
            )
        self._taken[name] = size

    def give_back(self, name: str) -> None:
        self._taken.pop(name, None)


def _text(error: Exception) -> str:
    if isinstance(error, SkinwareError):
        return str(error)
    return f"{type(error).__name__}: {error}"
