"""Publish the services of a robot here, and pass requests for them on."""

from __future__ import annotations

import threading
from collections import defaultdict
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from skinware.bridge.messages import CallResult
from skinware.errors import BridgeError
from skinware.limits import LIMITS
from skinware.memory.namespace import Namespace
from skinware.realtime import NS_PER_S, now_ns
from skinware.service import Request
from skinware.transfer.generation import Generation, RecordedSample
from skinware.transfer.republishing import Published, Republisher

Position = tuple[int, int]
_LONGEST_NS = 5 * NS_PER_S
"""How long an answer waits for the frame that goes with it."""


class MemoryBudget:
    """Memory for the services of a robot; ``most``: bytes for all of them."""

    def __init__(self, most: int = LIMITS.robot_size) -> None:
        self._most = most
        self._taken: dict[str, int] = {}

    def reserve(self, name: str, size: int) -> None:
        """Reserve bytes for a service in place of its former ones, or raise BridgeError."""
        others = sum(taken for one, taken in self._taken.items() if one != name)
        if others + size > self._most:
            raise BridgeError(
                f"it needs {size / 1e6:.1f} MB of memory, beside {others / 1e6:.1f} MB of other services; a robot may"
                f" have {self._most / 1e6:.0f} MB"
            )
        self._taken[name] = size

    def release(self, name: str) -> None:
        self._taken.pop(name, None)


class _Waiting(NamedTuple):
    """An answer that waits for the frame that goes with it, at a position by the robot's count."""

    at: Position
    request: Request
    result: Any
    until_ns: int


class Mirror(Republisher):
    """Publishes frames of a robot, with their times moved to the clock of this machine.

    ``ask`` passes a request for a service on, and ``answered`` takes the answer. ``answer`` holds ``lock`` while it
    calls back; callers of the other methods must hold it, too.

    Attributes:
        operations: of each service: descriptions by name.
    """

    def __init__(self, namespace: Namespace, ask: Callable[[str, Request], None], offset_ns: Callable[[], int]) -> None:
        super().__init__(namespace, {}, keeps_counts=True)
        self.lock = threading.RLock()
        self.operations: dict[str, Mapping[str, str]] = {}
        self.budget = MemoryBudget()
        self._ask, self._offset_ns = ask, offset_ns
        self._answers: defaultdict[str, list[_Waiting]] = defaultdict(list)
        self._newest: dict[str, Position] = {}

    def watch(self, fd: int, call: Callable[[], object]) -> None:
        def locked() -> None:
            with self.lock:
                call()

        super().watch(fd, locked)

    def shift_ns(self, frame: RecordedSample) -> int:  # noqa: ARG002
        return self._offset_ns()

    def operations_of(self, name: str) -> Mapping[str, Callable[..., object]]:
        return {operation: _described(text) for operation, text in self.operations.get(name, {}).items()}

    def take_requests(self, name: str, service: Published) -> None:
        for request in service.writer.requests():
            self._ask(name, request)

    def publish(self, name: str, frame: RecordedSample, generation: Generation, *, follows: bool = True) -> None:
        super().publish(name, frame, generation, follows=follows)
        self._newest[name] = frame.position
        if self._answers[name]:
            self._give(name, frame.position)

    def answered(self, name: str, request: Request, answer: CallResult, result: Any) -> None:
        if request.cancelled or name not in self._services:
            return
        if answer.error is not None:
            request.fail(answer.error, answer.why or "failed")
        elif not answer.generation:
            request.reply(result)
        else:
            at = (answer.generation, answer.sequence)
            self._answers[name].append(_Waiting(at, request, result, now_ns() + _LONGEST_NS))
            self._give(name, self._newest.get(name, (0, 0)))

    def tidy(self) -> None:
        super().tidy()
        for answers in self._answers.values():
            for late in [waiting for waiting in answers if now_ns() > waiting.until_ns]:
                answers.remove(late)
                late.request.fail("it was done, but the frame that goes with it did not come over the link")

    def _give(self, name: str, position: Position) -> None:
        service = self._services[name]
        for waiting in [waiting for waiting in self._answers[name] if waiting.at <= position]:
            self._answers[name].remove(waiting)
            waiting.request.reply(waiting.result, service.writer.position)


def _described(description: str) -> Callable[..., object]:
    """Return an operation that has a description; it is passed on and never called here."""

    def passed_on(**_arguments: object) -> None:
        raise NotImplementedError

    passed_on.__doc__ = description
    return passed_on
