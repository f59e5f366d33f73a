"""Which node has which endpoints: what ROS 2 tells over DDS, under a topic of its own, so that nodes have names."""

from __future__ import annotations

from collections.abc import Sequence

from skinware.conversion.ros_messages import Cdr
from skinware.ros2.transport import Distro, Identity

TOPIC = "ros_discovery_info"
PARTICIPANT_DATA = b"enclave=/;"
"""Of a participant: without it, ROS takes it for none of its own."""


def endpoint_data(type_hash: str, distro: Distro) -> bytes:
    """Of a reader or writer, in its quality of service: the hash of its type."""
    return b"" if distro is Distro.HUMBLE else f"typehash={type_hash};".encode()


def entities(identity: Identity, participant: bytes, readers: Sequence[bytes], writers: Sequence[bytes]) -> bytes:
    """A ``rmw_dds_common/ParticipantEntitiesInfo`` of a participant with one node.

    Args:
        identity: of the node.
        participant: its 16 bytes.
        readers: likewise, of all readers of the node.
        writers: of all writers.
    """
    size = 24 if identity.distro is Distro.HUMBLE else 16
    cdr = Cdr().numbers("B", *participant.ljust(size, b"\0")).numbers("I", 1)
    cdr.text(identity.namespace).text(identity.name)
    for ids in (readers, writers):
        cdr.numbers("I", len(ids))
        for each in ids:
            cdr.numbers("B", *each.ljust(size, b"\0"))
    return cdr.done()
