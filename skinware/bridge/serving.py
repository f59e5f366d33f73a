"""A robot's end of a bridge: the services of a namespace, for whoever listens, and as fast as each can."""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Callable, Collection, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import msgspec

from skinware.bridge.calling import Calls
from skinware.bridge.clock import answering
from skinware.bridge.giving import Stream, Summaries, Summarised
from skinware.bridge.link import Guard, Link, Question
from skinware.bridge.messages import (
    About,
    Head,
    Keys,
    Service,
    Services,
    State,
    Wish,
    generation_message,
    host_name,
    parts_of,
    read_text,
)
from skinware.bridge.parts import Parts
from skinware.errors import BadRecording, BridgeError, ConfigurationError
from skinware.limits import LIMITS
from skinware.memory import segments
from skinware.memory.namespace import Namespace
from skinware.memory.ring import Sample
from skinware.realtime import boot
from skinware.structure import Structure
from skinware.transfer.codec import CodedColumn
from skinware.transfer.collecting import Collector
from skinware.transfer.generation import Generation

_LONGEST_LINE = 4096
_MOST_WAITING = 1024
"""Questions that wait to be answered by the thread that codes."""
_STATES: dict[str, State] = {
    "live": "live",
    "paused": "paused",
    "closed": "closed",
    "dead": "dead",
    "restarted": "live",
    "found": "live",
}


@dataclass
class _Whole:
    """A generation of a service.

    Attributes:
        name: of the service.
        head: its file up to its slots.
    """

    name: str
    head: Head

    @cached_property
    def of_driver(self) -> Generation | None:
        """It, if it is one of a driver that can be read; this takes its time."""
        try:
            generation = Generation(self.head.raw, self.name)
        except BadRecording:
            return None
        return generation if generation.is_driver else None


@dataclass
class _Served:
    """A service.

    Attributes:
        stream: gives its frames.
        whole: its present generation.
        told: how it is.
    """

    stream: Stream
    whole: _Whole
    told: Service


