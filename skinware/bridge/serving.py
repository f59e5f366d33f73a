"""A robot's end of a bridge: the services of a namespace, for whoever listens, and as fast as each can."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Collection, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

import msgspec

from skinware.bridge.link import Link, Question
from skinware.bridge.messages import (
    CLOCK,
    RAW,
    About,
    Answered,
    Keys,
    Service,
    Services,
    coded_message,
    generation_message,
    parts_of,
    raw_message,
)
from skinware.errors import Paused, RequestCancelled, RequestError, RequestRefused, SkinwareError
from skinware.memory import segments
from skinware.memory.namespace import Namespace
from skinware.memory.ring import Frame
from skinware.realtime import NS_PER_S, WAIT_SLICE_NS, boot, now_ns, short_turns
from skinware.service import PendingRequest, ServiceReader
from skinware.service.messages import Answer
from skinware.transfer.codec import CodedColumn, Encoder
from skinware.transfer.collecting import Collector

_HELD_NS = NS_PER_S // 2
"""How long a question for the newest frame waits for one."""
_CALLS_AT_ONCE = 4
_MOST_CALLS = 64
_CALL_S = 30.0
_OPERATIONS_S = 1.0
_SHORTEST_PAUSE_S, _LONGEST_PAUSE_S = 0.0002, 0.02
_STATES = {"live": "live", "paused": "paused", "closed": "closed", "dead": "dead", "restarted": "live", "found": "live"}


@dataclass
class _Puller:
    """Somebody who asks for frames one by one."""

    encoder: Encoder
    generation: int
    sequence: int = 0


@dataclass
class _Served:
    """A service.

    Attributes:
        send: a frame to all who listen.
        head: of its present generation.
        told: how it is.
        newest: frame.
        asked: who wait for a newer one: (since when, question).
        pullers: by who asks.
        frames: that were sent.
    """

    send: Callable[[bytes], None]
    head: bytes
    columns: list[CodedColumn]
    told: Service
    newest: Frame | None = None
    asked: list[tuple[int, Question]] = field(default_factory=list)
    pullers: dict[str, _Puller] = field(default_factory=dict)
    frames: int = 0


class Server:
    """Serves the services of a namespace as those of a robot, until it is stopped.

    Args:
        robot: its name.
        link: to whoever joins.
        namespace: whose services.
        names: of them; None: all there are and come.
        callers: who may call, told to all.
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
        self._keys, self._link, self._namespace = Keys(robot), link, namespace
        self._instance, self._callers = os.urandom(8).hex(), tuple(callers)
        self._start = f"{boot()}/{namespace.name}"
        self._services: dict[str, _Served] = {}
        self._states: dict[str, Service] = {}
        self._lock = threading.Lock()
        self._calls = ThreadPoolExecutor(_CALLS_AT_ONCE, "skinware bridge call")
        self._coding = ThreadPoolExecutor(1, "skinware bridge coding")
        self._open_calls = 0
        self._stopping = False
        self._collector = Collector(namespace, names, self)
        self._answering = [
            link.answer(self._keys.clock, self._clock_asked),
            link.answer(self._keys.services, lambda question: question.reply(self._told())),
            link.answer(self._keys.of("*", "generation"), self._generation_asked),
            link.answer(self._keys.of("*", "newest"), self._newest_asked),
            link.answer(self._keys.call("*", "*"), self._called),
        ]
        link.be_there(self._keys.token(self._instance))

    @property
    def lost(self) -> int:
        """Frames that could not be taken from their rings."""
        return self._collector.lost

    def run(self, tell: Callable[[], object] = lambda: None) -> None:
        """Until ``stop``; ``tell`` is called once a second."""
        tell_ns = now_ns() + NS_PER_S
        with short_turns():
            while not self._stopping:
                self._collector.take()
                if now_ns() >= tell_ns:
                    tell_ns = max(tell_ns + NS_PER_S, now_ns())
                    self._let_go()
                    tell()
                self._collector.wait(WAIT_SLICE_NS)

    def stop(self) -> None:
        """End it; from any thread, and from a signal handler."""
        self._stopping = True

    def close(self) -> None:
        """Let go of all services; calls that are still open are cancelled."""
        self._stopping = True
        for end in self._answering:
            end()
        for pool in (self._calls, self._coding):
            pool.shutdown(wait=True, cancel_futures=True)
        self._collector.close()

    def frames(self) -> Mapping[str, tuple[str, int, int]]:
        """(state, frames sent so far, who pull) of every service."""
        with self._lock:
            return {
                name: (served.told.state, served.frames, len(served.pullers)) for name, served in self._services.items()
            }

    # -- what the collector tells ---------------------------------------------------------------------------------

    def began(self, service: str, head: bytes) -> None:
        """See :class:`skinware.transfer.collecting.Listener`."""
        segment = segments.recorded(head, service)
        columns = [CodedColumn.of(column) for column in segment.layout.slot]
        told = Service(segment.generation, self._states.get(service, Service()).state)
        with self._lock:
            served = self._services.get(service)
            if served is None:
                send = self._link.sender(self._keys.of(service, "frame"))
                self._services[service] = _Served(send, head, columns, told)
            else:
                served.head, served.columns, served.told, served.newest = head, columns, told, None
                served.pullers.clear()
        self._states[service] = told
        self._link.tell(self._keys.services, self._told())

    def took(self, service: str, frame: Frame) -> None:
        """Likewise."""
        served = self._services[service]
        served.send(raw_message(frame))
        served.frames += 1
        with self._lock:
            served.newest = frame
            asked, served.asked = served.asked, []
        for _, question in asked:
            self._coding.submit(self._give, served, frame, question)

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
                served.told = Service(served.told.generation, state)
        self._link.tell(self._keys.services, self._told())

    # -- questions, in zenoh's threads ----------------------------------------------------------------------------

    def _clock_asked(self, question: Question) -> None:
        heard_ns = now_ns()
        question.reply(CLOCK.pack(heard_ns, now_ns()))

    def _told(self) -> bytes:
        with self._lock:
            services = {name: served.told for name, served in self._services.items()}
        return msgspec.json.encode(Services(self._instance, self._start, self._callers, services))

    def _generation_asked(self, question: Question) -> None:
        name = parts_of(question.key)[0]
        served = self._services.get(name)
        if served is None:
            question.fail(b"no such service")
            return
        self._submit(question, self._tell_generation, name, served)

    def _tell_generation(self, question: Question, name: str, served: _Served) -> None:
        operations: dict[str, str] = {}
        try:
            with self._reader(name) as reader:
                operations = reader.operations(timeout_s=_OPERATIONS_S)
        except SkinwareError:
            pass  # it takes no requests, or none now
        question.reply(generation_message(About(operations), served.head))

    def _newest_asked(self, question: Question) -> None:
        name = parts_of(question.key)[0]
        served = self._services.get(name)
        if served is None:
            question.fail(b"no such service")
            return
        known = _number(question, "generation"), _number(question, "sequence")
        with self._lock:
            newest = served.newest
            if newest is None or newest.position <= known:
                served.asked.append((now_ns(), question))
                return
        self._coding.submit(self._give, served, newest, question)

    def _give(self, served: _Served, frame: Frame, question: Question) -> None:
        """A frame to who asked for one."""
        if question.parameters.get("form") == str(RAW):
            question.reply(raw_message(frame))
            return
        who = question.parameters.get("who", "")
        base = _number(question, "base")
        puller = served.pullers.get(who)
        if puller is None or puller.generation != frame.generation:
            puller = served.pullers[who] = _Puller(Encoder(served.columns), frame.generation)
        if not base or base != puller.sequence or frame.sequence <= base:
            puller.encoder.next_is_key()
        puller.sequence = frame.sequence
        question.reply(coded_message(puller.encoder.encode(frame)))

    def _let_go(self) -> None:
        """Of questions that no frame comes for."""
        until_ns = now_ns() - _HELD_NS
        for served in self._services.values():
            with self._lock:
                late = [question for since_ns, question in served.asked if since_ns < until_ns]
                served.asked = [(since, question) for since, question in served.asked if since >= until_ns]
            for question in late:
                question.reply(b"")

    def _called(self, question: Question) -> None:
        name, operation = parts_of(question.key)
        self._submit(question, self._call, name, operation)

    def _call(self, question: Question, name: str, operation: str) -> None:
        try:
            arguments = msgspec.json.decode(question.payload, type=dict[str, Any]) if question.payload else {}
            with self._reader(name) as reader:
                answer = self._result_of(reader.ask(operation, **arguments))
        except Exception as error:  # noqa: BLE001, whoever asked is told
            answered = Answered(error=str(error), why=_why(error))
        else:
            result = msgspec.Raw(msgspec.json.encode(answer.result))
            answered = Answered(answer.generation, answer.sequence, result)
        question.reply(msgspec.json.encode(answered))

    def _result_of(self, pending: PendingRequest) -> Answer:
        """Wait for an answer, but not beyond the end of this bridge."""
        until_ns, pause_s = now_ns() + round(_CALL_S * NS_PER_S), _SHORTEST_PAUSE_S
        while not pending.done() and now_ns() < until_ns:
            if self._stopping:
                pending.cancel()
            time.sleep(pause_s)
            pause_s = min(2 * pause_s, _LONGEST_PAUSE_S)
        return pending.result(0.0)

    def _reader(self, name: str) -> ServiceReader[Frame]:
        return ServiceReader(name, namespace=self._namespace, announce=False)

    def _submit(self, question: Question, work: Callable[..., None], *arguments: object) -> None:
        with self._lock:
            if self._open_calls >= _MOST_CALLS:
                full = True
            else:
                full, self._open_calls = False, self._open_calls + 1
        if full:
            question.fail(b"too many questions at once")
            return

        def done() -> None:
            try:
                work(question, *arguments)
            finally:
                with self._lock:
                    self._open_calls -= 1

        self._calls.submit(done)


def _number(question: Question, name: str) -> int:
    text = question.parameters.get(name, "")
    return int(text) if text.isdigit() else 0


def _why(error: Exception) -> str:
    for kind, why in ((Paused, "paused"), (RequestRefused, "refused"), (RequestCancelled, "cancelled")):
        if isinstance(error, kind):
            return why
    return "failed" if isinstance(error, RequestError) else "refused"
