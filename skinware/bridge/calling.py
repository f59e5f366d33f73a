"""Operations of services that others call from far away."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Literal

import msgspec

from skinware.bridge.link import Question
from skinware.bridge.messages import Answered, read_text
from skinware.errors import Paused, RequestCancelled, RequestError, RequestRefused, SkinwareError
from skinware.memory.namespace import Namespace
from skinware.memory.ring import Sample
from skinware.realtime import NS_PER_S, now_ns
from skinware.service import PendingRequest, ServiceReader
from skinware.service.messages import Answer

_AT_ONCE = 4
_MOST = 64
_CALL_S = 30.0
_LONGEST_ERROR = 4096
_OPERATIONS_S = 1.0
_SHORTEST_PAUSE_S, _LONGEST_PAUSE_S = 0.0002, 0.02


class Calls:
    """Answers questions that take their time, in threads of its own.

    Args:
        namespace: of the services.
    """

    def __init__(self, namespace: Namespace) -> None:
        self._namespace = namespace
        self._threads = ThreadPoolExecutor(_AT_ONCE, "skinware bridge call")
        self._lock = threading.Lock()
        self._open = 0
        self._ending = False

    def submit(self, question: Question, work: Callable[..., None], *arguments: object) -> None:
        """Have ``work(question, *arguments)`` done, which answers; too many at once are refused."""
        with self._lock:
            is_full = self._open >= _MOST
            if not is_full:
                self._open += 1
        if is_full:
            question.fail(b"too many questions at once")
            return

        def do() -> None:
            try:
                work(question, *arguments)
            finally:
                with self._lock:
                    self._open -= 1

        with contextlib.suppress(RuntimeError):  # it is closed
            self._threads.submit(do)

    def operations(self, name: str) -> Mapping[str, str]:
        """Descriptions of what a service offers, by name; none if it takes no requests, or none now."""
        try:
            with self._reader(name) as reader:
                return reader.operations(timeout_s=_OPERATIONS_S)
        except SkinwareError:
            return {}

    def carry_out(self, question: Question, name: str, operation: str) -> None:
        """Call an operation of a service, and tell who asked how it ended."""
        try:
            arguments = read_text(question.payload, dict[str, Any]) if question.payload else {}
            with self._reader(name) as reader:
                answer = self._result_of(reader.ask(operation, **arguments))
        except Exception as error:  # noqa: BLE001, whoever asked is told
            answered = Answered(error=str(error)[:_LONGEST_ERROR], why=_why(error))
        else:
            result = msgspec.Raw(msgspec.json.encode(answer.result))
            answered = Answered(answer.generation, answer.sequence, result)
        question.reply(msgspec.json.encode(answered))

    def end(self) -> None:
        self._ending = True

    def close(self) -> None:
        """End it; what is still open is cancelled."""
        self.end()
        self._threads.shutdown(wait=True, cancel_futures=True)

    def _result_of(self, pending: PendingRequest) -> Answer:
        """Wait for an answer, but not beyond the end of this bridge."""
        until_ns, pause_s = now_ns() + round(_CALL_S * NS_PER_S), _SHORTEST_PAUSE_S
        while not pending.done() and now_ns() < until_ns:
            if self._ending:
                pending.cancel()
            time.sleep(pause_s)
            pause_s = min(2 * pause_s, _LONGEST_PAUSE_S)
        return pending.result(0.0)

    def _reader(self, name: str) -> ServiceReader[Sample]:
        return ServiceReader(name, namespace=self._namespace, announce=False)


def _why(error: Exception) -> Literal["refused", "failed", "paused", "cancelled"]:
    if isinstance(error, Paused):
        return "paused"
    if isinstance(error, RequestCancelled):
        return "cancelled"
    if isinstance(error, RequestRefused):
        return "refused"
    return "failed" if isinstance(error, RequestError) else "refused"
