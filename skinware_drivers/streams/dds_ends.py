"""Both ends of a bus ``dds``: the participant that reads topics, and that of emulated devices, which publishes them.

A thread waits for Cyclone DDS, whose own threads would wait for the interpreter. It reads nothing, and waits again only
after the loop has read.
"""

from __future__ import annotations

import contextlib
import logging
import os
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication
from cyclonedds.core import DDSException, GuardCondition, InstanceState, ReadCondition, SampleState, ViewState, WaitSet
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from skinware.errors import BridgeError, BusNotAvailable
from skinware.realtime import NS_PER_S, now_ns
from skinware.ros2.cyclone import join, reason, struct_type, write_bytes
from skinware_drivers.options import options_from_strings
from skinware_drivers.serial.bus import SerialBus
from skinware_drivers.serial.ports import Port
from skinware_drivers.streams.dds import SOURCE_TIME, DdsOptions, DdsTopic, HeardTopic, parse_domain, record, samples

_AT_ONCE = 16
"""Samples of a topic in one read."""
_MOST_PUBLISHERS = 256
_SILENT_NS = 2 * NS_PER_S
_UNREAD_NS = 5 * NS_PER_S
"""Time after which a publisher that no reader has matched is reported."""
_NEW = SampleState.NotRead | ViewState.Any | InstanceState.Any
_LONGEST_WRITTEN = 1 << 16
_MOST_LISTED = 4096

News = tuple[int, str]
"""Level of logging, and text."""


class _Bytes(bytes):
    """A sample as it came; Cyclone DDS adds ``sample_info``."""

    sample_info: Any


@dataclass
class _Publisher:
    topic: str
    type_name: str
    came_ns: int
    is_judged: bool = False


@dataclass
class _HeardPublisher:
    """The publisher that is heard on a topic, and the number of the reader that matched it."""

    publisher: int
    reader: int
    heard_ns: int


