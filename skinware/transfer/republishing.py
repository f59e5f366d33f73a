"""Publish frames again under the names of their services, each by a writer of its own."""

from __future__ import annotations

import contextlib
import select
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy.typing as npt

from skinware.errors import NameInUse
from skinware.memory.namespace import Namespace
from skinware.memory.schema import STATIC_NAME
from skinware.realtime import NS_PER_S, now_ns
from skinware.service import Request, ServiceWriter
from skinware.transfer.collecting import CLOSED, DEAD, LIVE, PAUSED
from skinware.transfer.generation import Generation, RecordedSample

_TIMES_OF_DRIVERS = ("module_time_ns", "group_time_ns", "bus_since_ns")
"""Columns with times of CLOCK_MONOTONIC; 0: never, or not known."""


@dataclass
class Published:
    """A service that is published.

    Attributes:
        fd: readable when requests come.
        generation: original one of the newest frame.
        speed: of the replay when the writer's generation began; its rate depends on it.
        was_paused: the original writer is paused.
        waiting: requests for a newer frame, each with the time at which it came.
    """

    writer: ServiceWriter
    fd: int
    generation: Generation
    speed: float
    was_paused: bool = False
    waiting: list[tuple[int, Request]] = field(default_factory=list)


class Republisher:
    """Publishes frames of a recording, or of another machine.

    By default all times of a frame are moved by the time between its two publications, so that ages stay as they were.

    Args:
        operations: that every service offers, also while it is paused.
        keeps_times: publish times as they were recorded.
        keeps_counts: frames keep their numbers, so that readers know what they lost even if another process published
            before; otherwise a new writer counts on from the one before.

    Attributes:
        frames: number of published frames of each service.
        speed: 2.0 for twice the recorded speed; readers see it in the rate.
    """

    def __init__(
        self,
        namespace: Namespace,
        operations: Mapping[str, Callable[..., object]],
        *,
        keeps_times: bool = False,
        keeps_counts: bool = False,
    ) -> None:
        self._namespace, self._operations = namespace, operations
        self._keeps_times, self._keeps_counts = keeps_times, keeps_counts
        self._services: dict[str, Published] = {}
        self._deserted: dict[str, Generation] = {}
        self._surplus: list[str] = []
        self._counts: dict[str, int] = {}  # the original number of the newest frame
        self._paused = False
        self._epoll = select.epoll()
        self._calls: dict[int, Callable[[], object]] = {}
        self.frames: Counter[str] = Counter()
        self.speed: float = 1.0

    def shift_ns(self, frame: RecordedSample) -> int:
        """Return by how much to move the times of a frame that is published now."""
        return now_ns() - frame.published_ns

    def operations_of(self, name: str) -> Mapping[str, Callable[..., object]]:  # noqa: ARG002
        return self._operations

    def publish(self, name: str, frame: RecordedSample, generation: Generation, *, follows: bool = True) -> None:
        """Publish a frame now; unless it ``follows`` the one before, another generation is no restart."""
        if name in self._surplus:
            self._surplus.remove(name)
        count = generation.published_before + frame.sequence
        service = self._service(name, generation, count, follows)
        writer = service.writer
        service.was_paused = False
        if writer.paused:
            writer.resume()
        lost = max(0, count - self._counts.get(name, count) - 1) if follows else 0
        if lost and (lost + 1) % writer.slots == 0:  # the frame would get the slot of the newest one, or miss one more
            self._restructure(service, skip=lost)
            lost = 0
        columns = writer.begin(skip=lost, contents=frame.slot)
        shift_ns = self.shift_ns(frame)  # last: filling the columns takes time
        if generation.is_driver and not self._keeps_times:
            for into in (columns[column] for column in _TIMES_OF_DRIVERS if column in columns):
                into[into != 0] += shift_ns
        acquired_ns = frame.acquired_ns + shift_ns if frame.acquired_ns else 0
        if self._paused:
            writer.pause()  # or a reader that looks now takes the frame for one that grows old
        writer.commit(frame.acquired_ns if self._keeps_times else acquired_ns, frame.flags)
        self._counts[name] = count
        self.frames[name] += 1
        answered = [request for time_ns, request in service.waiting if time_ns <= acquired_ns]
        service.waiting = [(t, r) for t, r in service.waiting if t > acquired_ns and not r.cancelled]
        for request in answered:
            request.reply(position=writer.position)
        if self._paused:
            self._apply_pause(service)

    def happened(self, name: str, event: str) -> None:
        """Apply an event of the original service."""
        service = self._services.get(name)
        if service is None:
            return
        if event in (PAUSED, LIVE):
            service.was_paused = event == PAUSED
            self._apply_pause(service)
        elif event in (CLOSED, DEAD):
            self._remove(name, deserted=event == DEAD)

    def pause(self, paused: bool) -> None:
        self._paused = paused
        for service in self._services.values():
            self._apply_pause(service)

    def withdraw_later(self, name: str) -> None:
        """Withdraw a service at the next ``tidy``, so that the request that caused it is answered before."""
        self._surplus.append(name)

    def tidy(self) -> None:
        """Withdraw services that are not needed any more, and keep the files of the others."""
        for name in self._surplus:
            if name in self._services:
                self._remove(name)
        self._surplus.clear()
        for service in self._services.values():
            service.writer.keep_files()

    def watch(self, fd: int, call: Callable[[], object]) -> None:
        """Make ``answer`` call something whenever a descriptor can be read."""
        self._calls[fd] = call
        self._epoll.register(fd, select.EPOLLIN)

    def unwatch(self, fd: int) -> None:
        if self._calls.pop(fd, None) is not None:
            with contextlib.suppress(OSError):  # it is closed
                self._epoll.unregister(fd)

    def answer(self, timeout_s: float) -> None:
        """Carry out requests; wait for the first so long, in full milliseconds."""
        for fd, _ in self._epoll.poll(timeout_s):
            call = self._calls.get(fd)
            if call is not None:
                call()

    def close(self) -> None:
        for name in list(self._services):
            self._remove(name)
        for name, generation in list(self._deserted.items()):
            del self._deserted[name]
            with contextlib.suppress(NameInUse):
                self._new_writer(name, generation).close()
        self._epoll.close()

    def _service(self, name: str, generation: Generation, count: int, follows: bool) -> Published:
        service = self._services.get(name)
        if service is not None and service.generation is generation and service.speed == self.speed:
            return service
        if service is not None:
            old = service.generation
            if (old.kind, old.slot_count) != (generation.kind, generation.slot_count):
                self._remove(name)
                service = None
        if service is None:
            return self._begin(name, generation, count)
        before, service.generation = service.generation, generation
        restarted = follows and before.generation != generation.generation
        if restarted or before.digest != generation.digest or service.speed != self.speed:
            self._restructure(service)
            service.speed = self.speed
        return service

    def _restructure(self, service: Published, skip: int = 0) -> None:
        generation = service.generation
        static, rate_hz = _tables(generation), self._rate_hz(generation)
        service.writer.restructure(generation.schema.columns, static, rate_hz=rate_hz, skip=skip)

    def _begin(self, name: str, generation: Generation, count: int) -> Published:
        published_before = count - 1 if self._keeps_counts else None
        writer = self._new_writer(name, generation, published_before)
        if published_before is not None:
            self._counts[name] = published_before
        self._deserted.pop(name, None)
        server = writer.request_server()
        server.while_paused, server.why_no_others = frozenset(self._operations), "this is a recording"
        service = self._services[name] = Published(writer, server.fileno(), generation, self.speed)
        self.watch(service.fd, lambda: self.take_requests(name, service))
        return service

    def _new_writer(self, name: str, generation: Generation, published_before: int | None = None) -> ServiceWriter:
        return ServiceWriter(
            name,
            generation.schema.columns,
            _tables(generation),
            namespace=self._namespace,
            kind=generation.kind,
            slots=generation.slot_count,
            rate_hz=self._rate_hz(generation),
            description=generation.schema.description,
            operations=self.operations_of(name),
            published_before=published_before,
        )

    def _rate_hz(self, generation: Generation) -> float | None:
        return NS_PER_S / generation.period_ns * self.speed if generation.period_ns else None

    def _apply_pause(self, service: Published) -> None:
        paused = self._paused or service.was_paused
        if paused != service.writer.paused:
            (service.writer.pause if paused else service.writer.resume)()
        if paused:
            for _, request in service.waiting:
                request.fail("the service is paused", "paused")
            service.waiting.clear()

    def take_requests(self, name: str, service: Published) -> None:  # noqa: ARG002
        service.waiting += [(now_ns(), request) for request in service.writer.answer_requests()]

    def _remove(self, name: str, *, deserted: bool = False) -> None:
        service = self._services.pop(name)
        self.unwatch(service.fd)
        if deserted:
            service.writer.desert()
            self._deserted[name] = service.generation
        else:
            service.writer.close()


def _tables(generation: Generation) -> dict[str, npt.NDArray[Any]]:
    return {table: column for table, column in generation.static().items() if table != STATIC_NAME}
