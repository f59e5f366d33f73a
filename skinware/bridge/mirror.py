"""The services of another machine, published here; what is asked of them is passed on."""

from __future__ import annotations

import threading
from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from skinware.bridge.messages import Answered
from skinware.memory.namespace import Namespace
from skinware.realtime import NS_PER_S, now_ns
from skinware.service import Request
from skinware.transfer.generation import Generation, RecordedSample
from skinware.transfer.republishing import Published, Republisher

Position = tuple[int, int]
_LONGEST_NS = 5 * NS_PER_S
"""How long an answer waits for the frame that goes with it."""


@dataclass(frozen=True)
class _Waiting:
    """An answer that goes with a frame that is still to come.

    Attributes:
        at: (generation, sequence) of it, by the robot's count.
    """

    at: Position
    request: Request
    result: Any
    until_ns: int


class Mirror(Republisher):
    """Publishes frames of another machine, their times moved to the clock of this one.

    Args:
        namespace: where to publish.
        ask: passes a request for a service on; it is answered with ``answered``.
        offset_ns: our clock minus the other, as of now.

    What is called back by ``answer`` is called with ``lock`` held; so must be whoever calls anything else.

    Attributes:
        lock: of all of it.
        operations: what each service offers: descriptions by name.
    """

    def __init__(self, namespace: Namespace, ask: Callable[[str, Request], None], offset_ns: Callable[[], int]) -> None:
        super().__init__(namespace, {}, keeps_counts=True)
        self.lock = threading.RLock()
        self._ask, self._offset_ns = ask, offset_ns
        self._answers: defaultdict[str, list[_Waiting]] = defaultdict(list)
        self._newest: dict[str, Position] = {}
        self.operations: dict[str, Mapping[str, str]] = {}

    def watch(self, fd: int, call: Callable[[], object]) -> None:
        """See :class:`skinware.transfer.republishing.Republisher`."""

        def locked() -> None:
            with self.lock:
                call()

        super().watch(fd, locked)

    def shift_ns(self, frame: RecordedSample) -> int:  # noqa: ARG002
        return self._offset_ns()

    def operations_of(self, name: str) -> Mapping[str, Callable[..., object]]:
        return {operation: _named(text) for operation, text in self.operations.get(name, {}).items()}

    def take_requests(self, name: str, service: Published) -> None:
        """Likewise: they are passed on."""
        for request in service.writer.requests():
            self._ask(name, request)

    def publish(self, name: str, frame: RecordedSample, generation: Generation, *, follows: bool = True) -> None:
        """Likewise. Answers that waited for this frame are given."""
        super().publish(name, frame, generation, follows=follows)
        self._newest[name] = frame.position
        if self._answers[name]:
            self._give(name, frame.position)

    def answered(self, name: str, request: Request, answer: Answered, result: Any) -> None:
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
        """See :class:`skinware.transfer.republishing.Republisher`."""
        super().tidy()
        for answers in self._answers.values():
            for late in [waiting for waiting in answers if now_ns() > waiting.until_ns]:
                answers.remove(late)
                late.request.fail("it was done, but the frame that goes with it did not come over the link")

    def _give(self, name: str, position: Position) -> None:
        service = self._services[name]
        here = [waiting for waiting in self._answers[name] if waiting.at <= position]
        for waiting in here:
            self._answers[name].remove(waiting)
            waiting.request.reply(waiting.result, service.writer.position)


def _named(description: str) -> Callable[..., object]:
    """An operation that has a description; it is passed on and never called here."""

    def passed_on(**_arguments: object) -> None:
        raise NotImplementedError

    passed_on.__doc__ = description
    return passed_on
