"""Both ends of a bus ``dds``: the participant that reads topics, and that of emulated devices, which publishes them."""

from __future__ import annotations

import contextlib
import logging
import os
from collections import Counter, deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import msgspec
from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication
from cyclonedds.core import DDSException, InstanceState
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic

from skinware.errors import BridgeError, BusNotAvailable
from skinware.realtime import NS_PER_S, now_ns
from skinware.ros2.cyclone import WaitingThread, join, reason, struct_type, write_bytes
from skinware_drivers.serial.ports import Port
from skinware_drivers.streams.bus import StreamBus
from skinware_drivers.streams.dds import (
    LONGEST,
    SOURCE_TIME,
    DdsOptions,
    DdsTopic,
    HeardTopic,
    parse_domain,
    record,
    samples,
)

_AT_ONCE = 16
"""Samples of a topic in one read."""
_SILENT_NS = 2 * NS_PER_S
_UNREAD_NS = 5 * NS_PER_S
"""Time after which a publisher that no reader has matched is reported."""
_MOST_PUBLISHERS = 4096
_ALL_BITS = (1 << 64) - 1
"""Handles of matched publishers have a sign, those of samples have none."""

News = tuple[int, str]
"""Level of logging, and text."""


class _Bytes(bytes):
    """A sample as it came; Cyclone DDS adds ``sample_info``."""

    sample_info: Any


class _Publisher(NamedTuple):
    handle: int
    topic: str
    type_name: str
    came_ns: int


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
        self._name, self._topics, self._options = name, topics, options
        self._publishers: dict[int, _Publisher] = {}
        self._unjudged: deque[_Publisher] = deque()
        self._sources: dict[str, _HeardPublisher] = {}
        self._news: list[News] = []
        self._refused = self._rejected = self._rejected_before = 0
        self._domain, self._participant = _joined(name, domain, options)
        self._readers: dict[int, DataReader] = {}
        with _as_bus_error(name):
            self._publications = BuiltinDataReader(self._participant, BuiltinTopicDcpsPublication)
            self._waiting = WaitingThread(self._participant, self._publications)
        self.change(topics)

    def fileno(self) -> int:
        return self._waiting.event

    def change(self, topics: Sequence[DdsTopic]) -> None:
        """Read these topics alone; those that may have several types once one of these is published.

        Raises:
            BusNotAvailable: one cannot be read.
        """
        self._topics = topics
        with _as_bus_error(self._name):
            for number in tuple(self._readers):
                self._waiting.forget(self._readers.pop(number))
            published = {(one.topic, one.type_name) for one in self._publishers.values()}
            for number, topic in enumerate(topics):
                if len(set(self._types_of(topic.name))) == 1 or (topic.name, topic.dds_type) in published:
                    self._subscribe(number)

    def heard(self) -> list[HeardTopic]:
        """Return the topics that are published."""
        with _as_bus_error(self._name):
            while self._look(now_ns()):
                pass
        counts = Counter((one.topic, one.type_name) for one in self._publishers.values())
        return [HeardTopic(topic, kind, count) for (topic, kind), count in sorted(counts.items())]

    def read(self, size: int) -> bytes:  # noqa: ARG002
        """Return records of samples that have come, at most a few of each topic.

        Raises:
            BusNotAvailable: the participant cannot be used any more.
        """
        self._waiting.calm_down()
        time_ns = now_ns()
        with _as_bus_error(self._name):
            self._look(time_ns)
            records = [one for number in tuple(self._readers) for one in self._take(number, time_ns)]
            readers = self._readers.values()
            self._rejected = sum(reader.get_sample_rejected_status().total_count for reader in readers)
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
        while self._unjudged and time_ns - self._unjudged[0].came_ns >= _UNREAD_NS:
            one = self._unjudged.popleft()
            with _as_bus_error(self._name):
                readers = self._readers.values()
                matched = {each & _ALL_BITS for reader in readers for each in reader.get_matched_publications()}
            is_there = self._publishers.get(one.handle) is one
            if is_there and one.handle not in matched and one.type_name in self._types_of(one.topic):
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

    def _look(self, time_ns: int) -> bool:
        """Note which publishers came or went; return whether any did."""
        found = self._publications.take(_AT_ONCE)
        for one in found:
            handle = one.sample_info.instance_handle
            if one.sample_info.valid_data and one.sample_info.instance_state == InstanceState.Alive:
                if handle not in self._publishers and len(self._publishers) < _MOST_PUBLISHERS:
                    publisher = _Publisher(handle, one.topic_name, one.type_name, time_ns)
                    self._publishers[handle] = publisher
                    if types := self._types_of(one.topic_name):
                        self._welcome(publisher, types)
            elif (gone := self._publishers.pop(handle, None)) is not None and self._types_of(gone.topic):
                self._tell(f"a publisher of {gone.topic} is gone")
                source = self._sources.get(gone.topic)
                if source is not None and source.publisher == handle:
                    del self._sources[gone.topic]
        return bool(found)

    def _welcome(self, one: _Publisher, types: Sequence[str]) -> None:
        self._unjudged.append(one)
        for number, topic in enumerate(self._topics):
            if (topic.name, topic.dds_type) == (one.topic, one.type_name) and number not in self._readers:
                self._subscribe(number)
        if one.type_name not in types:
            known = types[0] if len(set(types)) == 1 else f"one of {len(types)} that are known"
            self._tell(
                f"a publisher of {one.topic} cannot be read: its type is {one.type_name}, not {known}",
                logging.WARNING,
            )
            return
        self._tell(f"a publisher of {one.topic} is there")
        others = sum(
            1 for each in self._publishers.values() if (each.topic, each.type_name) == (one.topic, one.type_name)
        )
        if others > 1:
            self._tell(f"{one.topic} has {others} publishers: only the first is read", logging.WARNING)

    def _subscribe(self, number: int) -> None:
        depth = self._options.depth
        qos = _qos(self._options, Policy.History.KeepAll, Policy.ResourceLimits(depth, 1, depth))
        reader = DataReader(self._participant, _topic(self._participant, self._topics[number]), qos)
        self._readers[number] = reader
        self._waiting.watch(reader)

    def _take(self, number: int, time_ns: int) -> Iterator[bytes]:
        topic = self._topics[number]
        for sample in self._readers[number].take(_AT_ONCE):
            if not isinstance(sample, _Bytes):
                continue
            if len(sample) > LONGEST:
                self._refused += 1
            elif self._is_heard(topic.name, number, sample.sample_info, time_ns):
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


