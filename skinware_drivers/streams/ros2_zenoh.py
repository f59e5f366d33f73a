"""Read topics of ROS 2 that rmw_zenoh carries as a bus: without ROS, and without publishing.

Keys, tokens and attachments: ros2/rmw_zenoh, commit bfc065f, ``docs/design.md``. Messages of a topic have the key
``DOMAIN/TOPIC/TYPE/HASH``. A publisher shows a token, from which the identity in its attachments is computed.
"""

from __future__ import annotations

import contextlib
import os
import threading
from collections import deque
from collections.abc import Callable, Sequence
from importlib.util import find_spec
from typing import Annotated, ClassVar

import msgspec
from msgspec import Meta

from skinware.errors import BridgeError, BusNotAvailable, ConfigurationError, MissingExtra
from skinware.realtime import now_ns
from skinware_drivers.bus import Bus
from skinware_drivers.streams.dds import LONGEST, DdsTopic, TopicBus, TopicPort, TopicSource, parse_domain, record

if find_spec("zenoh") is None or find_spec("xxhash") is None:
    raise MissingExtra.of("a bus ros2", "skinware[ros2-zenoh]")

from skinware.bridge.endpoints import DEFAULT_ROUTER
from skinware.bridge.link import ZenohLink
from skinware.ros2 import rmw_zenoh
from skinware.ros2.transport import NodeIdentity, Qos

_TOKEN_PARTS, _MOST_TOKENS = 13, 8192
_AT_ONCE = 64
"""Samples in one read."""
_OVERTAKEN = 64


class ZenohOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    router: Annotated[tuple[str, ...], Meta(description="zenoh routers, as tcp/192.168.1.10:7447")] = (DEFAULT_ROUTER,)
    depth: Annotated[
        int, Meta(ge=1, le=65536, description="samples that wait to be read; further ones are dropped")
    ] = 1024


def _no_device_end(channel: str, *_: object, **_more: object) -> Bus:
    raise ConfigurationError(f"bus ros2://{channel}: is only read: emulated devices publish on dds://{channel}")


class ZenohTopicBus(TopicBus):
    """Topics of ROS 2 over rmw_zenoh. Its name is ``ros2://DOMAIN?key=value``, with the number of the domain.

    It joins the graph as a hidden node with subscriptions. Samples whose numbers did not come count as dropped.
    """

    scheme: ClassVar[str] = "ros2"
    device_end: ClassVar[Callable[..., Bus] | None] = _no_device_end
    options_class: ClassVar[type[msgspec.Struct]] = ZenohOptions

    def _parse(self, channel: str) -> int:
        return parse_domain(channel, self.scheme)

    def _join(self, topics: Sequence[DdsTopic]) -> TopicPort:
        return ZenohPort(self.name, self._place, self._options, topics)


class ZenohPort(TopicPort):
    """A session of zenoh that reads topics.

    Args:
        name: of the bus, for messages.
    """

    def __init__(self, name: str, domain: int, options: ZenohOptions, topics: Sequence[DdsTopic]) -> None:
        super().__init__(topics)
        self._domain, self._depth = domain, options.depth
        self._samples: deque[tuple[str, bytes, bytes]] = deque()
        self._tokens: deque[tuple[str, bool]] = deque(maxlen=_MOST_TOKENS)
        self._sequences: dict[str, tuple[bytes, int]] = {}
        self._ends: list[Callable[[], None]] = []
        self._shown: set[str] = set()
        self._event = -1
        self._waking = threading.Lock()  # zenoh's threads may still wake what is being closed
        try:
            self._link = ZenohLink(rmw_zenoh.graph_endpoints(options.router))
        except BridgeError as error:
            raise BusNotAvailable(f"{name}: {error}") from None
        self._event = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._link.watch_tokens(f"@ros2_lv/{domain}/*/*/*/{rmw_zenoh.PUBLISHER}/**", self._token)
        self.change(topics)

    def fileno(self) -> int:
        return self._event

    def change(self, topics: Sequence[DdsTopic]) -> None:
        """Read these topics alone."""
        self.topics = topics
        for end in self._ends:
            end()
        names = dict.fromkeys(topic.name.removeprefix("rt/") for topic in topics)
        self._ends = [self._link.listen_attached(f"{self._domain}/{name}/*/*", self._sample) for name in names]

    def look(self, time_ns: int) -> bool:
        has_changed = bool(self._tokens)
        while self._tokens:
            token, is_there = self._tokens.popleft()
            parts = token.split("/")
            if len(parts) != _TOKEN_PARTS or parts[5] != rmw_zenoh.PUBLISHER:  # of something else
                continue
            if is_there:
                if self.came(TopicSource(rmw_zenoh.gid(token), f"rt{parts[9].replace('%', '/')}", parts[10], time_ns)):
                    self._show("/".join(parts[9:12]))
            else:
                self.went(rmw_zenoh.gid(token))
        return has_changed

    def read(self, size: int) -> bytes:  # noqa: ARG002
        """Return records of samples that have come, at most a few."""
        with contextlib.suppress(BlockingIOError):
            os.eventfd_read(self._event)
        time_ns = now_ns()
        self.look(time_ns)
        numbers = {(topic.name, topic.dds_type): topic.number for topic in reversed(self.topics)}
        records = []
        for _ in range(min(len(self._samples), _AT_ONCE)):
            key, attached, sample = self._samples.popleft()
            _, *topic, type_name, _ = key.split("/")
            number = numbers.get((name := "/".join(["rt", *topic]), type_name))
            try:
                sequence, sent_ns, publisher = rmw_zenoh.read_attachment(attached)
            except ValueError:
                number = None
            if number is None or len(sample) > LONGEST:
                self.refused += 1
            elif self.is_read(name, number, publisher, time_ns):
                last, before = self._sequences.get(name, (b"", 0))
                step = sequence - before if last == publisher else 1
                if -_OVERTAKEN <= step < 0:
                    self.refused += 1
                    continue
                self.dropped += max(0, step - 1)
                self._sequences[name] = publisher, sequence
                records.append(record(number, sent_ns, sample))
        if self._samples:
            self._wake()
        return b"".join(records)

    def close(self) -> None:
        if self._event >= 0:
            self._link.close()
            with self._waking:
                os.close(self._event)
                self._event = -1

    def _show(self, topic: str) -> None:
        """Show a subscription in the graph: many publishers send nothing while it shows none."""
        if topic not in self._shown:
            node = NodeIdentity(f"_skin_driver_{os.getpid()}", domain=self._domain)
            if not self._shown:
                self._link.declare_token(rmw_zenoh.node_token(node, self._link.zid))
            self._shown.add(topic)
            place = rmw_zenoh.place_token(node, self._link.zid, len(self._shown), rmw_zenoh.SUBSCRIPTION)
            self._link.declare_token(f"{place}/{topic}/{rmw_zenoh.qos_text(Qos(self._depth, reliable=False))}")

    def _sample(self, key: str, attachment: bytes, payload: bytes) -> None:
        """Keep a sample; called in threads of zenoh."""
        if len(self._samples) < self._depth:  # its number shows later that it is missing
            self._samples.append((key, attachment, payload[: LONGEST + 1]))
            self._wake()

    def _token(self, token: str, is_there: bool) -> None:
        self._tokens.append((token, is_there))
        self._wake()

    def _wake(self) -> None:
        with self._waking:
            if self._event >= 0:
                os.eventfd_write(self._event, 1)
