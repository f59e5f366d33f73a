"""A robot's end of a bridge: it offers the services of a namespace to all peers, to each as fast as its link takes."""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Callable, Collection, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from typing import Any, Literal, get_args

import msgspec

from skinware.bridge.clock import answer_pings
from skinware.bridge.link import Guard, Question, ZenohLink
from skinware.bridge.messages import (
    About,
    CallResult,
    Keys,
    Service,
    Services,
    State,
    Wish,
    generation_message,
    host_name,
    read_text,
)
from skinware.bridge.parts import RobotPart, ServedService, ServiceFile
from skinware.bridge.streaming import FrameStream
from skinware.bridge.watching import Summaries
from skinware.errors import (
    BridgeError,
    ConfigurationError,
    Paused,
    RequestCancelled,
    RequestError,
    RequestRefused,
    SkinwareError,
)
from skinware.limits import LIMITS
from skinware.memory import segments
from skinware.memory.namespace import Namespace
from skinware.memory.ring import Sample
from skinware.realtime import NS_PER_S, boot, now_ns
from skinware.service import ServiceReader
from skinware.transfer.codec import CodedColumn
from skinware.transfer.collecting import Collector

_LONGEST_LINE = 4096
_MOST_FRAMES = 1024
"""Frames that wait to be coded."""
_KEPT_NS = 10 * NS_PER_S
"""How long a part is kept after the last question for it."""
_MOST_PARTS = 64
_CALLS_AT_ONCE, _MOST_CALLS, _CALL_S = 4, 64, 30.0
_OPERATIONS_S = 1.0
_STATES: dict[str, State] = {"restarted": "live", "found": "live"}
_STATES |= {state: state for state in get_args(State)}
"""State of a service after an event."""
_ErrorKind = Literal["refused", "failed", "paused", "cancelled"]
_ERRORS: dict[type[Exception], _ErrorKind] = {
    Paused: "paused",
    RequestCancelled: "cancelled",
    RequestRefused: "refused",
}


class _Workers:
    """Runs jobs in threads of its own, and refuses those that are too many."""

    def __init__(self, n_threads: int, most: int, name: str) -> None:
        self._threads = ThreadPoolExecutor(n_threads, name)
        self._room = threading.BoundedSemaphore(most)

    def submit(self, job: Callable[..., object], *arguments: object) -> bool:
        """Run ``job(*arguments)`` soon; return False if it is refused."""
        if not self._room.acquire(blocking=False):
            return False
        try:
            self._threads.submit(job, *arguments).add_done_callback(lambda _: self._room.release())
        except RuntimeError:  # closed
            self._room.release()
        return True

    def close(self) -> None:
        self._threads.shutdown(wait=True, cancel_futures=True)


