"""Build messages of ROS 2 in CDR that need no frame: diagnostics, transforms, answers, and the endpoints of a node."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from enum import IntEnum
from typing import NamedTuple

from skinware.conversion.ros_messages import Cdr
from skinware.ros2.transport import Distro, NodeIdentity

DISCOVERY_TOPIC = "ros_discovery_info"
"""Where ROS 2 publishes, over DDS, which node has which endpoints."""
PARTICIPANT_DATA = b"enclave=/;"
"""User data of a participant: without it, ROS does not count it as one of its own."""
_AT_ITS_ORIGIN = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
"""x, y, z (m), and the quaternion x, y, z, w of no rotation."""


class DiagnosticLevel(IntEnum):
    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


class DiagnosticStatus(NamedTuple):
    """A ``diagnostic_msgs/DiagnosticStatus``; ``values``: further facts, by name."""

    level: DiagnosticLevel
    name: str
    message: str
    hardware: str
    values: dict[str, str]


def diagnostics(statuses: Collection[DiagnosticStatus], time_ns: int) -> bytes:
    """Return a ``diagnostic_msgs/DiagnosticArray``; ``time_ns``: wall clock."""
    cdr = Cdr().header(time_ns, "").numbers("I", len(statuses))
    for status in statuses:
        cdr.numbers("B", status.level).text(status.name).text(status.message).text(status.hardware)
        cdr.numbers("I", len(status.values))
        for key, value in status.values.items():
            cdr.text(key).text(value)
    return cdr.done()


def transforms(parent: str, children: Collection[str], time_ns: int) -> bytes:
    """Return a ``tf2_msgs/TFMessage`` of coordinate frames that coincide with their parent; ``time_ns``: wall clock."""
    cdr = Cdr().numbers("I", len(children))
    for child in children:
        cdr.header(time_ns, parent).text(child).numbers("d", *_AT_ITS_ORIGIN)
    return cdr.done()


def trigger_response(success: bool, message: str) -> bytes:
    return Cdr().numbers("?", success).text(message).done()


def endpoint_data(type_hash: str, distro: Distro) -> bytes:
    """Return the user data of a reader or writer, which have the hash of its type."""
    return b"" if distro is Distro.HUMBLE else f"typehash={type_hash};".encode()


def entities(identity: NodeIdentity, participant: bytes, readers: Sequence[bytes], writers: Sequence[bytes]) -> bytes:
    """Return a ``rmw_dds_common/ParticipantEntitiesInfo`` of a participant with one node; ids have 16 bytes."""
    size = 24 if identity.distro is Distro.HUMBLE else 16
    cdr = Cdr().numbers("B", *participant.ljust(size, b"\0")).numbers("I", 1)
    cdr.text(identity.namespace).text(identity.name)
    for ids in (readers, writers):
        cdr.numbers("I", len(ids))
        for each in ids:
            cdr.numbers("B", *each.ljust(size, b"\0"))
    return cdr.done()
