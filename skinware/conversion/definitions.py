"""Messages that viewers and ROS 2 know, and ours for ROS 2, as MCAP has their definitions."""

from __future__ import annotations

import json

from mcap.records import Schema

_TIME = "int32 sec\nuint32 nanosec\n"
_HEADER = "builtin_interfaces/Time stamp\nstring frame_id\n"
_POINT_FIELD = """\
uint8 INT8=1
uint8 UINT8=2
uint8 INT16=3
uint8 UINT16=4
uint8 INT32=5
uint8 UINT32=6
uint8 FLOAT32=7
uint8 FLOAT64=8
string name
uint32 offset
uint8 datatype
uint32 count
"""
_POINT_CLOUD = """\
std_msgs/Header header
uint32 height
uint32 width
sensor_msgs/PointField[] fields
bool is_bigendian
uint32 point_step
uint32 row_step
uint8[] data
bool is_dense
"""
_IMAGE = """\
std_msgs/Header header
uint32 height
uint32 width
string encoding
uint8 is_bigendian
uint32 step
uint8[] data
"""
_SKIN_FRAME = """\
# One frame of a driver; sensors in the order of its last skinware_msgs/Sensors, whose generation is the same.
std_msgs/Header header
uint64 generation
uint64 sequence
int64 acquired_ns
int64 published_ns
# In the unit of each sensor. Raw counts: (value - offset) / scale.
float64[] value
uint8[] status
int64[] module_time_ns
"""
_SENSORS = """\
# What a driver's sensors are; places are NaN where they are not known.
std_msgs/Header header
uint64 generation
uint64[] uid
string[] name
string[] type
string[] unit
float64[] scale
float64[] offset
uint32[] module
string[] frame_id
float64[] x
float64[] y
float64[] z
"""
TEXTS = {
    "builtin_interfaces/Time": _TIME,
    "std_msgs/Header": _HEADER,
    "std_msgs/String": "string data\n",
    "sensor_msgs/PointField": _POINT_FIELD,
    "sensor_msgs/PointCloud2": _POINT_CLOUD,
    "sensor_msgs/Image": _IMAGE,
    "skinware_msgs/SkinFrame": _SKIN_FRAME,
    "skinware_msgs/Sensors": _SENSORS,
}
"""Definitions of messages, by type, as ``.msg`` files have them."""
_HEADER_PARTS = ("std_msgs/Header", "builtin_interfaces/Time")
_STATE = {
    "type": "object",
    "properties": {
        "driver": {"type": "string"},
        "sequence": {"type": "integer"},
        "age_ms": {"type": "number"},
        "patches": {"type": "array", "items": {"type": "object"}},
        "buses": {"type": "array", "items": {"type": "object"}},
    },
}


def _ros(number: int, name: str, *parts: str) -> Schema:
    text = "".join([TEXTS[name], *(f"{'=' * 80}\nMSG: {part}\n{TEXTS[part]}" for part in parts)])
    return Schema(number, text.encode(), "ros2msg", name.replace("/", "/msg/"))


POINTS = _ros(16, "sensor_msgs/PointCloud2", *_HEADER_PARTS, "sensor_msgs/PointField")
IMAGE = _ros(17, "sensor_msgs/Image", *_HEADER_PARTS)
TEXT = _ros(18, "std_msgs/String")
SKIN_FRAME = _ros(19, "skinware_msgs/SkinFrame", *_HEADER_PARTS)
SENSORS = _ros(20, "skinware_msgs/Sensors", *_HEADER_PARTS)
STATE = Schema(21, json.dumps(_STATE).encode(), "jsonschema", "skinware.State")
