"""Take every frame of every service of a namespace, in order, with the events of the services."""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

from skinware.drivers import Drivers
from skinware.errors import BadServiceFile, NamespaceError, Overrun, ServiceNotFound, StructureChanged
from skinware.memory import futex
from skinware.memory.announcement import Announcement
from skinware.memory.namespace import Namespace
from skinware.memory.ring import Sample
from skinware.realtime import NS_PER_S, WAIT_SLICE_NS, now_ns, short_turns
from skinware.service._reader import Tap
from skinware.wire import KIND, WISH, service_name

log = logging.getLogger(__name__)

_DISCOVERY_NS = NS_PER_S // 50
"""Between two looks for new services: a ring of 8 slots at 100 Hz loses nothing meanwhile."""
PAUSED, LIVE, CLOSED, DEAD = "paused", "live", "closed", "dead"
"""States of a service, and events that begin them."""
UNREADABLE = "unreadable"
"""Event of a service that cannot be read."""
_LIFE_NS = NS_PER_S // 5
"""Between two looks whether services live."""
_MOST_AT_ONCE = 64
"""Frames of one service that are taken before those of the others."""


class FrameListener(Protocol):
    """Gets frames and events. None of its methods may wait for long."""

    def began(self, service: str, head: bytes) -> None:
        """Begin a new generation of a service with its next frame; ``head`` is its file up to its slots."""

    def took(self, service: str, frame: Sample) -> None:
        """Take a frame; nothing else uses it."""

    def happened(self, event: dict[str, Any]) -> None:
        """Take an event of a service, as JSON has it."""


@dataclass
class _Source:
    reader: Tap[Sample]
    generation: int = 0
    missed: int = 0
    state: str = LIVE

    @property
    def has_more(self) -> bool:
        """Whether the newest frame of this generation is another than the last one that was taken."""
        latest = self.reader.newest_position
        return latest is not None and latest != self.reader.last_taken


class _Taken(NamedTuple):
    """A frame, and the events before it; ``head`` of its generation if it is the first one."""

    service: str
    frame: Sample
    head: bytes | None
    is_restarted: bool
    missed: int


class Collector:
    """Takes frames as they come; services may come, die, come back changed, and go.

    Args:
        names: of services; None: all.
        with_wires: ask drivers to publish the frames of their buses, and take those, too.
    """

    def __init__(
        self, namespace: Namespace, names: Collection[str] | None, listener: FrameListener, *, with_wires: bool = False
    ) -> None:
        self._wish = Announcement(namespace, WISH) if with_wires else None
        if names is not None and with_wires:
            names = [*names, *(service_name(name) for name in names)]
        self._services: Drivers[Tap[Sample]] = Drivers(
            namespace,
            Tap,
            names,
            wants=lambda reader: with_wires or reader.kind != KIND,  # another program wants the wires
            only_living=True,
            every_ns=_DISCOVERY_NS,
        )
        self._listener = listener
        self._sources: dict[str, _Source] = {}
        self._next_life_ns = 0
        self._is_first_look = True
        self._trouble: dict[str, str] = {}
        self._stopping = False

    @property
    def missed(self) -> int:
        """Frames that were published meanwhile and could not be taken."""
        return sum(source.reader.missed for source in self._sources.values())

    @property
    def services(self) -> list[str]:
        return sorted(self._sources)

    @property
    def slack_ns(self) -> int:
        """Time in which the fastest writer fills its ring, ns; 0: not known."""
        return min((source.reader.slack_ns for source in self._sources.values()), default=0)

    def take(self) -> bool:
        """Take all frames that wait; return whether there were any."""
        time_ns = now_ns()
        if time_ns >= self._services.next_look_ns:
            self._discover()
        taken = [one for name, source in self._sources.items() for one in self._take_from(name, source)]
        for one in sorted(taken, key=lambda one: one.frame.published_ns):
            if one.head is not None:
                self._listener.began(one.service, one.head)
            if one.is_restarted:
                self._report("restarted", one.service)
            if one.missed:
                self._report("missed", one.service, count=one.missed, before=one.frame.sequence)
            self._listener.took(one.service, one.frame)
        if time_ns >= self._next_life_ns:
            self._next_life_ns = time_ns + _LIFE_NS
            for name, source in self._sources.items():
                self._look_at(name, source)
        return bool(taken)

    def wait(self, timeout_ns: int) -> None:
        """Sleep until a service publishes, or it is time to look for others; may return early."""
        until_ns = min(now_ns() + timeout_ns, self._services.next_look_ns)
        words = self._services.wake_words()
        if not any(source.has_more for source in self._sources.values()):
            futex.sleep_on(words, until_ns)

    def run(self, each_second: Callable[[], object]) -> None:
        """Take frames until ``stop``; call ``each_second`` once a second, between two takes."""
        second_ns = now_ns() + NS_PER_S
        with short_turns():
            while not self._stopping:
                self.take()
                if now_ns() >= second_ns:
                    second_ns = max(second_ns + NS_PER_S, now_ns())
                    each_second()
                self.wait(WAIT_SLICE_NS)

    def stop(self) -> None:
        """End ``run``; from any thread, and from a signal handler."""
        self._stopping = True

    def close(self) -> None:
        self._services.close()
        if self._wish is not None:
            self._wish.close()

    def _take_from(self, name: str, source: _Source) -> Iterator[_Taken]:
        reader = source.reader
        for _ in range(_MOST_AT_ONCE):
            if not (source.has_more or reader.moved_on or reader.structure_changed):
                return
            try:
                frame = reader.next_in_order()
            except Overrun:
                return  # it counts as missed before the next frame
            except StructureChanged:
                try:
                    reader.reattach()
                except ServiceNotFound:
                    return
                except (BadServiceFile, NamespaceError) as error:
                    self._report_trouble(name, str(error))
                    return
                continue
            if frame is None:
                return
            before, missed_before = source.generation, source.missed
            source.generation, source.missed = frame.generation, reader.missed
            is_first = frame.generation != before
            head = reader.head if is_first else None
            yield _Taken(name, frame, head, is_first and before != 0, reader.missed - missed_before)

    def _discover(self) -> None:
        if self._wish is not None:
            self._wish.keep()
        try:
            self._services.look()
        except NamespaceError as error:
            self._report_trouble("", str(error))
            return
        for name, why in self._services.unreadable.items():
            self._report_trouble(name, why)
        for name, reader in self._services.readers.items():
            if name not in self._sources:
                reader.begin_in_order(with_first=not self._is_first_look)
                self._sources[name] = _Source(reader)
                self._report("found", name)
        self._is_first_look = False

    def _look_at(self, name: str, source: _Source) -> None:
        reader = source.reader
        if source.has_more:
            return  # a newer generation would take their place
        reader.refresh()
        if reader.structure_changed:
            return  # it is back, and the next take attaches to it
        state = PAUSED if reader.paused else LIVE
        if not reader.alive:
            state = CLOSED if reader.moved_on else DEAD
        if state != source.state:
            source.state = state
            self._report(state, name)

    def _report(self, event: str, service: str, **more: Any) -> None:
        self._listener.happened({"event": event, "service": service, "time_ns": now_ns(), **more})

    def _report_trouble(self, name: str, text: str) -> None:
        if self._trouble.get(name) != text:
            self._trouble[name] = text
            log.warning("%s%s", f"{name} is left out: " if name else "", text)
            self._report(UNREADABLE, name, why=text)
