"""Read topics of a DDS domain as a bus, each sample as the bytes that came (CDR): without ROS, and without publishing.

A sample becomes a record of a stream: ``DD 5A``, length of the record u32, number of the topic u16; the source's time
in 10 us u32; the sample with its encapsulation; CRC-32 of everything before it. All numbers are little-endian.
:func:`samples` is the framing of such streams, which captures keep.
"""

from __future__ import annotations

import logging
import struct
from collections import Counter
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Annotated, Any, ClassVar, Literal, NamedTuple

import msgspec
from msgspec import Meta

from skinware.errors import ConfigurationError, MissingExtra
from skinware.realtime import NS_PER_S, now_ns
from skinware.ros2.transport import HIGHEST_DOMAIN
from skinware.ros_types import Definitions, dds_name, ros_name
from skinware_drivers.bus import Bus
from skinware_drivers.fields import DeviceTime
from skinware_drivers.options import OptionsT
from skinware_drivers.serial.adapter import SerialAdapter
from skinware_drivers.serial.bus import SerialBus
from skinware_drivers.serial.checksums import CRC32
from skinware_drivers.serial.framing import Field
from skinware_drivers.serial.packets import Length, Packet
from skinware_drivers.serial.ports import Port
from skinware_drivers.streams.bus import MessagePort, ServerBus

log: logging.Logger = logging.getLogger("skinware.driver")

ENCAPSULATION = 4
LONGEST = 1 << 20
"""Bytes of the longest sample that is read."""
_SYNC = b"\xdd\x5a"
_HEAD = struct.Struct("<2sIHI")
_STAMP_NS = 10_000
_MOST_TROUBLES = 16
_SILENT_NS = 2 * NS_PER_S
_MOST_PUBLISHERS = 4096
SOURCE_TIME = DeviceTime(0, "<u4", _STAMP_NS / 1e9)
"""The time at which the publisher wrote a sample, in the body of its record."""


@dataclass(frozen=True)
class DdsTopic:
    """A topic that a driver reads.

    Attributes:
        name: in DDS, which ROS 2 begins with ``rt/``.
        definitions: of its type. Publishers whose type is another are not read; a topic can be declared once for each
            edition of its type, and for each of several types: those are asked for once one of them is published.
        number: identifier of its samples, 0 to 65535.
    """

    name: str
    definitions: Definitions
    number: int = 0

    @property
    def dds_type(self) -> str:
        """The name of its type in DDS."""
        return dds_name(self.definitions.type_name)


@dataclass(frozen=True)
class HeardTopic:
    """A topic of a domain.

    Attributes:
        type_name: in DDS; several topics of one name can differ in it.
        publishers: number of them.
        drivers: that can read it.
    """

    topic: str
    type_name: str
    publishers: int
    drivers: tuple[str, ...] = ()

    @property
    def ros_type(self) -> str:
        """Its type in ROS; empty if it is no type of a message."""
        return ros_name(self.type_name)


def _need_package() -> None:
    if find_spec("cyclonedds") is None:
        raise MissingExtra.of("a bus dds", "skinware[ros2]")


def samples(longest: int) -> Packet:
    """Return the framing of records.

    Args:
        longest: bytes of the longest sample, with its encapsulation.
    """
    return Packet(
        sync=_SYNC,
        length=Length(Field(2, 4), more=0),
        maximum=_HEAD.size + longest + CRC32.size,
        checksum=CRC32,
        identifier=Field(6, 2),
        header=_HEAD.size - SOURCE_TIME.end,
    )


