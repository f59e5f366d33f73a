"""Drivers of a namespace in a ROS 2 graph, until it is stopped."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass

from skinware.conversion.showing import in_topic
from skinware.driver_snapshot import DriverSnapshot
from skinware.errors import NamespaceError
from skinware.memory import futex
from skinware.memory.namespace import Namespace
from skinware.realtime import NS_PER_S, WAIT_SLICE_NS, now_ns, period_ns, short_turns
from skinware.ros2 import diagnostics, types
from skinware.ros2.taring import Taring
from skinware.ros2.topics import DriverTopics
from skinware.ros2.transforms import Transforms
from skinware.ros2.transport import Node, Qos
from skinware.service._tap import wake_word_of
from skinware.state import WITHOUT_NEWS, life_of
from skinware.views.live import LiveDriver, LiveDrivers

RATE_HZ = 20.0
GONE = "gone"
"""What a driver does that was withdrawn."""
_LIFE_NS = NS_PER_S // 5


@dataclass(frozen=True)
class Told:
    """How a driver is, and what was told of it.

    Attributes:
        state: what it does; see :func:`skinware.state.life_of`; ``gone``: it was withdrawn.
        rate_hz: frames that it publishes; None where not known yet.
        age_ms: of its newest data; None before its first frame.
        lost: frames so far that somebody wanted each of, and that could not be taken.
        messages: that were sent so far.
        left_out: that were not sent so far, since the carrier took no more.
    """

    state: str
    rate_hz: float | None
    age_ms: float | None
    lost: int
    messages: int
    left_out: int


@dataclass
class _Served:
    """A driver that was found at any time.

    Attributes:
        topics: of it.
        end_tare: ends its service.
        frame: that was told last.
        due_ns: when the next point clouds and images are.
        look_ns: when to look whether it lives.
        is_over: that nothing newer comes was told.
        wants_frames: somebody wanted the last frame because it wants each.
        lost: see :class:`Told`.
    """

    topics: DriverTopics
    end_tare: Callable[[], None]
    frame: DriverSnapshot | None = None
    due_ns: int = 0
    look_ns: int = 0
    is_over: bool = False
    wants_frames: bool = False
    lost: int = 0

    def take(self, frame: DriverSnapshot, *, wants_frames: bool) -> None:
        before = self.frame
        if before is not None and wants_frames and self.wants_frames and frame.generation == before.generation:
            self.lost += frame.sequence - before.sequence - 1
        self.frame, self.wants_frames, self.is_over = frame, wants_frames, False


class Ros2Server:
    """Tells a ROS 2 graph of drivers; nobody there can hold them up.

    Args:
        node: of the graph.
        namespace: whose drivers.
        names: of them; none: all there are and come.
        prefix: before all topics: empty or ``/robot_1``.
        rate_hz: of point clouds and images, at most.
        root_frame: parent of all coordinate frames in ``/tf_static``; empty: no such topic.
        with_tare: offer everyone in the graph a service for each driver that tares it.
        trouble: called with what cannot be told, a line each.
    """

    def __init__(
        self,
        node: Node,
        namespace: Namespace,
        names: Collection[str] = (),
        *,
        prefix: str = "",
        rate_hz: float = RATE_HZ,
        root_frame: str = "",
        with_tare: bool = False,
        trouble: Callable[[str], object] = lambda _: None,
    ) -> None:
        self._node, self._prefix, self._trouble = node, prefix, trouble
        self._period_ns = period_ns(rate_hz)
        self._taring = Taring(node, namespace) if with_tare else None
        self._transforms = Transforms(node, root_frame) if root_frame else None
        self._live = LiveDrivers(namespace, names)
        self._served: dict[str, _Served] = {}
        self._troubles: set[str] = set()
        self._diagnostics = node.publisher("/diagnostics", types.DIAGNOSTICS, Qos())
        self._stopping = False

    def run(self, tell: Callable[[], object] = lambda: None) -> None:
        """Until ``stop``; ``tell`` is called once a second."""
        tell_ns = now_ns() + NS_PER_S
        with short_turns():
            while not self._stopping:
                words, until_ns = self._take_all(min(now_ns() + WAIT_SLICE_NS, tell_ns))
                if now_ns() >= tell_ns:
                    tell_ns = max(tell_ns + NS_PER_S, now_ns())
                    self._diagnose()
                    tell()
                futex.sleep_on(words, until_ns)

    def stop(self) -> None:
        """End it; from any thread, and from a signal handler."""
        self._stopping = True
        if self._taring is not None:
            self._taring.stop()

    def close(self) -> None:
        """Let go of all drivers, and of their topics and services. Idempotent."""
        self.stop()
        for served in self._served.values():
            served.end_tare()
            served.topics.close()
        self._diagnostics.close()
        if self._transforms is not None:
            self._transforms.close()
        self._live.close()

    def drivers(self) -> Mapping[str, Told]:
        return {name: self._told(name, served) for name, served in self._served.items()}

    # -- frames ---------------------------------------------------------------------------------------------------

    def _take_all(self, until_ns: int) -> tuple[list[tuple[futex.Word, int]], int]:
        """Tell all that is new; what to sleep on then, and until when."""
        words = []
        for live in self._look():
            served = self._served.get(live.name) or self._serve(live.name)
            if served is None:
                continue
            wants_frames, is_due = served.topics.wants_frames, now_ns() >= served.due_ns
            if not (wants_frames or is_due):
                until_ns = min(until_ns, served.due_ns)
                continue
            words.append(wake_word_of(live.reader))
            if self._live.poll(live) and live.frame is not None:
                served.take(live.frame, wants_frames=wants_frames)
                served.topics.tell(live.frame, with_pictures=is_due)
                if self._transforms is not None:
                    self._transforms.add(live.frame.structure)
                if is_due:
                    served.due_ns = max(served.due_ns + self._period_ns, now_ns() + self._period_ns // 2)
            elif not served.is_over and self._is_over(live, served):
                self._tell_last(served)
        return words, until_ns

    def _look(self) -> list[LiveDriver]:
        try:
            found = self._live.look()
        except NamespaceError as error:
            self._tell_trouble(str(error))
            return []
        for name, served in self._served.items():
            if not served.is_over and self._live.get(name) is None:
                self._tell_last(served)
        return found

    def _is_over(self, live: LiveDriver, served: _Served) -> bool:
        """Whether nothing newer comes for now: looked at now and then."""
        if now_ns() < served.look_ns or self._live.get(live.name) is not live:
            return False
        served.look_ns = now_ns() + _LIFE_NS
        return life_of(live.reader, live.frame) in WITHOUT_NEWS

    def _tell_last(self, served: _Served) -> None:
        """That all of a driver's sensors are stale, once."""
        served.is_over = True
        if served.frame is not None:
            served.topics.tell(served.frame, with_pictures=True, is_last=True)

    def _serve(self, name: str) -> _Served | None:
        topic = in_topic(name)
        if any(in_topic(other) == topic for other in self._served):
            self._tell_trouble(f"driver {name!r} is left out: another one has its topics, /skin/{topic}/...")
            return None
        topics = DriverTopics(self._node, self._prefix, name)
        end_tare = (lambda: None) if self._taring is None else self._taring.offer(f"{topics.base}/tare", name)
        self._served[name] = served = _Served(topics, end_tare)
        return served

    def _tell_trouble(self, text: str) -> None:
        if text not in self._troubles:
            self._troubles.add(text)
            self._trouble(text)

    # -- how they are -----------------------------------------------------------------------------------------------

    def _diagnose(self) -> None:
        if self._diagnostics.is_wanted:
            self._diagnostics.publish(diagnostics.message(self._statuses(), time.time_ns()))

    def _statuses(self) -> Iterator[diagnostics.Status]:
        for name in self._served:
            live = self._live.get(name)
            if live is None:
                yield diagnostics.Status(diagnostics.Level.ERROR, f"skin: {name}", GONE, "", {})
            else:
                yield from diagnostics.statuses(live)

    def _told(self, name: str, served: _Served) -> Told:
        live, topics = self._live.get(name), served.topics
        if live is None:
            return Told(GONE, 0.0, None, served.lost, topics.messages, topics.left_out)
        health = live.health()
        age_ms = None if health.age_ns is None else health.age_ns / 1e6
        return Told(health.life, health.rate_hz, age_ms, served.lost, topics.messages, topics.left_out)