class DdsPort(Port):
    """A participant that reads topics.

    Args:
        name: of the bus, for messages.

    Raises:
        BusNotAvailable: the domain cannot be joined.
        ConfigurationError: both the bus and ``CYCLONEDDS_URI`` choose networks.
    """

    longest_wait = 0

    def __init__(self, name: str, domain: int, options: DdsOptions, topics: Sequence[DdsTopic]) -> None:
        self._name, self._topics = name, topics
        self._sources: dict[str, _HeardPublisher] = {}
        self._publishers: dict[int, _Publisher] = {}
        self._news: list[News] = []
        self._refused = self._rejected = self._rejected_before = 0
        self._domain, self._participant = _joined(name, domain, options)
        qos = _qos(options, Policy.History.KeepAll, Policy.ResourceLimits(options.depth, 1, options.depth))
        with _as_bus_error(name):
            self._readers = [DataReader(self._participant, _topic(self._participant, topic), qos) for topic in topics]
            self._publications = BuiltinDataReader(self._participant, BuiltinTopicDcpsPublication)
            self._waiting = _WaitingThread(self._participant, [*self._readers, self._publications])

    def fileno(self) -> int:
        return self._waiting.event

    def read(self, size: int) -> bytes:  # noqa: ARG002
        """Return records of samples that have come, at most a few of each topic.

        Raises:
            BusNotAvailable: the participant cannot be used any more.
        """
        self._waiting.calm_down()
        time_ns = now_ns()
        with _as_bus_error(self._name):
            self._look(time_ns)
            records = [one for number in range(len(self._readers)) for one in self._take(number, time_ns)]
            self._rejected = sum(reader.get_sample_rejected_status().total_count for reader in self._readers)
        self._waiting.go_on.set()
        return b"".join(records)

    def write(self, data: bytes) -> int:
        """Publish nothing."""
        return len(data)

    def close(self) -> None:
        self._waiting.close()
        self._readers.clear()
        del self._publications, self._participant
        self._domain = None

    def take_unused(self) -> tuple[int, int]:
        """Return how many samples found no room since the last call, and how many were of further publishers."""
        unused = self._rejected - self._rejected_before, self._refused
        self._rejected_before, self._refused = self._rejected, 0
        return unused

    def take_news(self, time_ns: int) -> list[News]:
        """Return the news of publishers since the last call; those that came a while ago must have been matched."""
        matched: set[int] | None = None
        for publisher, one in self._publishers.items():
            if one.is_judged or time_ns - one.came_ns < _UNREAD_NS:
                continue
            one.is_judged = True
            with _as_bus_error(self._name):
                matched = {each for reader in self._readers for each in reader.get_matched_publications()}
            if publisher not in matched and one.type_name in self._types_of(one.topic):
                self._tell(
                    f"a publisher of {one.topic} cannot be read: its type {one.type_name} has another structure, or it"
                    " does not offer the qos that is asked for",
                    logging.WARNING,
                )
        news, self._news = self._news, []
        return news

    def _types_of(self, name: str) -> list[str]:
        return [topic.dds_type for topic in self._topics if topic.name == name]

    def _tell(self, text: str, level: int = logging.INFO) -> None:
        self._news.append((level, text))

    def _look(self, time_ns: int) -> None:
        """Note which publishers of the topics came or went."""
        for one in self._publications.take(_AT_ONCE):
            publisher = one.sample_info.instance_handle
            if one.sample_info.valid_data and one.sample_info.instance_state == InstanceState.Alive:
                if publisher not in self._publishers and self._types_of(one.topic_name):
                    self._welcome(publisher, _Publisher(one.topic_name, one.type_name, time_ns))
            elif (gone := self._publishers.pop(publisher, None)) is not None:
                self._tell(f"a publisher of {gone.topic} is gone")
                source = self._sources.get(gone.topic)
                if source is not None and source.publisher == publisher:
                    del self._sources[gone.topic]

    def _welcome(self, publisher: int, one: _Publisher) -> None:
        if len(self._publishers) >= _MOST_PUBLISHERS:
            return
        self._publishers[publisher] = one
        types = self._types_of(one.topic)
        if one.type_name not in types:
            self._tell(
                f"a publisher of {one.topic} cannot be read: its type is {one.type_name}, not {types[0]}",
                logging.WARNING,
            )
            return
        self._tell(f"a publisher of {one.topic} is there")
        others = sum(1 for each in self._publishers.values() if (each.topic, each.type_name) == (one.topic, types[0]))
        if others > 1:
            self._tell(f"{one.topic} has {others} publishers: only the first is read", logging.WARNING)

    def _take(self, number: int, time_ns: int) -> Iterator[bytes]:
        topic = self._topics[number]
        for sample in self._readers[number].take(_AT_ONCE):
            if isinstance(sample, _Bytes) and self._is_heard(topic.name, number, sample.sample_info, time_ns):
                yield record(topic.number, sample.sample_info.source_timestamp, sample)

    def _is_heard(self, name: str, reader: int, info: Any, time_ns: int) -> bool:
        """Return whether a sample is of the publisher that is read, which the first is until it is gone or silent.

        Two readers of a topic, for two editions of its type, match a publisher that does not show its type: one counts.
        """
        source = self._sources.get(name)
        if source is None or time_ns - source.heard_ns > _SILENT_NS:
            source = self._sources[name] = _HeardPublisher(info.publication_handle, reader, time_ns)
        if source.publisher != info.publication_handle:
            self._refused += 1
            return False
        if source.reader == reader:
            source.heard_ns = time_ns
        return source.reader == reader


class _WaitingThread:
    """A thread that makes ``event`` readable when there is something to read, until ``go_on`` is set."""

    def __init__(self, participant: DomainParticipant, readers: Sequence[Any]) -> None:
        self.event = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._waitset, self._woken = WaitSet(participant), GuardCondition(participant)
        self._conditions = [ReadCondition(reader, _NEW) for reader in readers]
        for condition in (*self._conditions, self._woken):
            self._waitset.attach(condition)
        self.go_on, self._is_over = threading.Event(), False
        self._thread = threading.Thread(target=self._run, name="skinware dds", daemon=True)
        self._thread.start()

    def calm_down(self) -> None:
        with contextlib.suppress(BlockingIOError):
            os.eventfd_read(self.event)

    def close(self) -> None:
        if self._is_over:
            return
        self._is_over = True
        self._woken.set(True)
        self.go_on.set()
        self._thread.join()
        for condition in (*self._conditions, self._woken):
            self._waitset.detach(condition)
        self._conditions.clear()
        os.close(self.event)

    def _run(self) -> None:
        while not self._is_over:
            self._waitset.wait(duration(infinite=True))
            self.go_on.clear()
            os.eventfd_write(self.event, 1)
            if not self._is_over:
                self.go_on.wait()