class Server:
    """Serves the services of a namespace as those of a robot.

    Args:
        names: of services; None: all, also later ones.
        callers: names of the certificates that may call, for people.

    Attributes:
        guard: counts questions that cannot be understood.
    """

    def __init__(
        self,
        robot: str,
        link: ZenohLink,
        namespace: Namespace,
        names: Collection[str] | None = None,
        *,
        callers: Collection[str] = (),
    ) -> None:
        instance = os.urandom(8).hex()
        self._identity = Services(instance, f"{boot()}/{namespace.name}", tuple(callers), host=host_name())
        self._keys, self._link, self._namespace = Keys(robot, instance), link, namespace
        self._services: dict[str, ServedService] = {}
        self._states: dict[str, State] = {}
        self._lock = threading.Lock()
        self._is_ending = False
        self.guard = Guard()
        self._calls = _Workers(_CALLS_AT_ONCE, _MOST_CALLS, "skinware bridge call")
        self._coding = _Workers(1, _MOST_FRAMES, "skinware bridge coding")
        self._parts: dict[str, RobotPart] = {}  # by number of the wish
        self._summaries = Summaries(namespace.name, link.sender(self._keys.summary))
        self._collector = Collector(namespace, names, self)
        self._collector.take()  # the first answers have all services
        self._ends = [answer_pings(link, self._keys)]
        for key, asked in (
            (self._keys.services, self._services_asked),
            (self._keys.of("*", "generation"), self._of_service_asked),
            (self._keys.of("*", "newest"), self._of_service_asked),
            (self._keys.of("*", "call/*"), partial(self._call_soon, self._call)),
        ):
            self._ends.append(link.answer(key, partial(self._asked, asked)))
        link.declare_token(self._keys.token)

    @property
    def missed(self) -> int:
        """Frames that were missed in their rings."""
        return self._collector.missed

    def run(self, each_second: Callable[[], object] = lambda: None) -> None:
        """Run until ``stop``; call ``each_second`` once a second."""

        def once_a_second() -> None:
            for served in self._services.values():
                served.stream.expire()
            self._code_soon(self._summaries.send, self._there(), self.missed)
            self._code_soon(self._expire_parts)
            each_second()

        self._collector.run(once_a_second)

    def stop(self) -> None:
        """End it; from any thread, and from a signal handler."""
        self._collector.stop()
        self._is_ending = True

    def close(self) -> None:
        """Release all services; open calls are cancelled."""
        self.stop()
        for end in self._ends:
            end()
        self._calls.close()
        self._coding.close()
        self._collector.close()

    def frames(self) -> Mapping[str, tuple[str, int, int]]:
        """Return (state, frames so far, number of pullers) of every service."""
        with self._lock:
            return {
                name: (served.service.state, served.stream.frames, served.stream.n_pullers)
                for name, served in self._services.items()
            }

    # -- a skinware.transfer.collecting.FrameListener -------------------------------------------------------------

    def began(self, service: str, head: bytes) -> None:
        segment = segments.recorded(head, service)
        file, state = ServiceFile(service, head), Service(segment.generation, self._states.get(service, "live"))
        with self._lock:
            served = self._services.get(service)
            if served is None:
                served = self._services[service] = ServedService(self._stream(service), file, state)
            else:
                served.file, served.service = file, state
            served.stream.begin(segment.generation, [CodedColumn.of(column) for column in segment.layout.slot])
        self._link.put(self._keys.services, self._list_of_services())

    def took(self, service: str, frame: Sample) -> None:
        self._services[service].stream.take(frame)
        for part in list(self._parts.values()):
            part.take(service, frame)

    def happened(self, event: dict[str, Any]) -> None:
        name, state = event["service"], _STATES.get(event["event"])
        if not name or state is None:
            return
        self._states[name] = state
        with self._lock:
            served = self._services.get(name)
            if served is not None:
                newest = served.stream.newest
                sequence = newest.sequence if newest is not None else 0
                served.service = Service(served.service.generation, state, sequence)
        self._link.put(self._keys.services, self._list_of_services())

    # -- coding, in a thread of its own ---------------------------------------------------------------------------

    def _stream(self, service: str, part: str = "") -> FrameStream:
        return FrameStream(self._link.sender(self._keys.frame(service, part)), self._code_soon)

    def _code_soon(self, work: Callable[..., object], *arguments: object) -> None:
        if not self._coding.submit(self.guard.run, "a question", work, *arguments):
            self.guard.refuse("a question", f"{_MOST_FRAMES} others wait")

    def _expire_parts(self) -> None:
        """End parts for which no question came lately, and answer those that waited too long."""
        for number, part in list(self._parts.items()):
            if now_ns() - part.asked_ns > _KEPT_NS:
                self._parts.pop(number).close()
            else:
                part.expire()

    def _there(self) -> dict[str, ServedService]:
        with self._lock:
            return {name: replace(one) for name, one in self._services.items() if one.service.state != "closed"}

    def _answer_wish(self, question: Question) -> None:
        services: dict[str, Service] = {}
        try:
            missing = self._fit(read_text(question.payload, Wish), services)
        except (BridgeError, ConfigurationError) as error:
            missing = str(error)
        answer = msgspec.structs.replace(self._identity, services=services, missing=missing[:_LONGEST_LINE])
        question.reply(msgspec.json.encode(answer))

    def _fit(self, wish: Wish, services: dict[str, Service]) -> str:
        """Cut a part out of all drivers and add those that have any of it to ``services``; return what is missing."""
        part, structures = self._parts.get(wish.number), []
        if part is None:
            if len(self._parts) >= _MOST_PARTS:
                raise BridgeError(f"{_MOST_PARTS} other parts of it are wanted already")
            part = self._parts[wish.number] = RobotPart(wish.choice(), partial(self._stream, part=wish.number))
        part.asked_ns = now_ns()
        for name, served in self._there().items():
            driver = served.file.driver
            if driver is None or driver.structure is None:
                continue
            structures.append(driver.structure)
            if part.fit(name, driver):
                services[name] = served.service
                if served.stream.newest is not None:
                    part.take(name, served.stream.newest)
        if not structures:
            return ""  # drivers may come
        missing = "; ".join(part.choice.unknown(structures))
        return missing or ("" if services else "no sensor meets all conditions")

    # -- questions, in zenoh's threads ----------------------------------------------------------------------------

    def _asked(self, answer: Callable[[Question], None], question: Question) -> None:
        if not self.guard.run("a question", answer, question):
            question.fail(b"the question cannot be understood")

    def _list_of_services(self) -> bytes:
        with self._lock:
            services = {name: served.service for name, served in list(self._services.items())[: LIMITS.services]}
            left_out = len(self._services) - len(services)
        if left_out:
            self.guard.refuse("a service", f"{left_out} are left out: a robot may have {LIMITS.services}")
        return msgspec.json.encode(msgspec.structs.replace(self._identity, services=services))

    def _services_asked(self, question: Question) -> None:
        if question.payload:
            self._code_soon(self._answer_wish, question)
        else:
            question.reply(self._list_of_services())

    def _of_service_asked(self, question: Question) -> None:
        """Answer a question for the generation or the newest frame of a service, or of a part of it."""
        name, what = question.key.split("/")[4:]
        number, served = question.parameters.get("part"), self._services.get(name)
        found = None if served is None else (served.file, served.stream)
        if number:
            part = self._parts.get(number)
            found = None if part is None else part.find(name)
        if found is None:
            question.fail(b"no such service")
        elif what == "newest":
            found[1].asked(question)
        else:
            self._call_soon(self._answer_generation, question, found[0])

    # -- calls, in threads of their own ---------------------------------------------------------------------------

    def _call_soon(self, work: Callable[..., None], question: Question, *arguments: object) -> None:
        if not self._calls.submit(work, question, *arguments):
            question.fail(b"too many questions at once")

    def _answer_generation(self, question: Question, file: ServiceFile) -> None:
        operations: dict[str, str] = {}
        with contextlib.suppress(SkinwareError):
            with ServiceReader[Sample](file.name, namespace=self._namespace, announce=False) as reader:
                operations = dict(reader.operations(timeout_s=_OPERATIONS_S))
        question.reply(generation_message(About(operations), file.packed))

    def _call(self, question: Question) -> None:
        """Call an operation and wait for its answer, but not beyond the end of this bridge."""
        *_, name, _, operation = question.key.split("/")
        try:
            arguments = read_text(question.payload, dict[str, Any]) if question.payload else {}
            with ServiceReader[Sample](name, namespace=self._namespace, announce=False) as reader:
                answer = reader.ask(operation, **arguments).result(_CALL_S, lambda: self._is_ending)
        except Exception as error:  # noqa: BLE001, the caller gets it
            other: _ErrorKind = "failed" if isinstance(error, RequestError) else "refused"
            result = CallResult(error=str(error)[:_LONGEST_LINE], why=_ERRORS.get(type(error), other))
        else:
            result = CallResult(answer.generation, answer.sequence, msgspec.Raw(msgspec.json.encode(answer.result)))
        question.reply(msgspec.json.encode(result))
