"""Record all samples of all services.

One thread takes samples from the rings and never waits for the disk; another codes, compresses and writes them. If the
second one cannot keep up (a slow disk), samples wait in memory; if that is full, they are not taken, and count as
missed.
"""

from __future__ import annotations

import contextlib
import json
import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

from mcap.records import Channel, Schema

from skinware.errors import BadRecording
from skinware.limits import LIMITS
from skinware.memory import segments
from skinware.memory.namespace import Namespace
from skinware.memory.ring import Sample
from skinware.realtime import NS_PER_S, WAIT_SLICE_NS, boot, now_ns, short_turns
from skinware.recording.files import CHUNK_NS, Head, PendingChunk, SampleStream, Target
from skinware.recording.topics import CLOCK, EVENTS, FRAME, GENERATION, Channels
from skinware.recording.wire import message_of
from skinware.transfer.codec import CodedColumn, FrameEncoder
from skinware.transfer.collecting import UNREADABLE, Collector
from skinware.transfer.generation import Generation, disguised
from skinware.wire import COLUMNS, KIND

_CLOCK_NS = _REPORT_NS = NS_PER_S
_MOST_WAITING = 128 << 20
"""Bytes of samples in memory."""
_LONGEST_REST_NS = 10_000_000
_MOST_NEWS = 100

_READINGS = 3
_LEAST_STEP_NS = NS_PER_S // 20  # a busy machine may delay a reading by less

STEPPED, SUSPENDED = "clock_stepped", "suspended"
"""Events that belong to no service."""


class Clocks(NamedTuple):
    """Clocks of the machine at one moment, ns.

    Attributes:
        realtime_ns: CLOCK_REALTIME, the wall clock.
        boottime_ns: CLOCK_BOOTTIME: CLOCK_MONOTONIC plus the time in which the machine was suspended.
    """

    monotonic_ns: int
    realtime_ns: int
    boottime_ns: int