class DdsDeviceBus(SerialBus):
    """The devices' end, for emulators: ``skin-emulate --bus dds://DOMAIN`` publishes the records that it is given.

    Attributes:
        topics: to publish, by the numbers of records; the first of each number, where there are several.
    """

    def __init__(
        self, channel: str, options: dict[str, str] | None = None, *, payload_size: int = 8, listen_only: bool = False
    ) -> None:
        super().__init__(channel, payload_size=payload_size, listen_only=listen_only)
        self.topics: Sequence[DdsTopic] = ()
        self._options = options_from_strings(DdsOptions, options or {})
        self._domain = parse_domain(channel)

    @property
    def name(self) -> str:
        return f"bus dds://{self.channel}"

    def _open_port(self) -> Port:
        return _PublishingPort(self.name, self._domain, self._options, self.topics)


class _PublishingPort(Port):
    longest_wait = 0

    def __init__(self, name: str, domain: int, options: DdsOptions, topics: Sequence[DdsTopic]) -> None:
        self._event = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)  # never readable: nothing is heard
        self._domain, self._participant = _joined(name, domain, options)
        qos = _qos(options, Policy.History.KeepLast(options.depth))
        self._framer = samples(_LONGEST_WRITTEN).framer()
        with _as_bus_error(name):
            self._writers = {
                topic.number: DataWriter(self._participant, _topic(self._participant, topic), qos)
                for topic in reversed(topics)
            }

    def fileno(self) -> int:
        return self._event

    def read(self, size: int) -> bytes:  # noqa: ARG002
        return b""

    def write(self, data: bytes) -> int:
        """Publish the whole records; what is no sample of its topic is not published."""
        for frame in self._framer.feed(data):
            writer = self._writers.get(frame.identifier)
            if writer is not None and write_bytes is not None:
                sample = frame.body[SOURCE_TIME.end :]
                write_bytes(writer._ref, sample + bytes(-len(sample) % 4))  # noqa: SLF001, for writing bytes
        return len(data)

    def close(self) -> None:
        if self._event >= 0:
            self._writers.clear()
            del self._participant
            self._domain = None
            os.close(self._event)
            self._event = -1


def heard_topics(channel: str, options: dict[str, str], duration_s: float) -> list[HeardTopic]:
    """Join a domain for a while, and return the topics that are published there; nothing is asked or published.

    Raises:
        BusNotAvailable: the domain cannot be joined.
        ConfigurationError: no such domain, or an option is unknown or has a bad value.
    """
    name = f"bus dds://{channel}"
    domain, participant = _joined(name, parse_domain(channel), options_from_strings(DdsOptions, options))
    counts: dict[tuple[str, str], int] = {}
    with _as_bus_error(name):
        publications = BuiltinDataReader(participant, BuiltinTopicDcpsPublication)
        time.sleep(duration_s)
        for one in publications.read(_MOST_LISTED):
            if one.sample_info.valid_data and one.sample_info.instance_state == InstanceState.Alive:
                counts[one.topic_name, one.type_name] = counts.get((one.topic_name, one.type_name), 0) + 1
    del publications, participant, domain
    return [HeardTopic(topic, kind, count) for (topic, kind), count in sorted(counts.items())]


@contextlib.contextmanager
def _as_bus_error(name: str) -> Iterator[None]:
    try:
        yield
    except DDSException as error:
        raise BusNotAvailable(f"{name}: {reason(error)}") from None


def _joined(name: str, domain: int, options: DdsOptions) -> tuple[Domain | None, DomainParticipant]:
    try:
        return join(domain, options.interface)
    except BridgeError as error:
        raise BusNotAvailable(f"{name}: {error}") from None


def _qos(options: DdsOptions, *policies: Any) -> Qos:
    is_reliable = options.qos == "reliable"
    reliability = Policy.Reliability.Reliable(max_blocking_time=0) if is_reliable else Policy.Reliability.BestEffort
    return Qos(reliability, Policy.Durability.Volatile, *policies)


def _topic(participant: DomainParticipant, topic: DdsTopic) -> Any:
    """Return a topic whose samples stay bytes."""
    made = struct_type(topic.type_name, topic.texts)
    made.deserialize = made.deserialize_key = _Bytes
    return Topic(participant, topic.name, made)
