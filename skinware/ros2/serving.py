"""Publish the drivers of a namespace in a ROS 2 graph: topics, diagnostics, and taring."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from skinware.conversion import ros_messages
from skinware.conversion.showing import Showing, in_topic
from skinware.conversion.tables import sensor_names
from skinware.driver_snapshot import DriverSnapshot
from skinware.errors import NamespaceError
from skinware.memory import futex
from skinware.memory.namespace import Namespace
from skinware.realtime import NS_PER_S, WAIT_SLICE_NS, now_ns, period_ns, short_turns
from skinware.ros2 import messages
from skinware.ros2.messages import DiagnosticLevel, DiagnosticStatus, diagnostics, trigger_response
from skinware.ros2.transport import Node, Qos, TopicPublisher
from skinware.service import ServiceReader
from skinware.service._reader import wake_word_of
from skinware.state import DEAD, LIVE, PAUSED, SILENT, WITHOUT_NEWS, life_of
from skinware.status import BusState, Status
from skinware.structure import Structure
from skinware.views.live import LiveDriver, LiveDrivers

RATE_HZ = 20.0
GONE = "gone"
"""State of a driver that was withdrawn."""
_LIFE_NS = NS_PER_S // 5
_TARE_S = 10.0
_LEVEL_OF_LIFE = {SILENT: DiagnosticLevel.STALE, PAUSED: DiagnosticLevel.WARN, DEAD: DiagnosticLevel.ERROR}
_LEVEL_OF_BUS = {
    BusState.LIVE.name.lower(): DiagnosticLevel.OK,
    BusState.CONNECTING.name.lower(): DiagnosticLevel.WARN,
    BusState.SILENT.name.lower(): DiagnosticLevel.WARN,
}


_LATCHED = Qos(depth=1, latched=True)
_STALE = np.uint8(Status.STALE)


class DriverTopics:
    """The topics of a driver, which begin with ``base``.

    Attributes:
        left_out: number of those that were not sent, because a subscriber is too slow.
    """

    def __init__(self, node: Node, prefix: str, name: str) -> None:
        self._node, self._prefix, self._name = node, prefix, name
        self.base: str = f"{prefix}/skin/{in_topic(name)}"
        self.messages = self.left_out = 0
        self._structure: Structure | None = None
        self._generation = 0
        self._showing: Showing | None = None
        self._pictures: dict[str, TopicPublisher] = {}
        self._frames = node.publisher(f"{self.base}/frame", messages.SKIN_FRAME, Qos())
        self._sensors = node.publisher(f"{self.base}/sensors", messages.SENSORS, _LATCHED)

    @property
    def wants_frames(self) -> bool:
        """Whether there are subscribers that want each frame."""
        return self._frames.is_wanted

    def publish(self, frame: DriverSnapshot, *, with_pictures: bool, is_last: bool = False) -> None:
        """Publish a frame under all topics that have subscribers.

        Args:
            is_last: no newer frame comes for now: all sensors are stale.
        """
        time_ns = time.time_ns() - (now_ns() - frame.published_ns)
        status = frame.status | _STALE if is_last else frame.status
        if frame.generation != self._generation:
            self._begin(frame, time_ns)
        if self._frames.is_wanted:
            self._send(self._frames, ros_messages.skin_frame(frame, time_ns, status))
        if with_pictures and self._showing is not None:
            wanted = {topic for topic, picture in self._pictures.items() if picture.is_wanted}
            for message in self._showing.pictures(frame, time_ns, status=status, wanted=wanted.__contains__):
                self._send(self._pictures[message.topic], message.data)

    def close(self) -> None:
        for publisher in (self._frames, self._sensors, *self._pictures.values()):
            publisher.close()

    def _begin(self, frame: DriverSnapshot, time_ns: int) -> None:
        """Publish the sensors of a new generation; open and close topics of pictures."""
        structure, self._generation = frame.structure, frame.generation
        if structure is not self._structure:
            self._structure, self._showing = structure, Showing(self._name, structure)
            topics = self._showing.topics
            for topic in self._pictures.keys() - topics.keys():
                self._pictures.pop(topic).close()
            for topic, schema in topics.items():
                if topic not in self._pictures:
                    message_type = messages.OF_SCHEMAS[schema.name]
                    self._pictures[topic] = self._node.publisher(self._prefix + topic, message_type, Qos())
        sensors = ros_messages.sensors(structure, sensor_names(structure), frame.generation, time_ns)
        self._send(self._sensors, sensors)

    def _send(self, publisher: TopicPublisher, message: bytes) -> None:
        if publisher.publish(message):
            self.messages += 1
        else:
            self.left_out += 1


@dataclass(frozen=True)
class ServedReport:
    """State of a driver, and traffic of its topics.

    Attributes:
        state: as :func:`skinware.state.life_of`; ``gone``: it was withdrawn.
        rate_hz: frames that it publishes; None: not known yet.
        age_ms: of its newest data; None: no frame so far.
        missed: frames so far that a subscriber wanted and that could not be taken.
        left_out: messages that were not sent, because the carrier took no more.
    """

    state: str
    rate_hz: float | None
    age_ms: float | None
    missed: int
    messages: int
    left_out: int


@dataclass
class _ServedDriver:
    """A driver that was found at any time.

    Attributes:
        due_ns: when point clouds and images are due.
        look_ns: when to look whether it lives.
        is_over: its frame was published as the last one.
        wants_frames: each frame was wanted when the newest one was taken.
    """

    topics: DriverTopics
    end_tare: Callable[[], None] = lambda: None
    frame: DriverSnapshot | None = None
    due_ns: int = 0
    look_ns: int = 0
    is_over: bool = False
    wants_frames: bool = False
    missed: int = 0

    def take(self, frame: DriverSnapshot, *, wants_frames: bool) -> None:
        before = self.frame
        if before is not None and wants_frames and self.wants_frames and frame.generation == before.generation:
            self.missed += frame.sequence - before.sequence - 1
        self.frame, self.wants_frames, self.is_over = frame, wants_frames, False

    def publish_last(self) -> None:
        """Publish all sensors as stale, once."""
        self.is_over = True
        if self.frame is not None:
            self.topics.publish(self.frame, with_pictures=True, is_last=True)


class Ros2Server:
    """Publishes drivers in a ROS 2 graph; nothing there can hold them up.

    Args:
        prefix: before all topics: empty or ``/robot_1``.
        rate_hz: of point clouds and images, at most.
        with_tare: offer everyone in the graph a service for each driver that tares it.
        trouble: called with each new problem, one line.
    """

    def __init__(
        self,
        node: Node,
        namespace: Namespace,
        names: Collection[str] = (),
        *,
        prefix: str = "",
        rate_hz: float = RATE_HZ,
        with_tare: bool = False,
        trouble: Callable[[str], object] = lambda _: None,
    ) -> None:
        self._node, self._prefix, self._trouble = node, prefix, trouble
        self._period_ns = period_ns(rate_hz)
        self._with_tare = with_tare
        self._live = LiveDrivers(namespace, names)
        self._served: dict[str, _ServedDriver] = {}
        self._troubles: set[str] = set()
        self._diagnostics = node.publisher("/diagnostics", messages.DIAGNOSTICS, Qos())
        self._stopping = False
        self._turning = threading.RLock()  # readers are for one thread at a time

    def run(self, each_second: Callable[[], object] = lambda: None) -> None:
        """Run until ``stop``; call ``each_second`` once a second."""
        second_ns = now_ns() + NS_PER_S
        with short_turns():
            while not self._stopping:
                with self._turning:
                    words, until_ns = self._take_all(min(now_ns() + WAIT_SLICE_NS, second_ns))
                if now_ns() >= second_ns:
                    second_ns = max(second_ns + NS_PER_S, now_ns())
                    if self._diagnostics.is_wanted:
                        self._diagnostics.publish(diagnostics(list(self._statuses()), time.time_ns()))
                    each_second()
                futex.sleep_on(words, until_ns)

    def stop(self) -> None:
        """End it; from any thread, and from a signal handler."""
        self._stopping = True

    def close(self) -> None:
        """Release all drivers, their topics and services. Idempotent."""
        self.stop()
        for served in self._served.values():
            served.end_tare()
            served.topics.close()
        self._diagnostics.close()
        self._live.close()

    def drivers(self) -> Mapping[str, ServedReport]:
        """Return the state of all drivers that were found at any time, by name; from any thread."""
        reports = {}
        with self._turning:
            for name, served in self._served.items():
                live, traffic = self._live.get(name), (served.missed, served.topics.messages, served.topics.left_out)
                if live is None:
                    reports[name] = ServedReport(GONE, 0.0, None, *traffic)
                    continue
                report = live.report()
                age_ms = None if report.age_ns is None else report.age_ns / 1e6
                reports[name] = ServedReport(report.life, report.rate_hz, age_ms, *traffic)
        return reports

    # -- frames ---------------------------------------------------------------------------------------------------

    def _take_all(self, until_ns: int) -> tuple[list[tuple[futex.Word, int]], int]:
        """Publish all new frames; return what to sleep on, and until when."""
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
                served.topics.publish(live.frame, with_pictures=is_due)
                if is_due:
                    served.due_ns = max(served.due_ns + self._period_ns, now_ns() + self._period_ns // 2)
            elif not served.is_over and now_ns() >= served.look_ns and self._live.get(live.name) is live:
                served.look_ns = now_ns() + _LIFE_NS
                if life_of(live.reader, live.frame) in WITHOUT_NEWS:
                    served.publish_last()
        return words, until_ns

    def _look(self) -> list[LiveDriver]:
        try:
            found = self._live.look()
        except NamespaceError as error:
            self._report_once(str(error))
            return []
        for name, served in self._served.items():
            if not served.is_over and self._live.get(name) is None:
                served.publish_last()
        return found

    def _serve(self, name: str) -> _ServedDriver | None:
        topic = in_topic(name)
        if any(in_topic(other) == topic for other in self._served):
            self._report_once(f"driver {name!r} is left out: another one has its topics, /skin/{topic}/...")
            return None
        topics = DriverTopics(self._node, self._prefix, name)
        self._served[name] = served = _ServedDriver(topics)
        if self._with_tare:
            served.end_tare = self._node.service(f"{topics.base}/tare", messages.TRIGGER, lambda _: self._tare(name))
        return served

    def _report_once(self, text: str) -> None:
        if text not in self._troubles:
            self._troubles.add(text)
            self._trouble(text)

    # -- taring and diagnostics -----------------------------------------------------------------------------------

    def _tare(self, driver: str) -> bytes:
        """Tare a driver; return the response, also that of a driver that cannot be tared."""
        try:
            with ServiceReader(driver, namespace=self._live.namespace, announce=False) as reader:
                reader.ask("tare").result(_TARE_S, lambda: self._stopping)
        except Exception as error:  # noqa: BLE001, the caller gets it
            return trigger_response(False, str(error))
        return trigger_response(True, "")

    def _statuses(self) -> Iterator[DiagnosticStatus]:
        for name in self._served:
            live = self._live.get(name)
            if live is None:
                yield DiagnosticStatus(DiagnosticLevel.ERROR, f"skin: {name}", GONE, "", {})
            else:
                yield from _statuses_of(live)


def _statuses_of(driver: LiveDriver) -> Iterator[DiagnosticStatus]:
    """Yield the status of a driver, and of each of its buses while it lives."""
    report = driver.report()
    is_live = report.life == LIVE
    words = f"{report.fresh} of {report.sensors} sensors are fresh" if is_live else report.life
    level = _LEVEL_OF_LIFE.get(report.life, DiagnosticLevel.WARN)
    if is_live and report.age_ns is not None and report.fresh == report.sensors:
        level = DiagnosticLevel.OK
    values = {"state": report.life, "sensors": str(report.sensors)}
    if report.rate_hz is not None:
        values["rate_hz"] = f"{report.rate_hz:.1f}"
    if report.age_ns is not None:
        values["age_ms"] = f"{report.age_ns / NS_PER_S * 1e3:.1f}"
    patches = {f"patches {state}": n for state, n in report.patch_states.items()}
    counts = {**report.statuses, **patches, **report.counters}
    values |= {name: str(count) for name, count in counts.items() if count}
    yield DiagnosticStatus(level, f"skin: {driver.name}", words, driver.reader.driver_type, values)
    for bus in report.buses if is_live else ():
        words = ": ".join(filter(None, (bus.state, bus.reason)))
        level = _LEVEL_OF_BUS.get(bus.state, DiagnosticLevel.ERROR)
        yield DiagnosticStatus(level, f"skin: {driver.name}: {bus.name}", words, bus.name, {})
