"""The node of a ROS 2 graph, independent of its carrier. Messages are bytes (CDR), and types only names.

A carrier (DDS, zenoh) is a module with one class that is a :class:`Node`, made of an :class:`NodeIdentity`.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import Protocol

from skinware.errors import ConfigurationError
from skinware.ros_types import dds_name

HIGHEST_DOMAIN = 232
"""A higher one would need DDS ports beyond 65535."""
_NAME = "[A-Za-z_][A-Za-z0-9_]*"

Cdr = bytes
"""A message after the four bytes of its encapsulation: CDR of version 1, little-endian."""
Handler = Callable[[Cdr], Cdr]
"""Answers a request; may take seconds, and does not raise."""


class Distro(Enum):
    """Releases of ROS 2 that differ for their peers."""

    HUMBLE = "humble"
    """No type hashes, and 24 bytes of identity for an endpoint."""
    JAZZY = "jazzy"
    """Type hashes, and 16 bytes; from Iron on."""


@dataclass(frozen=True)
class NodeIdentity:
    """A node and its graph.

    Attributes:
        name: of the node: letters, digits and underscores.
        namespace: of the node, absolute: ``/`` or ``/robot_1``.
        domain: id of the graph, as ``ROS_DOMAIN_ID``.
        distro: release of the peers.

    Raises:
        ConfigurationError: there is no such node; the message says why.
    """

    name: str
    namespace: str = "/"
    domain: int = 0
    distro: Distro = Distro.JAZZY

    def __post_init__(self) -> None:
        if not re.fullmatch(_NAME, self.name):
            raise ConfigurationError(f"node {self.name!r}: give letters, digits and underscores, no digit first")
        if not re.fullmatch(rf"/|(/{_NAME})+", self.namespace):
            raise ConfigurationError(f"namespace {self.namespace!r} of ROS: give / or names after slashes, as /robot_1")
        if not 0 <= self.domain <= HIGHEST_DOMAIN:
            raise ConfigurationError(f"domain {self.domain} of ROS: give 0 to {HIGHEST_DOMAIN}")

    @property
    def prefix(self) -> str:
        """The namespace before an absolute name: empty or ``/robot_1``."""
        return self.namespace.rstrip("/")


@dataclass(frozen=True)
class MessageType:
    """A type of messages.

    Attributes:
        name: in ROS: ``sensor_msgs/msg/PointCloud2``.
        hash: of its definition (REP 2016): ``RIHS01_`` and 64 hexadecimal digits.
    """

    name: str
    hash: str

    @property
    def dds_name(self) -> str:
        """Its name in DDS: ``sensor_msgs::msg::dds_::PointCloud2_``."""
        return dds_name(self.name)


@dataclass(frozen=True)
class ServiceType(MessageType):
    """A type of services; its hash is that of both messages and the event together."""

    request: MessageType
    response: MessageType


@dataclass(frozen=True)
class Qos:
    """Quality of service that is offered to subscribers; history is always keep-last.

    Attributes:
        depth: messages that are kept for a slow subscriber.
        reliable: send lost messages again.
        latched: give the last ``depth`` messages to late subscribers (durability ``transient_local``).
    """

    depth: int = 5
    reliable: bool = True
    latched: bool = False


class TopicPublisher(Protocol):
    """Sends messages under one topic; for one thread at a time."""

    @property
    def is_wanted(self) -> bool:
        """Whether there are subscribers; also True if that is not known. This costs next to nothing."""

    def publish(self, message: Cdr) -> bool:
        """Send a message without waiting.

        Returns:
            False: it was left out, because a subscriber is too slow or the node was closed.
        """

    def close(self) -> None:
        """End it. Idempotent."""


class Node(Protocol):
    """A node of a graph. Publishers and services end with it."""

    def publisher(self, topic: str, message_type: MessageType, qos: Qos) -> TopicPublisher:
        """Return a publisher of an absolute topic: ``/skin/arm/points``.

        Raises:
            BridgeError: there cannot be such a publisher; the message says why.
        """

    def service(self, name: str, service_type: ServiceType, handler: Handler) -> Callable[[], None]:
        """Answer requests under an absolute name.

        A thread of the node calls the handlers, one request of all services after the other.

        Returns:
            A function that ends the service. Idempotent; waits for a request that is being answered.

        Raises:
            BridgeError: as ``publisher``.
        """

    def close(self) -> None:
        """Leave the graph. Idempotent."""
