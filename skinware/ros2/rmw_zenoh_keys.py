"""What rmw_zenoh says where: keys of topics and services, tokens by which nodes are found, what goes with messages.

As its design document has it (ros2/rmw_zenoh, docs/design.md), in versions from 0.1.2 (Humble) and 0.2.4 (Jazzy) on.
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass
from enum import Enum
from importlib.util import find_spec

from skinware.errors import BridgeError, MissingExtra
from skinware.ros2.transport import Distro, Identity, MessageType, Qos, ServiceType

if find_spec("xxhash") is None:
    raise MissingExtra("ROS 2 over zenoh needs packages that are not installed: pip install 'skinware[ros2-zenoh]'")

import xxhash

_TOKENS = "@ros2_lv"
_NO_HASH = "TypeHashNotSupported"
_NAME = re.compile(r"(/[A-Za-z_]\w*)+", re.ASCII)
_ATTACHMENT = struct.Struct("<qqB16s")
_GID_BYTES = 16
_SILENT_DEPTH = 42
"""What a depth is that is not told."""


class Kind(Enum):
    """What can be found in a graph."""

    PUBLISHER = "MP"
    SERVICE = "SS"


@dataclass(frozen=True)
class Attachment:
    """What goes with each message, request and response.

    Attributes:
        sequence: of what its sender sent, from 1 on; a response has that of its request.
        time_ns: when it was sent, ns since 1970.
        gid: 16 bytes that tell the sender from all others; a response has that of its request.
    """

    sequence: int
    time_ns: int
    gid: bytes

    def packed(self) -> bytes:
        """Its 33 bytes."""
        return _ATTACHMENT.pack(self.sequence, self.time_ns, _GID_BYTES, self.gid)

    @classmethod
    def of(cls, data: bytes) -> Attachment:
        """The attachment that bytes are.

        Raises:
            ValueError: they are none.
        """
        try:
            sequence, time_ns, gid_bytes, gid = _ATTACHMENT.unpack(data)
        except struct.error:
            raise ValueError(f"an attachment has {_ATTACHMENT.size} bytes, not {len(data)}") from None
        if gid_bytes != _GID_BYTES:
            raise ValueError(f"an identity has {_GID_BYTES} bytes, not {gid_bytes}")
        return cls(sequence, time_ns, gid)


def key(identity: Identity, name: str, of_type: MessageType | ServiceType) -> str:
    """Under which messages of a topic, or requests to a service, go.

    Args:
        identity: of the node.
        name: of the topic or service, absolute.
        of_type: of its messages.

    Raises:
        BridgeError: ROS has no such name.
    """
    if not _NAME.fullmatch(name):
        raise BridgeError(f"{name!r} is no absolute name of a topic or service in ROS 2, as /skin/arm/points is")
    return f"{identity.domain}{name}/{of_type.dds_name}/{_hash(identity, of_type)}"


def node_token(identity: Identity, session: str, node: int) -> str:
    """By which a node is found.

    Args:
        identity: of the node.
        session: id of zenoh's session.
        node: its number in the session.
    """
    return "/".join((_TOKENS, str(identity.domain), session, str(node), str(node), "NN", *_of_node(identity)))


def endpoint_token(
    identity: Identity,
    session: str,
    node: int,
    endpoint: int,
    kind: Kind,
    name: str,
    of_type: MessageType | ServiceType,
    qos: Qos,
) -> str:
    """By which a publisher or a service is found.

    Args:
        identity: of its node.
        session: id of zenoh's session.
        node: number of its node in the session.
        endpoint: its own number there.
        kind: of it.
        name: of its topic, or of the service; absolute.
        of_type: of its messages.
        qos: what it offers.
    """
    place = (_TOKENS, str(identity.domain), session, str(node), str(endpoint), kind.value, *_of_node(identity))
    return "/".join((*place, _mangled(name), of_type.dds_name, _hash(identity, of_type), qos_text(qos)))


def qos_text(qos: Qos) -> str:
    """Reliability, durability, history, deadline, lifespan and liveliness; nothing stands for what is usual."""
    reliability = "" if qos.reliable else "2"
    durability = "1" if qos.latched else ""
    depth = "" if qos.depth == _SILENT_DEPTH else qos.depth
    return f"{reliability}:{durability}:,{depth}:,:,:,,"


def gid(token: str) -> bytes:
    """The identity of who has a token, 16 bytes: all in the graph compute the same."""
    return xxhash.xxh3_128_digest(token.encode())[::-1]


def _of_node(identity: Identity) -> tuple[str, str, str]:
    return "%", _mangled(identity.namespace), identity.name


def _mangled(name: str) -> str:
    return name.replace("/", "%")


def _hash(identity: Identity, of_type: MessageType | ServiceType) -> str:
    return _NO_HASH if identity.distro is Distro.HUMBLE else of_type.hash
