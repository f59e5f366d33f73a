"""Messages and services of ROS 2: their types, with definitions and hashes, and those in CDR that need no frame."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from enum import IntEnum
from typing import NamedTuple

from skinware.conversion import ros_messages
from skinware.conversion.ros_messages import Cdr
from skinware.ros2.transport import Distro, MessageType, NodeIdentity, ServiceType

_KEY_VALUE = "string key\nstring value\n"
_DIAGNOSTIC_STATUS = """\
byte OK=0
byte WARN=1
byte ERROR=2
byte STALE=3
byte level
string name
string message
string hardware_id
diagnostic_msgs/KeyValue[] values
"""
_PARTICIPANT_ENTITIES = """\
rmw_dds_common/Gid gid
rmw_dds_common/NodeEntitiesInfo[] node_entities_info_seq
"""
_NODE_ENTITIES = """\
string<=256 node_namespace
string<=256 node_name
rmw_dds_common/Gid[] reader_gid_seq
rmw_dds_common/Gid[] writer_gid_seq
"""
TEXTS = {
    **ros_messages.TEXTS,
    "diagnostic_msgs/KeyValue": _KEY_VALUE,
    "diagnostic_msgs/DiagnosticStatus": _DIAGNOSTIC_STATUS,
    "diagnostic_msgs/DiagnosticArray": "std_msgs/Header header\ndiagnostic_msgs/DiagnosticStatus[] status\n",
    "rmw_dds_common/Gid": "uint8[16] data\n",
    "rmw_dds_common/NodeEntitiesInfo": _NODE_ENTITIES,
    "rmw_dds_common/ParticipantEntitiesInfo": _PARTICIPANT_ENTITIES,
    "std_srvs/srv/Trigger_Request": "uint8 structure_needs_at_least_one_member\n",
    "std_srvs/srv/Trigger_Response": "bool success\nstring message\n",
}
"""Definitions, by type; names of messages are without ``msg``."""

POINTS = MessageType(
    "sensor_msgs/msg/PointCloud2", "RIHS01_9198cabf7da3796ae6fe19c4cb3bdd3525492988c70522628af5daa124bae2b5"
)
IMAGE = MessageType("sensor_msgs/msg/Image", "RIHS01_d31d41a9a4c4bc8eae9be757b0beed306564f7526c88ea6a4588fb9582527d47")
SKIN_FRAME = MessageType(
    "skinware_msgs/msg/SkinFrame", "RIHS01_4c6c7978ff329a043a35d3762fc01b81ab8bfbf3d39510eaae7762e0c88d6654"
)
SENSORS = MessageType(
    "skinware_msgs/msg/Sensors", "RIHS01_223f66244e68a28a02cb2d2591b01679d9264cfe19da5262d3f45178f7c40799"
)
DIAGNOSTICS = MessageType(
    "diagnostic_msgs/msg/DiagnosticArray", "RIHS01_5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e"
)
TRIGGER = ServiceType(
    "std_srvs/srv/Trigger",
    "RIHS01_eeff2cd6fa5ad9d27cdf4dec64818317839b62f212a91e6b5304b634b2062c5f",
    MessageType(
        "std_srvs/srv/Trigger_Request", "RIHS01_d010825374ce8918e72bfd826c82603e60f45419e932ea976f807b74a863a199"
    ),
    MessageType(
        "std_srvs/srv/Trigger_Response", "RIHS01_2d946c21e2fc3f1e9ca6986a8191d85fcc70097a8bb7771a053564bc47009cdf"
    ),
)
PARTICIPANT = MessageType(
    "rmw_dds_common/msg/ParticipantEntitiesInfo",
    "RIHS01_91a0593bacdcc50ea9bdcf849a938b128412cc1ea821245c663bcd26f83c295e",
)
OF_SCHEMAS = {each.name: each for each in (POINTS, IMAGE)}
"""Types of point clouds and images, by the names of their definitions."""

DISCOVERY_TOPIC = "ros_discovery_info"
"""Where ROS 2 publishes, over DDS, which node has which endpoints."""
PARTICIPANT_DATA = b"enclave=/;"
"""User data of a participant: without it, ROS does not count it as one of its own."""


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