def record(number: int, source_ns: int, sample: bytes) -> bytes:
    """Return the record of a sample that was written at a time, ns of any clock."""
    head = _HEAD.pack(_SYNC, _HEAD.size + len(sample) + CRC32.size, number, source_ns // _STAMP_NS & 0xFFFF_FFFF)
    return head + sample + CRC32.to_bytes(head + sample)


class DdsOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    interface: Annotated[
        tuple[str, ...],
        Meta(description="networks, by name or address of an interface; default: CYCLONEDDS_URI, or loopback alone"),
    ] = ()
    qos: Annotated[
        Literal["best_effort", "reliable"],
        Meta(description="reliable: ask publishers for lost samples again; only of those that offer it"),
    ] = "best_effort"
    depth: Annotated[
        int, Meta(ge=1, le=65536, description="samples of a topic that wait to be read; further ones are dropped")
    ] = 1024


def _device_end(channel: str, options: dict[str, str] | None = None, **more: Any) -> Bus:
    _need_package()
    from skinware_drivers.streams.dds_ends import DdsDeviceBus

    return DdsDeviceBus(channel, options, **more)


News = tuple[int, str]
"""Level of logging, and text."""


class TopicSource(NamedTuple):
    """A publisher; ``handle`` is its identity."""

    handle: Hashable
    topic: str
    type_name: str
    came_ns: int


@dataclass
class _ReadSource:
    """The publisher that is read on a topic, and the number of the reader that matched it."""

    publisher: Hashable
    reader: int
    heard_ns: int


class TopicPort(MessagePort):
    """Reads topics, and notes their publishers.

    Attributes:
        publishers: of all topics there, by handle.
        dropped: samples that found no room.
        news: of publishers since they were logged last.
    """

    longest_wait = 0

    def __init__(self, topics: Sequence[DdsTopic]) -> None:
        self.topics = topics
        self.publishers: dict[Hashable, TopicSource] = {}
        self.news: list[News] = []
        self._sources: dict[str, _ReadSource] = {}

    def write(self, data: bytes) -> int:
        """Publish nothing."""
        return len(data)

    def change(self, topics: Sequence[DdsTopic]) -> None:
        """Read these topics alone; those that may have several types once one of these is published.

        Raises:
            BusNotAvailable: one cannot be read.
        """
        raise NotImplementedError

    def look(self, time_ns: int) -> bool:
        """Note which publishers came or went; return whether any did."""
        raise NotImplementedError

    def judge(self, time_ns: int) -> None:
        """Add news of publishers that came a while ago and cannot be read."""

    def types_of(self, name: str) -> list[str]:
        """Return the types in DDS that a topic may have."""
        return [topic.dds_type for topic in self.topics if topic.name == name]

    def came(self, one: TopicSource) -> bool:
        """Note a publisher; return whether it is one of a topic to read."""
        types = self.types_of(one.topic)
        if one.handle in self.publishers or len(self.publishers) >= _MOST_PUBLISHERS:
            return False
        self.publishers[one.handle] = one
        if types and one.type_name not in types:
            known = types[0] if len(set(types)) == 1 else f"one of {len(types)} that are known"
            why = f"its type is {one.type_name}, not {known}"
            self.news.append((logging.WARNING, f"a publisher of {one.topic} cannot be read: {why}"))
        elif types:
            self.news.append((logging.INFO, f"a publisher of {one.topic} is there"))
            others = sum(each[1:3] == one[1:3] for each in self.publishers.values())
            if others > 1:
                self.news.append((logging.WARNING, f"{one.topic} has {others} publishers: only the first is read"))
        return bool(types)

    def went(self, handle: Hashable) -> None:
        """Note that a publisher is gone."""
        gone = self.publishers.pop(handle, None)
        if gone is not None and self.types_of(gone.topic):
            self.news.append((logging.INFO, f"a publisher of {gone.topic} is gone"))
            source = self._sources.get(gone.topic)
            if source is not None and source.publisher == handle:
                del self._sources[gone.topic]

    def is_read(self, topic: str, reader: int, publisher: Hashable, time_ns: int) -> bool:
        """Return whether a sample is of the publisher that is read: the first until it is gone or silent.

        Two readers of a topic, for two editions of its type, match a publisher that does not show its type: one counts.
        """
        source = self._sources.get(topic)
        if source is None or time_ns - source.heard_ns > _SILENT_NS:
            source = self._sources[topic] = _ReadSource(publisher, reader, time_ns)
        if source.publisher != publisher:
            self.refused += 1
            return False
        if source.reader == reader:
            source.heard_ns = time_ns
        return source.reader == reader


class TopicBus(ServerBus):
    """Topics; nothing is published.

    If several programs publish a topic, the first is read until it is gone or silent for 2 s; the samples of the others
    are counted as refused, and those that waited too long as dropped. The log reports publishers that come and go,
    that are doubled, or that cannot be read because their type is another.

    Attributes:
        topics: to read; :class:`DdsAdapter` sets them. None: not set.
    """

    topics: Sequence[DdsTopic] | None = None
    _joined: TopicPort | None = None

    def check(self) -> None:
        """Report publishers that cannot be read; that none sends is no reason to join again."""
        SerialBus.check(self)
        if self._port is not None and self._joined is not None:
            self._count(self._joined)

    def heard(self) -> list[HeardTopic]:
        """Return the topics that are published there, as far as that is known."""
        port = self._joined
        if port is None:
            return []
        while port.look(now_ns()):
            pass
        counts = Counter((one.topic, one.type_name) for one in port.publishers.values())
        return [HeardTopic(topic, kind, count) for (topic, kind), count in sorted(counts.items())]

    def read_only(self, topic: DdsTopic) -> None:
        """Read another topic in place of all others, from now on."""
        self.topics = [topic]
        if self._joined is not None:
            self._joined.change(self.topics)

    def _join(self, topics: Sequence[DdsTopic]) -> TopicPort:
        raise NotImplementedError

    def _open_port(self) -> Port:
        if self.topics is None:
            raise ConfigurationError(f"{self.name}: this driver reads no topics")
        self._joined = self._join(self.topics)
        return self._joined

    def _count(self, port: Any) -> None:
        super()._count(port)
        port.judge(now_ns())
        news, port.news = port.news, []
        for level, text in news:
            log.log(level, "%s: %s", self.name, text)


class DdsBus(TopicBus):
    """Topics of a domain. Its name is ``dds://DOMAIN?key=value``, with the number of the domain.

    It joins the domain as one participant, which publishes no topic, and never asks a publisher to send more.
    """

    scheme: ClassVar[str] = "dds"
    options_class: ClassVar[type[msgspec.Struct]] = DdsOptions
    device_end: ClassVar[Callable[..., Bus] | None] = _device_end

    def _parse(self, channel: str) -> int:
        domain = parse_domain(channel)
        _need_package()
        return domain

    def _join(self, topics: Sequence[DdsTopic]) -> TopicPort:
        from skinware_drivers.streams.dds_ends import DdsPort

        return DdsPort(self.name, self._place, self._options, topics)


def parse_domain(channel: str, scheme: str = "dds") -> int:
    """Return the number of a domain.

    Raises:
        ConfigurationError: it is none.
    """
    if not (channel.isascii() and channel.isdecimal() and int(channel[:9]) <= HIGHEST_DOMAIN):
        raise ConfigurationError(
            f"bus {scheme}://{channel}: write {scheme}://DOMAIN with a number up to 232, as {scheme}://0"
        )
    return int(channel)


class DdsAdapter(SerialAdapter[OptionsT]):
    """A driver that reads topics of DDS; its framing finds the records of :func:`samples`.

    Attributes:
        topics: that it reads, with numbers by which its layout knows them.
        reads_any_name: it reads topics of these types under any name.
        troubles: with samples that were logged so far.
    """

    topics: Sequence[DdsTopic] = ()
    reads_any_name: ClassVar[bool] = False

    def __init__(self, options: OptionsT) -> None:
        super().__init__(options)
        self.troubles: list[str] = []

    def log_once(self, text: str) -> None:
        """Log a trouble with samples; each once, and a few at most."""
        if text not in self.troubles and len(self.troubles) < _MOST_TROUBLES:
            self.troubles.append(text)
            log.warning("%s", text)

    def fit(self, bus: Bus) -> None:
        """Give the bus framing and topics."""
        super().fit(bus)
        if isinstance(bus, TopicBus):
            bus.topics = self.topics
