"""Both ends of a bus ``dds``: the participant that reads topics, and that of emulated devices, which publishes them."""

from __future__ import annotations

import contextlib
import logging
import os
import threading
from collections import deque
from collections.abc import Iterator, Sequence
from typing import Any, ClassVar

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
    TopicPort,
    TopicSource,
    parse_domain,
    record,
    samples,
)

_AT_ONCE = 16
"""Samples of a topic in one read."""
_UNREAD_NS = 5 * NS_PER_S
"""Time after which a publisher that no reader has matched is reported."""
_USER_DATA = Policy.Userdata(b"program=skinware;")  # nodes of ROS 2 warn of endpoints without any
_ALL_BITS = (1 << 64) - 1
"""Handles of matched publishers have a sign, those of samples have none."""


class _Bytes(bytes):
    """A sample as it came; Cyclone DDS adds ``sample_info``."""

    sample_info: Any


class DdsPort(TopicPort):
    """A participant that reads topics.

    Args:
        name: of the bus, for messages.
    """

    def __init__(self, name: str, domain: int, options: DdsOptions, topics: Sequence[DdsTopic]) -> None:
        super().__init__(topics)
        self._name, self._options = name, options
        self._unjudged: deque[TopicSource] = deque()
        self._rejected = 0
        self._domain, self._participant = _joined(name, domain, options)
        self._event, self._go_on = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC), threading.Event()
        self._readers: dict[int, DataReader] = {}
        with _as_bus_error(name):
            self._publications = BuiltinDataReader(self._participant, BuiltinTopicDcpsPublication)
            self._waiting = WaitingThread(self._participant, self._woke)
            self._waiting.watch(self._publications)
        self.change(topics)

    def fileno(self) -> int:
        return self._event

    def change(self, topics: Sequence[DdsTopic]) -> None:
        self.topics, self._rejected = topics, 0
        with _as_bus_error(self._name):
            for number in tuple(self._readers):
                self._waiting.forget(self._readers.pop(number))
            published = {(one.topic, one.type_name) for one in self.publishers.values()}
            for number, topic in enumerate(topics):
                if len(set(self.types_of(topic.name))) == 1 or (topic.name, topic.dds_type) in published:
                    self._subscribe(number)

    def read(self, size: int) -> bytes:  # noqa: ARG002
        """Return records of samples that have come, at most a few of each topic."""
        with contextlib.suppress(BlockingIOError):
            os.eventfd_read(self._event)
        time_ns = now_ns()
        self.look(time_ns)
        with _as_bus_error(self._name):
            records = [one for number in tuple(self._readers) for one in self._take(number, time_ns)]
            rejected = sum(reader.get_sample_rejected_status().total_count for reader in self._readers.values())
        self.dropped += rejected - self._rejected
        self._rejected = rejected
        self._go_on.set()
        return b"".join(records)

    def close(self) -> None:
        self._waiting.end()
        self._go_on.set()
        self._waiting.close()
        os.close(self._event)
        self._readers.clear()
        del self._publications, self._participant
        self._domain = None

    def _woke(self) -> None:
        """Make the descriptor readable in the waiting thread, which waits again after the next ``read``."""
        self._go_on.clear()
        os.eventfd_write(self._event, 1)
        if not self._waiting.is_over:
            self._go_on.wait()

    def judge(self, time_ns: int) -> None:
        """Add news of publishers that no reader has matched a while after they came."""
        while self._unjudged and time_ns - self._unjudged[0].came_ns >= _UNREAD_NS:
            one = self._unjudged.popleft()
            with _as_bus_error(self._name):
                readers = self._readers.values()
                matched = {each & _ALL_BITS for reader in readers for each in reader.get_matched_publications()}
            is_there = self.publishers.get(one.handle) is one
            if is_there and one.handle not in matched and one.type_name in self.types_of(one.topic):
                why = f"its type {one.type_name} has another structure, or it does not offer the qos that is asked for"
                self.news.append((logging.WARNING, f"a publisher of {one.topic} cannot be read: {why}"))

    def look(self, time_ns: int) -> bool:
        with _as_bus_error(self._name):
            found = self._publications.take(_AT_ONCE)
            for one in found:
                handle = one.sample_info.instance_handle
                if not one.sample_info.valid_data or one.sample_info.instance_state != InstanceState.Alive:
                    self.went(handle)
                elif self.came(publisher := TopicSource(handle, one.topic_name, one.type_name, time_ns)):
                    self._unjudged.append(publisher)
                    for number, topic in enumerate(self.topics):
                        if (topic.name, topic.dds_type) == publisher[1:3] and number not in self._readers:
                            self._subscribe(number)
        return bool(found)

    def _subscribe(self, number: int) -> None:
        depth = self._options.depth
        qos = _qos(self._options, Policy.History.KeepAll, Policy.ResourceLimits(depth, 1, depth))
        reader = DataReader(self._participant, _topic(self._participant, self.topics[number]), qos)
        self._readers[number] = reader
        self._waiting.watch(reader)

    def _take(self, number: int, time_ns: int) -> Iterator[bytes]:
        topic = self.topics[number]
        for sample in self._readers[number].take(_AT_ONCE):
            if not isinstance(sample, _Bytes):
                continue
            if len(sample) > LONGEST:
                self.refused += 1
            elif self.is_read(topic.name, number, sample.sample_info.publication_handle, time_ns):
                yield record(topic.number, sample.sample_info.source_timestamp, sample)


class DdsDeviceBus(StreamBus):
    """The devices' end, for emulators: ``skin-emulate --bus dds://DOMAIN`` publishes the records that it is given.

    Attributes:
        topics: to publish, by the numbers of records; the first of each number, where there are several.
    """

    scheme: ClassVar[str] = "dds"
    options_class: ClassVar[type[msgspec.Struct]] = DdsOptions
    topics: Sequence[DdsTopic] = ()

    def _parse(self, channel: str) -> int:
        return parse_domain(channel)

    def _open_port(self) -> Port:
        return _PublishingPort(self.name, self._place, self._options, self.topics)


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
    return Qos(reliability, Policy.Durability.Volatile, _USER_DATA, *policies)


def _topic(participant: DomainParticipant, topic: DdsTopic) -> Any:
    """Return a topic whose samples stay bytes."""
    made = struct_type(topic.definitions)
    made.deserialize = made.deserialize_key = _Bytes
    return Topic(participant, topic.name, made)