def read_clocks() -> Clocks:
    """Read all clocks a few times, and return the reading that took the shortest time."""
    readings = []
    for _ in range(_READINGS):
        before_ns = time.monotonic_ns()
        realtime_ns, boottime_ns = time.time_ns(), time.clock_gettime_ns(time.CLOCK_BOOTTIME)
        after_ns = time.monotonic_ns()
        readings.append((after_ns - before_ns, Clocks((before_ns + after_ns) // 2, realtime_ns, boottime_ns)))
    return min(readings)[1]


class TimeAxis:
    """The times of a recording's messages; ``clocks``: the last reading.

    CLOCK_MONOTONIC, which never jumps, orders them. MCAP tools see it plus one constant: the difference to the wall
    clock when the recording began. The wall clock of each message is only a label beside it.
    """

    def __init__(self, read: Callable[[], Clocks] = read_clocks) -> None:
        self._read = read
        self.clocks: Clocks = read()
        self._origin_ns = self.clocks.realtime_ns - self.clocks.monotonic_ns

    def log_ns(self, monotonic_ns: int) -> int:
        """Return the time that orders a message: ns since 1970 by a wall clock that was never set since."""
        return monotonic_ns + self._origin_ns

    def wall_ns(self, monotonic_ns: int) -> int:
        return monotonic_ns + self.clocks.realtime_ns - self.clocks.monotonic_ns

    def look(self) -> list[dict[str, Any]]:
        """Read the clocks again. Return an event if the machine was suspended, and one if the wall clock was set."""
        before, now = self.clocks, self._read()
        self.clocks = now
        passed_ns = now.monotonic_ns - before.monotonic_ns
        suspended_ns = now.boottime_ns - before.boottime_ns - passed_ns
        stepped_ns = now.realtime_ns - before.realtime_ns - passed_ns - suspended_ns
        found = [(SUSPENDED, "for_ns", suspended_ns), (STEPPED, "by_ns", stepped_ns)]
        return [
            {"event": event, "service": "", "time_ns": now.monotonic_ns, name: value_ns}
            for event, name, value_ns in found
            if abs(value_ns) >= _LEAST_STEP_NS
        ]


Renderer = Callable[[str, Generation, Sample, int], Iterable[tuple[str, str, Schema, bytes]]]
"""Makes messages for viewers of a service's sample: (topic, encoding, schema, data) of each.

It gets the service, the generation, the sample, and its time of publication, ns since 1970 on the recording's axis.
"""


class Recorder:
    """Records until it is stopped.

    Args:
        target: destination of the recording; the recorder completes it.
        with_wires: also record the frames and bytes on the wires of the drivers.
        disguise: replaces names of buses and texts of options; None: they are written as they are.
        renderer: makes messages for viewers, recorded beside the samples.
    """

    def __init__(
        self,
        target: Target,
        *,
        names: Collection[str] | None = None,
        namespace: Namespace | str | None = None,
        with_wires: bool = False,
        disguise: Callable[[str], str] | None = None,
        renderer: Renderer | None = None,
        clocks: Callable[[], Clocks] = read_clocks,
    ) -> None:
        self._target = target
        self._bytes_given = 0
        self._coder = _Coder(target, disguise, renderer, TimeAxis(clocks))
        self._collector = Collector(Namespace.of(namespace), names, self, with_wires=with_wires)
        self._collector.take()  # later services are recorded from their first sample on
        self._stopping = False

    @property
    def missed(self) -> int:
        return self._collector.missed

    @property
    def services(self) -> list[str]:
        return self._collector.services

    @property
    def messages(self) -> dict[str, int]:
        names = self._coder.channels.names()
        return {names[channel]: count for channel, count in sorted(self._target.counts.items())}

    def news(self) -> list[dict[str, Any]]:
        """Return events of the machine since the last call: it was suspended, its wall clock was set."""
        news = self._coder.news
        return [news.popleft() for _ in range(len(news))]

    def run(self, duration_s: float | None = None, report: Callable[[], object] = lambda: None) -> None:
        """Record until ``stop``, until the time is over, or until the target is full.

        Args:
            duration_s: how long; None: without end.
            report: called once a second.
        """
        end_ns = None if duration_s is None else now_ns() + round(duration_s * NS_PER_S)
        report_ns = now_ns() + _REPORT_NS
        self._coder.start()
        try:
            with short_turns():
                while not (self._stopping or self._coder.failure or self._target.is_full):
                    if end_ns is not None and now_ns() >= end_ns:
                        break
                    if now_ns() >= report_ns:
                        report_ns = max(report_ns + _REPORT_NS, now_ns())
                        report()
                    waiting = self._bytes_given - self._coder.bytes_done
                    taken = waiting < _MOST_WAITING and self._collector.take()
                    if taken:  # take together the samples that come soon
                        time.sleep(min(_LONGEST_REST_NS, self._collector.slack_ns // 4) / NS_PER_S)
                    self._collector.wait(WAIT_SLICE_NS // 5)
                if not self._coder.failure:
                    self._collector.take()
        finally:
            self._coder.jobs.put(None)
            self._coder.join()
            self._collector.close()
        if self._coder.failure:
            raise self._coder.failure

    def stop(self) -> None:
        """End the recording; from any thread, and from a signal handler."""
        self._stopping = True

    def save(self) -> None:
        """Write the chunks in memory (:class:`skinware.recording.files.Past`); from any thread."""
        self._coder.jobs.put(self._coder.save)

    def mark(self, text: str, time_ns: int) -> None:
        """Record an event ``mark`` that happened at a time, CLOCK_MONOTONIC; from any thread."""
        event = {"event": "mark", "service": "", "time_ns": time_ns, "text": text}
        self._coder.jobs.put(partial(self._coder.add_json, EVENTS, event, time_ns))

    # -- the collector's listener ---------------------------------------------------------------------------------

    def began(self, service: str, head: bytes) -> None:
        self._coder.jobs.put(partial(self._coder.begin, service, head))

    def took(self, service: str, frame: Sample) -> None:
        self._bytes_given += len(frame.slot)
        self._coder.jobs.put(partial(self._coder.take, service, frame))

    def happened(self, event: dict[str, Any]) -> None:
        self._coder.jobs.put(partial(self._coder.add_json, EVENTS, event))


@dataclass(frozen=True)
class _WireStream:
    driver: str
    buses: list[str]
    about: dict[str, Any]


class _Coder(threading.Thread):
    """Codes samples, fills chunks, and hands them to the target when they are due, by ``jobs``; None: the end."""

    def __init__(
        self,
        target: Target,
        disguise: Callable[[str], str] | None,
        renderer: Renderer | None,
        axis: TimeAxis,
    ) -> None:
        super().__init__(name="skinware recorder")
        self.channels = Channels()
        self.bytes_done = 0
        self.failure: Exception | None = None
        self.jobs: queue.SimpleQueue[Callable[[], object] | None] = queue.SimpleQueue()
        self._target, self._disguise, self._renderer = target, disguise, renderer
        self._streams: dict[str, SampleStream | _WireStream | None] = {}  # None: it cannot be recorded
        self._pending = PendingChunk()
        self._abouts = 0
        self._due_ns = 0
        self._next_clock_ns = now_ns()
        self._axis = axis
        self.news: deque[dict[str, Any]] = deque(maxlen=_MOST_NEWS)

    def run(self) -> None:
        try:
            while True:
                if now_ns() >= self._next_clock_ns:
                    self._look_around()
                if now_ns() >= self._due_ns or self._pending.is_large:
                    self._pending.move_to(self._target)
                is_empty = self._pending.chunk.is_empty
                until_ns = self._next_clock_ns if is_empty else min(self._due_ns, self._next_clock_ns)
                try:
                    job = self.jobs.get(timeout=max(0, until_ns - now_ns()) / NS_PER_S)
                except queue.Empty:
                    continue
                if job is None:
                    break
                job()
            self._pending.move_to(self._target)
        except Exception as error:  # noqa: BLE001, Recorder.run raises it
            self.failure = error
        try:
            self._target.finish()
        except OSError as error:
            self.failure = self.failure or error

    def take(self, service: str, frame: Sample) -> None:
        stream = self._streams[service]
        if isinstance(stream, _WireStream):
            bus = int(frame.column("bus")[()])
            if bus < len(stream.buses):
                channel, schema = self.channels.of_wire(stream.driver, stream.buses[bus])
                self._add(channel, schema, frame.sequence, frame.published_ns, message_of(frame))
        elif stream is not None:
            channel, schema = self.channels.of_service(service, FRAME)
            self._begin_chunk()
            time_ns, wall_ns = self._axis.log_ns(frame.published_ns), self._axis.wall_ns(frame.published_ns)
            self._pending.add_sample(channel, schema, frame, time_ns, stream, wall_ns)
            if self._renderer is not None and stream.generation is not None:
                for topic, encoding, known, data in self._renderer(service, stream.generation, frame, time_ns):
                    self._add(*self.channels.of(topic, encoding, known), frame.sequence, frame.published_ns, data)
        self.bytes_done += len(frame.slot)

    def save(self) -> None:
        self._pending.move_to(self._target)
        self._target.save()

    def begin(self, service: str, head: bytes) -> None:
        segment = segments.recorded(head, service)
        stride = segment.layout.slot_stride
        if stride > LIMITS.slot_size:
            why = f"frames of {stride} bytes; at most {LIMITS.slot_size} are recorded"
            event = {"event": UNREADABLE, "service": service, "time_ns": now_ns(), "why": why}
            self._streams[service] = None
            self.add_json(EVENTS, event)
            self.news.append(event)
            return
        wires = _wires_of(segment)
        if wires is not None:
            self._begin_wires(service, wires)
            return
        if self._disguise is not None:
            with contextlib.suppress(BadRecording):  # an unreadable head is kept as it is
                head = disguised(head, service, self._disguise)
        before = self._streams.get(service)
        number = before.head.sequence + 1 if isinstance(before, SampleStream) else 1
        channel, schema = self.channels.of_service(service, GENERATION)
        columns = segment.layout.slot
        encoder = FrameEncoder([CodedColumn.of(column) for column in columns])
        generation = None
        if self._renderer is not None:
            with contextlib.suppress(BadRecording):  # viewers cannot show an unreadable driver
                generation = Generation(head, service)
        self._streams[service] = SampleStream(Head(channel, schema, number, head), encoder, generation)

    def _begin_wires(self, service: str, wires: _WireStream) -> None:
        if self._disguise is not None:
            buses = [self._disguise(bus) for bus in wires.buses]
            wires = _WireStream(wires.driver, buses, _texts_disguised(wires.about, self._disguise))
        before = self._streams.get(service)
        self._streams[service] = wires
        if wires.about and not (isinstance(before, _WireStream) and before == wires):
            about = {**wires.about, "buses": dict(zip(wires.buses, wires.about.get("buses", ()), strict=False))}
            self._abouts += 1
            channel, schema = self.channels.of_about(wires.driver)
            self._pending.heads.add(Head(channel, schema, self._abouts, json.dumps(about).encode()))

    def add_json(self, topic: str, data: dict[str, Any], monotonic_ns: int | None = None) -> None:
        channel, schema = self.channels.of_all(topic)
        self._add(channel, schema, 0, now_ns() if monotonic_ns is None else monotonic_ns, json.dumps(data).encode())

    def _add(self, channel: Channel, schema: Schema, sequence: int, monotonic_ns: int, data: bytes) -> None:
        self._begin_chunk()
        axis = self._axis
        self._pending.chunk.add(channel, schema, sequence, axis.log_ns(monotonic_ns), data, axis.wall_ns(monotonic_ns))

    def _look_around(self) -> None:
        """Record the clocks, and make sure that the target still exists; once a second."""
        self._next_clock_ns = now_ns() + _CLOCK_NS
        for event in self._axis.look():
            self.news.append(event)
            self.add_json(EVENTS, event, event["time_ns"])
        clocks = self._axis.clocks
        self.add_json(CLOCK, {**clocks._asdict(), "boot": boot()}, clocks.monotonic_ns)
        self._target.check()

    def _begin_chunk(self) -> None:
        if self._pending.chunk.is_empty:
            self._due_ns = now_ns() + CHUNK_NS


def _wires_of(segment: segments.Segment) -> _WireStream | None:
    columns = {column.name for column in segment.layout.slot}
    if bytes(segment.header["kind"]).decode() != KIND or columns != COLUMNS.keys():
        return None
    tables = segment.static_columns()
    texts = [bytes(text).decode(errors="replace") for name in ("driver", "bus_name") for text in tables.get(name, ())]
    about: dict[str, Any] = {}
    with contextlib.suppress(ValueError, IndexError, KeyError):
        about = dict(json.loads(bytes(tables["about"][0])))
    return _WireStream(texts[0], texts[1:], about) if texts else None


def _texts_disguised(data: Any, disguise: Callable[[str], str]) -> Any:
    if isinstance(data, str):
        return disguise(data)
    if isinstance(data, list):
        return [_texts_disguised(each, disguise) for each in data]
    if isinstance(data, dict):
        return {name: _texts_disguised(each, disguise) for name, each in data.items()}
    return data