class DdsDeviceBus(StreamBus):
    """The devices' end, for emulators: ``skin-emulate --bus dds://DOMAIN`` publishes the records that it is given.

    Attributes:
        topics: to publish, by the numbers of records; the first of each number, where there are several.
    """

    scheme: ClassVar[str] = "dds"
    options_class: ClassVar[type[msgspec.Struct]] = DdsOptions
    topics: Sequence[DdsTopic] = ()

    def _open_port(self) -> Port:
        return _PublishingPort(self.name, parse_domain(self.channel), self._options, self.topics)


class _PublishingPort(Port):
    longest_wait = 0

    def __init__(self, name: str, domain: int, options: DdsOptions, topics: Sequence[DdsTopic]) -> None:
        self._event = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)  # never readable: nothing is heard
        self._domain, self._participant = _joined(name, domain, options)
        self._name, self._qos = name, _qos(options, Policy.History.KeepLast(options.depth))
        self._framer = samples(LONGEST).framer()
        self._topics = {topic.number: topic for topic in reversed(topics)}
        self._writers: dict[int, DataWriter] = {}

    def fileno(self) -> int:
        return self._event

    def read(self, size: int) -> bytes:  # noqa: ARG002
        return b""

    def write(self, data: bytes) -> int:
        """Publish the whole records; what is no sample of its topic is not published."""
        for frame in self._framer.feed(data):
            topic = self._topics.get(frame.identifier)
            if topic is not None and write_bytes is not None:
                writer = self._writers.get(topic.number) or self._publish(topic)
                sample = frame.body[SOURCE_TIME.end :]
                write_bytes(writer._ref, sample + bytes(-len(sample) % 4))  # noqa: SLF001, for writing bytes
        return len(data)

    def _publish(self, topic: DdsTopic) -> DataWriter:
        with _as_bus_error(self._name):
            writer = DataWriter(self._participant, _topic(self._participant, topic), self._qos)
        self._writers[topic.number] = writer
        return writer

    def close(self) -> None:
        if self._event >= 0:
            self._writers.clear()
            del self._participant
            self._domain = None
            os.close(self._event)
            self._event = -1


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
    made = struct_type(topic.definitions)
    made.deserialize = made.deserialize_key = _Bytes
    return Topic(participant, topic.name, made)
