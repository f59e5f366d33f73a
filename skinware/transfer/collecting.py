"""Every frame of every service of a namespace, in order, with what happens to the services meanwhile."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

from skinware.drivers import Drivers
from skinware.errors import BadServiceFile, NamespaceError, Overrun, ServiceNotFound, StructureChanged
from skinware.memory import futex
from skinware.memory.announcement import Announcement
from skinware.memory.namespace import Namespace
from skinware.memory.ring import Sample
from skinware.realtime import NS_PER_S, WAIT_SLICE_NS, now_ns, short_turns
from skinware.service._tap import Tap
from skinware.wire import KIND, WISH, service_name

_DISCOVERY_NS = NS_PER_S // 50
"""Between two looks for new services: of a ring of 8 slots at 100 Hz nothing is lost meanwhile."""
PAUSED, LIVE, CLOSED, DEAD = "paused", "live", "closed", "dead"
"""How a service can be said to be."""
UNREADABLE = "unreadable"
"""Event of a service that cannot be recorded."""
_LIFE_NS = NS_PER_S // 5
"""Between two looks at who lives."""
_MOST_AT_ONCE = 64
"""Frames of one service before it is the turn of the others."""


class Listener(Protocol):
    """What is told to whom records. Nothing of it may wait for long."""

    def began(self, service: str, head: bytes) -> None:
        """A new generation of a service begins with the next frame of it; ``head`` is its file up to its slots."""

    def took(self, service: str, frame: Sample) -> None:
        """A frame, with which nothing else is done."""

    def happened(self, event: dict[str, Any]) -> None:
        """Something happened to a service, as JSON has it."""


@dataclass
class _Source:
    """A service that is read.

    Attributes:
        reader: of the service.
        generation: of the frame that was taken last, 0 before the first.
        lost: frames that are known to be lost.
        state: what was told of it last.
    """

    reader: Tap[Sample]
    generation: int = 0
    lost: int = 0
    state: str = field(default="live")


class _Taken(NamedTuple):
    """A frame, and what is to be told before it.

    Attributes:
        service: its name.
        frame: it.
        head: of its generation, if it is the first one of that.
        is_restarted: there was another generation before.
        lost: frames that were lost right before it.
    """

    service: str
    frame: Sample
    head: bytes | None
    is_restarted: bool
    lost: int


class Collector:
    """Takes frames as they come; services may come, die, come back changed, and go.

    Args:
        namespace: where they are.
        names: of services; None: all there are.
        listener: who is told.
        with_wires: drivers are asked to publish what goes over their wires; it is taken, too.
    """

    def __init__(
        self, namespace: Namespace, names: Collection[str] | None, listener: Listener, *, with_wires: bool = False
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
    def lost(self) -> int:
        """Frames that were published while this collected, and that it could not take."""
        return sum(source.reader.lost for source in self._sources.values())

    @property
    def services(self) -> list[str]:
        return sorted(self._sources)

    @property
    def slack_ns(self) -> int:
        """How long it takes the fastest writer to go round its ring; 0: not known."""
        return min((source.reader.slack_ns for source in self._sources.values()), default=0)

    def take(self) -> bool:
        """Take what is there; never waits.

        Returns:
            Whether there was anything.
        """
        time_ns = now_ns()
        if time_ns >= self._services.next_look_ns:
            self._discover()
        taken = [one for name, source in self._sources.items() for one in self._take_from(name, source)]
        for one in sorted(taken, key=lambda one: one.frame.published_ns):
            self._hand_over(one)
        if time_ns >= self._next_life_ns:
            self._next_life_ns = time_ns + _LIFE_NS
            for name, source in self._sources.items():
                self._look_at(name, source)
        return bool(taken)

    def wait(self, timeout_ns: int) -> None:
        """Sleep until a service publishes, or it is time to look for others; may come back early."""
        until_ns = min(now_ns() + timeout_ns, self._services.next_look_ns)
        words = self._services.wake_words()
        if not any(self._has_more(source) for source in self._sources.values()):
            futex.sleep_on(words, until_ns)

    def run(self, each_second: Callable[[], object]) -> None:
        """Take what comes until ``stop``.

        Args:
            each_second: called once a second, between two takes.
        """
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
        for frame in self._frames(name, source):
            is_first = frame.generation != source.generation
            is_restarted = is_first and source.generation != 0
            lost = source.reader.lost - source.lost
            yield _Taken(name, frame, source.reader.head if is_first else None, is_restarted, lost)
            source.generation = frame.generation
            source.lost += lost

    def _hand_over(self, taken: _Taken) -> None:
        if taken.head is not None:
            self._listener.began(taken.service, taken.head)
        if taken.is_restarted:
            self._tell("restarted", taken.service)
        if taken.lost:
            self._tell("lost", taken.service, count=taken.lost, before=taken.frame.sequence)
        self._listener.took(taken.service, taken.frame)

    def _frames(self, name: str, source: _Source) -> Iterator[Sample]:
        for _ in range(_MOST_AT_ONCE):
            if not (self._has_more(source) or source.reader.moved_on or source.reader.structure_changed):
                return
            try:
                frame = source.reader.next_in_order()
            except Overrun:
                return  # it is counted, and found lost at the next frame
            except StructureChanged:
                if not self._reattach(name, source):
                    return
                continue
            if frame is None:
                return
            yield frame

    def _reattach(self, name: str, source: _Source) -> bool:
        try:
            source.reader.reattach()
        except ServiceNotFound:
            return False
        except (BadServiceFile, NamespaceError) as error:
            self._tell_trouble(name, str(error))
            return False
        return True

    @staticmethod
    def _has_more(source: _Source) -> bool:
        """Whether the newest frame of the generation at hand is another than the last one that was taken."""
        latest = source.reader.latest
        return latest is not None and latest != source.reader.last_taken

    def _discover(self) -> None:
        if self._wish is not None:
            self._wish.keep()
        try:
            self._services.look()
        except NamespaceError as error:
            self._tell_trouble("", str(error))
            return
        for name, why in self._services.unreadable.items():
            self._tell_trouble(name, why)
        for name, reader in self._services.readers.items():
            if name not in self._sources:
                reader.begin_in_order(with_first=not self._is_first_look)
                self._sources[name] = _Source(reader)
                self._tell("found", name)
        self._is_first_look = False

    def _look_at(self, name: str, source: _Source) -> None:
        reader = source.reader
        if self._has_more(source):
            return  # a newer generation would take their place
        reader.refresh()
        if reader.structure_changed:
            return  # it is back, and gone over to at the next take
        state = PAUSED if reader.paused else LIVE
        if not reader.alive:
            state = CLOSED if reader.moved_on else DEAD
        if state != source.state:
            source.state = state
            self._tell(state, name)

    def _tell(self, event: str, service: str, **more: Any) -> None:
        self._listener.happened({"event": event, "service": service, "time_ns": now_ns(), **more})

    def _tell_trouble(self, name: str, text: str) -> None:
        if self._trouble.get(name) != text:
            self._trouble[name] = text
            self._tell(UNREADABLE, name, why=text)
