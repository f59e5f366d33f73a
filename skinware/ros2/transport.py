"""A node of a ROS 2 graph as Skinware needs it, whatever carries it: messages are bytes (CDR) here, types only names.

A carrier (DDS, zenoh) is a module with one class that is a :class:`Node`, made of an :class:`Identity`.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import Protocol

from skinware.errors import ConfigurationError

HIGHEST_DOMAIN = 232
"""With one above, DDS would need ports that there are not."""
_NAME = "[A-Za-z_][A-Za-z0-9_]*"

Cdr = bytes
"""A message with the four bytes that tell its encapsulation before it: CDR of version 1, little-endian."""


class Distro(Enum):
    """What differs between releases of ROS 2 for those who talk to them."""

    HUMBLE = "humble"
    """No type hashes, and 24 bytes of identity for an endpoint."""
    JAZZY = "jazzy"
    """Type hashes, and 16 bytes: from Iron on."""


@dataclass(frozen=True)
class Identity:
    """Which node of which graph.

    Attributes:
        name: of the node: letters, digits and underscores.
        namespace: of the node, absolute: ``/`` or ``/robot_1``.
        domain: id of the graph, as ``ROS_DOMAIN_ID`` has it.
        distro: of those who are to understand it.

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
        """Of absolute names of topics and services in the namespace."""
        return self.namespace.rstrip("/")


@dataclass(frozen=True)
class MessageType:
    """A type of messages.

    Attributes:
        name: as ROS has it: ``sensor_msgs/msg/PointCloud2``.
        hash: of its definition (REP 2016): ``RIHS01_`` and 64 hexadecimal digits.
    """

    name: str
    hash: str

    @property
    def dds_name(self) -> str:
        """As DDS has it: ``sensor_msgs::msg::dds_::PointCloud2_``."""
        return _dds_name(self.name)


@dataclass(frozen=True)
class ServiceType:
    """A type of services.

    Attributes:
        name: as ROS has it: ``std_srvs/srv/Trigger``.
        hash: of its definition, both messages and the event together.
        request: type of what is asked: ``std_srvs/srv/Trigger_Request``.
        response: type of the answer.
    """

    name: str
    hash: str
    request: MessageType
    response: MessageType

    @property
    def dds_name(self) -> str:
        """``std_srvs::srv::dds_::Trigger_``."""
        return _dds_name(self.name)


@dataclass(frozen=True)
class Qos:
    """What is offered to subscribers; history is always keep-last.

    Attributes:
        depth: messages that are kept for who is slow.
        reliable: what was lost on the way is sent again.
        latched: who comes late has the last ``depth`` messages, too (durability ``transient_local``).
    """

    depth: int = 5
    reliable: bool = True
    latched: bool = False


class Publisher(Protocol):
    """Sends messages under one topic; of one thread at a time."""

    @property
    def is_wanted(self) -> bool:
        """Whether anybody listens; also True where nobody knows. It costs next to nothing to ask."""

    def publish(self, message: Cdr) -> bool:
        """Send a message. Never waits for anybody.

        Returns:
            False: it was left out, since who listens is too slow, or the node was closed.
        """

    def close(self) -> None:
        """End it. Idempotent."""


Handler = Callable[[Cdr], Cdr]
"""Answers a request; may take seconds, and does not raise."""


class Node(Protocol):
    """A node of a graph. Publishers and services end with it."""

    def publisher(self, topic: str, message_type: MessageType, qos: Qos) -> Publisher:
        """What sends under an absolute topic: ``/skin/arm/points``.

        Raises:
            BridgeError: there cannot be such a publisher; the message says why.
        """

    def service(self, name: str, service_type: ServiceType, handler: Handler) -> Callable[[], None]:
        """Answer under an absolute name.

        The handler is called in a thread of the node, one request of all services after the other.

        Returns:
            What ends the service. Idempotent; waits for a request that is being answered.

        Raises:
            BridgeError: as ``publisher``.
        """

    def close(self) -> None:
        """Leave the graph. Idempotent."""


def _dds_name(name: str) -> str:
    package, kind, plain = name.split("/")
    return f"{package}::{kind}::dds_::{plain}_"
