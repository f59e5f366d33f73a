"""Types of messages and services that are used in a ROS 2 graph: their definitions and the hashes of these."""

from __future__ import annotations

from skinware.conversion import definitions
from skinware.ros2.transport import MessageType, ServiceType

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
    **definitions.TEXTS,
    "diagnostic_msgs/KeyValue": _KEY_VALUE,
    "diagnostic_msgs/DiagnosticStatus": _DIAGNOSTIC_STATUS,
    "diagnostic_msgs/DiagnosticArray": "std_msgs/Header header\ndiagnostic_msgs/DiagnosticStatus[] status\n",
    "rmw_dds_common/Gid": "uint8[16] data\n",
    "rmw_dds_common/NodeEntitiesInfo": _NODE_ENTITIES,
    "rmw_dds_common/ParticipantEntitiesInfo": _PARTICIPANT_ENTITIES,
    "std_srvs/srv/Trigger_Request": "uint8 structure_needs_at_least_one_member\n",
    "std_srvs/srv/Trigger_Response": "bool success\nstring message\n",
}
"""Definitions, by type; those of messages are called without ``msg``."""

POINTS = MessageType(
    "sensor_msgs/msg/PointCloud2", "RIHS01_0000000000000000000000000000000000000000000000000000000000000000"
)
IMAGE = MessageType("sensor_msgs/msg/Image", "RIHS01_0000000000000000000000000000000000000000000000000000000000000000")
SKIN_FRAME = MessageType(
    "skinware_msgs/msg/SkinFrame", "RIHS01_0000000000000000000000000000000000000000000000000000000000000000"
)
SENSORS = MessageType(
    "skinware_msgs/msg/Sensors", "RIHS01_0000000000000000000000000000000000000000000000000000000000000000"
)
DIAGNOSTICS = MessageType(
    "diagnostic_msgs/msg/DiagnosticArray", "RIHS01_0000000000000000000000000000000000000000000000000000000000000000"
)
TRIGGER = ServiceType(
    "std_srvs/srv/Trigger",
    "RIHS01_0000000000000000000000000000000000000000000000000000000000000000",
    MessageType(
        "std_srvs/srv/Trigger_Request", "RIHS01_0000000000000000000000000000000000000000000000000000000000000000"
    ),
    MessageType(
        "std_srvs/srv/Trigger_Response", "RIHS01_0000000000000000000000000000000000000000000000000000000000000000"
    ),
)
PARTICIPANT = MessageType(
    "rmw_dds_common/msg/ParticipantEntitiesInfo",
    "RIHS01_0000000000000000000000000000000000000000000000000000000000000000",
)
OF_SCHEMAS = {each.name: each for each in (POINTS, IMAGE)}
"""Types of what is shown, by the names of their definitions."""


def definition(message_type: MessageType) -> str:
    """The text of a type's definition, as its ``.msg`` file has it."""
    return TEXTS[message_type.name.replace("/msg/", "/")]


__all__ = [
    "DIAGNOSTICS",
    "IMAGE",
    "OF_SCHEMAS",
    "PARTICIPANT",
    "POINTS",
    "SENSORS",
    "SKIN_FRAME",
    "TEXTS",
    "TRIGGER",
    "definition",
]