class Server:
    """Serves the services of a namespace as those of a robot, until it is stopped.

    Args:
        robot: its name.
        link: to whoever joins.
        namespace: whose services.
        names: of them; None: all there are and come.
        callers: who may call, told to all.

    Attributes:
        guard: counts questions that cannot be understood.
    """

    def __init__(
        self,
        robot: str,
        link: Link,
        namespace: Namespace,
        names: Collection[str] | None = None,
        *,
        callers: Collection[str] = (),
    ) -> None:
        self._instance, self._callers = os.urandom(8).hex(), tuple(callers)
        self._keys, self._link = Keys(robot, self._instance), link
        self._start = f"{boot()}/{namespace.name}"
        self._services: dict[str, _Served] = {}
        self._states: dict[str, Service] = {}
        self._lock = threading.Lock()
        self.guard = Guard()
        self._calls = Calls(namespace)
        self._waiting = 0  # for the thread that codes
        self._coding = ThreadPoolExecutor(1, "skinware bridge coding")
        self._parts = Parts(self._stream)
        self._summaries = Summaries(namespace.name, link.sender(self._keys.summary))
        self._collector = Collector(namespace, names, self)
        self._collector.take()  # who asks is told of all that there is
        self._answering = [
            answering(link, self._keys),
            *(
                link.answer(key, self.guard.of_questions("a question", asked))
                for key, asked in (
                    (self._keys.services, self._services_asked),
                    (self._keys.of("*", "generation"), self._generation_asked),
                    (self._keys.of("*", "newest"), self._newest_asked),
                    (self._keys.call("*", "*"), self._called),
                )
            ),
        ]
        link.be_there(self._keys.token)

    @property
    def lost(self) -> int:
        """Frames that could not be taken from their rings."""
        return self._collector.lost

    def run(self, tell: Callable[[], object] = lambda: None) -> None:
        """Until ``stop``; ``tell`` is called once a second."""

        def each_second() -> None:
            self._let_go()
            self._soon(self._summarise)
            tell()

        self._collector.run(each_second)

    def stop(self) -> None:
        """End it; from any thread, and from a signal handler."""
        self._collector.stop()
        self._calls.end()

    def close(self) -> None:
        """Let go of all services; calls that are still open are cancelled."""
        self.stop()
        for end in self._answering:
            end()
        self._calls.close()
        self._coding.shutdown(wait=True, cancel_futures=True)
        self._collector.close()

    def frames(self) -> Mapping[str, tuple[str, int, int]]:
        """(state, frames so far, who pull) of every service."""
        with self._lock:
            return {
                name: (served.told.state, served.stream.frames, served.stream.n_pullers)
                for name, served in self._services.items()
            }

    # -- what the collector tells ---------------------------------------------------------------------------------

    def began(self, service: str, head: bytes) -> None:
        """See :class:`skinware.transfer.collecting.Listener`."""
        segment = segments.recorded(head, service)
        told = Service(segment.generation, self._states.get(service, Service()).state)
        whole = _Whole(service, Head(head))
        with self._lock:
            served = self._services.get(service)
            if served is None:
                served = self._services[service] = _Served(self._stream(service), whole, told)
            else:
                served.whole, served.told = whole, told
            served.stream.begin(segment.generation, [CodedColumn.of(column) for column in segment.layout.slot])
        self._states[service] = told
        self._link.tell(self._keys.services, self._told())

    def took(self, service: str, frame: Sample) -> None:
        """Likewise."""
        self._services[service].stream.take(frame)
        self._parts.take(service, frame)

    def happened(self, event: dict[str, Any]) -> None:
        """Likewise."""
        name, state = event["service"], _STATES.get(event["event"])
        if not name or state is None:
            return
        known = self._states.get(name, Service())
        self._states[name] = Service(known.generation, state)
        with self._lock:
            served = self._services.get(name)
            if served is not None:
                newest = served.stream.newest
                sequence = newest.sequence if newest is not None else 0
                served.told = Service(served.told.generation, state, sequence)
        self._link.tell(self._keys.services, self._told())

    def _stream(self, service: str, part: str = "") -> Stream:
        return Stream(self._link.sender(self._keys.frame(service, part)), self._soon)

    def _summarise(self) -> None:
        there = self._there()
        self._summaries.count({whole.name: stream.frames for whole, _, stream in there})
        if not self._summaries.is_wanted:
            return
        drivers = [
            Summarised(whole.name, told.state, generation, stream)
            for whole, told, stream in there
            if (generation := whole.of_driver) is not None
        ]
        self._summaries.send(drivers, len(there) - len(drivers), self.lost)

    def _there(self) -> list[tuple[_Whole, Service, Stream]]:
        with self._lock:
            services = [(served.whole, served.told, served.stream) for served in self._services.values()]
        return [service for service in services if service[1].state != "closed"]

    def _soon(self, work: Callable[..., None], *arguments: object) -> None:
        """Have frames coded, or cut, after what waits for that already; what is too much is counted, and left out."""
        with self._lock:
            if self._waiting >= _MOST_WAITING:
                self.guard.refuse("a question", f"{_MOST_WAITING} others wait")
                return
            self._waiting += 1
        with contextlib.suppress(RuntimeError):  # it is closed
            self._coding.submit(self._code, work, *arguments)

    def _code(self, work: Callable[..., None], *arguments: object) -> None:
        with self._lock:
            self._waiting -= 1
        self.guard.run("a question", work, *arguments)

    def _let_go(self) -> None:
        for served in self._services.values():
            served.stream.let_go()
        self._parts.let_go()

    # -- questions, in zenoh's threads ----------------------------------------------------------------------------

    def _services_asked(self, question: Question) -> None:
        if question.payload:
            self._soon(self._tell_part, question)
        else:
            question.reply(self._told())

    def _told(self) -> bytes:
        with self._lock:
            services = {name: served.told for name, served in list(self._services.items())[: LIMITS.services]}
            left_out = len(self._services) - len(services)
        if left_out:
            self.guard.refuse("a service", f"{left_out} are left out: a robot may have {LIMITS.services}")
        return msgspec.json.encode(Services(self._instance, self._start, self._callers, services, host=host_name()))

    def _tell_part(self, question: Question) -> None:
        services: dict[str, Service] = {}
        try:
            missing = self._fit(read_text(question.payload, Wish), services)
        except (BridgeError, ConfigurationError) as error:
            missing = str(error)
        told = Services(self._instance, self._start, self._callers, services, missing[:_LONGEST_LINE], host_name())
        question.reply(msgspec.json.encode(told))

    def _fit(self, wish: Wish, services: dict[str, Service]) -> str:
        """Cut a part out of all drivers, and note those that have any of it; what is not there, a line for people."""
        part, structures = self._parts.wanted(wish), []
        for whole, told, stream in self._there():
            driver = whole.of_driver
            if driver is None or not isinstance(driver.context, Structure):
                continue
            structures.append(driver.context)
            if part.fit(whole.name, driver):
                services[whole.name] = told
                if stream.newest is not None:
                    part.take(whole.name, stream.newest)
        if not structures:
            return ""  # drivers may come
        missing = "; ".join(part.choice.unknown(structures))
        return missing or ("" if services else "no sensor there is of what was asked for")

    def _generation_asked(self, question: Question) -> None:
        name, number = parts_of(question.key)[0], question.parameters.get("part")
        served = self._services.get(name)
        head = None if served is None else served.whole.head
        if number:
            part = self._parts.find(number)
            cut = None if part is None else part.cut(name)
            head = None if cut is None else cut.head
        if head is None:
            question.fail(b"no such service")
        else:
            self._calls.submit(question, self._tell_generation, name, head)

    def _tell_generation(self, question: Question, name: str, head: Head) -> None:
        question.reply(generation_message(About(dict(self._calls.operations(name))), head))

    def _newest_asked(self, question: Question) -> None:
        name, number = parts_of(question.key)[0], question.parameters.get("part")
        served = self._services.get(name)
        stream = None if served is None else served.stream
        if number:
            part = self._parts.find(number)
            stream = None if part is None else part.stream(name)
        if stream is None:
            question.fail(b"no such service")
        else:
            stream.asked(question)

    def _called(self, question: Question) -> None:
        self._calls.submit(question, self._calls.carry_out, *parts_of(question.key))
