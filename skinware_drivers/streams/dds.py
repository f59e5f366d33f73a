"""Read topics of a DDS domain as a bus, each sample as the bytes that came (CDR): without ROS, and without publishing.

A sample becomes a record of a stream: ``DD 5A``, length of the record u32, number of the topic u16; the source's time
in 10 us u32; the sample with its encapsulation; CRC-32 of everything before it. All numbers are little-endian.
:func:`samples` is the framing of such streams, which captures keep.
"""

from __future__ import annotations

import logging
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import msgspec
from msgspec import Meta

from skinware.errors import ConfigurationError
from skinware.realtime import now_ns
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
from skinware_drivers.serial.stream import CHUNK
from skinware_drivers.streams.bus import ServerBus, need_package

if TYPE_CHECKING:
    from skinware_drivers.streams.dds_ends import DdsPort

log: logging.Logger = logging.getLogger("skinware.driver")

ENCAPSULATION = 4
LONGEST = 1 << 20
"""Bytes of the longest sample that is read."""
_PACKAGE = "cyclonedds", "ros2"
_SYNC = b"\xdd\x5a"
_HEAD = struct.Struct("<2sIHI")
_STAMP_NS = 10_000
_MOST_TROUBLES = 16
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
    need_package(f"bus dds://{channel}", *_PACKAGE)
    from skinware_drivers.streams.dds_ends import DdsDeviceBus

    return DdsDeviceBus(channel, options, **more)


class TopicBus(ServerBus):
    """A bus of topics.

    Attributes:
        topics: to read; :class:`DdsAdapter` sets them. None: not set.
    """

    topics: Sequence[DdsTopic] | None = None

    def heard(self) -> list[HeardTopic]:
        """Return the topics that are published there, as far as that is known."""
        raise NotImplementedError

    def read_only(self, topic: DdsTopic) -> None:
        """Read another topic in place of all others, from now on."""
        raise NotImplementedError


class DdsBus(TopicBus):
    """Topics of a domain. Its name is ``dds://DOMAIN?key=value``, with the number of the domain.

    It joins the domain as one participant, which publishes no topic, and never asks a publisher to send more.
    If several programs publish a topic, the first is read until it is gone or silent for 2 s; the samples of the others
    are counted as refused, and those that waited too long as dropped. The log reports publishers that come and go,
    that are doubled, or that cannot be read because their type or QoS is another.

    Raises:
        ConfigurationError: no such domain, an option is unknown or has a bad value, or the package cyclonedds is
            missing.
    """

    scheme: ClassVar[str] = "dds"
    options_class: ClassVar[type[msgspec.Struct]] = DdsOptions
    device_end: ClassVar[Callable[..., Bus] | None] = _device_end

    def __init__(
        self, channel: str, options: dict[str, str] | None = None, *, payload_size: int = 8, listen_only: bool = False
    ) -> None:
        super().__init__(channel, options, payload_size=payload_size, listen_only=listen_only)
        self.domain: int = parse_domain(channel)
        need_package(self.name, *_PACKAGE)
        self._joined: DdsPort | None = None

    def check(self) -> None:
        """Report publishers that cannot be read; that none sends is no reason to join the domain again."""
        SerialBus.check(self)
        self._report()

    def heard(self) -> list[HeardTopic]:
        return [] if self._joined is None else self._joined.heard()

    def read_only(self, topic: DdsTopic) -> None:
        self.topics = [topic]
        if self._joined is not None:
            self._joined.change(self.topics)

    def _open_port(self) -> Port:
        from skinware_drivers.streams.dds_ends import DdsPort

        if self.topics is None:
            raise ConfigurationError(f"{self.name}: this driver reads no topics")
        self._joined = DdsPort(self.name, self.domain, self._options, self.topics)
        return self._joined

    def _read(self, port: Port) -> None:
        if records := port.read(CHUNK):
            self._hear(records, now_ns())
        self._report()

    def _report(self) -> None:
        if self._joined is None or self._port is None:
            return
        dropped, refused = self._joined.take_unused()
        self.counters.dropped += dropped
        self.counters.refused += refused
        for level, text in self._joined.take_news(now_ns()):
            log.log(level, "%s: %s", self.name, text)


def parse_domain(channel: str) -> int:
    """Return the number of a domain.

    Raises:
        ConfigurationError: it is none.
    """
    if not (channel.isascii() and channel.isdecimal() and int(channel[:9]) <= HIGHEST_DOMAIN):
        raise ConfigurationError(f"bus dds://{channel}: write dds://DOMAIN with a number up to 232, as dds://0")
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
        """Give the bus framing and topics.

        Raises:
            ConfigurationError: it is another kind of bus.
        """
        super().fit(bus)
        if isinstance(bus, TopicBus):
            bus.topics = self.topics
