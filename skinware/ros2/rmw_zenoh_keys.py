"""Keys, tokens and attachments of rmw_zenoh.

Source: its design document (ros2/rmw_zenoh, docs/design.md), from versions 0.1.2 (Humble) and 0.2.4 (Jazzy) on.
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass
from enum import Enum
from importlib.util import find_spec

from skinware.errors import BridgeError, MissingExtra
from skinware.ros2.transport import Distro, MessageType, NodeIdentity, Qos

if find_spec("xxhash") is None:
    raise MissingExtra("ROS 2 over zenoh needs packages that are not installed: pip install 'skinware[ros2-zenoh]'")

import xxhash

_TOKENS = "@ros2_lv"
_NO_HASH = "TypeHashNotSupported"
_NAME = re.compile(r"(/[A-Za-z_]\w*)+", re.ASCII)
_ATTACHMENT = struct.Struct("<qqB16s")
_GID_BYTES = 16
_DEFAULT_DEPTH = 42
"""Depth that is not written."""


class EndpointKind(Enum):
    """Kinds of endpoints."""

    PUBLISHER = "MP"
    SERVICE = "SS"


@dataclass(frozen=True)
class MessageAttachment:
    """The attachment of a message, request or response.

    Attributes:
        sequence: number of the message, by its sender, from 1 on; a response has that of its request.
        time_ns: when it was sent, ns since 1970.
        gid: identity of the sender, 16 bytes; a response has that of its request.
    """

    sequence: int
    time_ns: int
    gid: bytes

    def packed(self) -> bytes:
        """Return its 33 bytes."""
        return _ATTACHMENT.pack(self.sequence, self.time_ns, _GID_BYTES, self.gid)

    @classmethod
    def of(cls, data: bytes) -> MessageAttachment:
        """Read an attachment.

        Raises:
            ValueError: it is malformed.
        """
        try:
            sequence, time_ns, gid_bytes, gid = _ATTACHMENT.unpack(data)
        except struct.error:
            raise ValueError(f"an attachment has {_ATTACHMENT.size} bytes, not {len(data)}") from None
        if gid_bytes != _GID_BYTES:
            raise ValueError(f"an identity has {_GID_BYTES} bytes, not {gid_bytes}")
        return cls(sequence, time_ns, gid)


def key(identity: NodeIdentity, name: str, of_type: MessageType) -> str:
    """Return the key of the messages of a topic, or of the requests to a service.

    Raises:
        BridgeError: ``name`` is no absolute name of ROS.
    """
    if not _NAME.fullmatch(name):
        raise BridgeError(f"{name!r} is no absolute name of a topic or service in ROS 2, as /skin/arm/points is")
    return f"{identity.domain}{name}/{of_type.dds_name}/{_hash(identity, of_type)}"


def node_token(identity: NodeIdentity, session: str, node: int) -> str:
    """Return the token of a node, which has a number in a session of zenoh."""
    return "/".join((_TOKENS, str(identity.domain), session, str(node), str(node), "NN", *_of_node(identity)))


def endpoint_token(
    identity: NodeIdentity,
    session: str,
    node: int,
    endpoint: int,
    kind: EndpointKind,
    name: str,
    of_type: MessageType,
    qos: Qos,
) -> str:
    """Return the token of a publisher or a service, which has a number of its own in the session."""
    place = (_TOKENS, str(identity.domain), session, str(node), str(endpoint), kind.value, *_of_node(identity))
    return "/".join((*place, _mangled(name), of_type.dds_name, _hash(identity, of_type), qos_text(qos)))


def qos_text(qos: Qos) -> str:
    """Return reliability, durability, history, deadline, lifespan and liveliness; defaults are not written."""
    reliability = "" if qos.reliable else "2"
    durability = "1" if qos.latched else ""
    depth = "" if qos.depth == _DEFAULT_DEPTH else qos.depth
    return f"{reliability}:{durability}:,{depth}:,:,:,,"


def gid(token: str) -> bytes:
    """Return the identity of the endpoint with a token, 16 bytes; all nodes compute the same."""
    return xxhash.xxh3_128_digest(token.encode())[::-1]


def _of_node(identity: NodeIdentity) -> tuple[str, str, str]:
    return "%", _mangled(identity.namespace), identity.name


def _mangled(name: str) -> str:
    return name.replace("/", "%")


def _hash(identity: NodeIdentity, of_type: MessageType) -> str:
    return _NO_HASH if identity.distro is Distro.HUMBLE else of_type.hash
