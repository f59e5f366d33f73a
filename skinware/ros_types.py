"""Types of ROS 2's messages: their names in DDS, definitions as in ``.msg`` files, and those of common messages."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from skinware.errors import ConfigurationError

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
TEXTS: Mapping[str, str] = {
    "builtin_interfaces/Time": _TIME,
    "std_msgs/Header": _HEADER,
    "std_msgs/String": "string data\n",
    "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z\n",
    "sensor_msgs/PointField": _POINT_FIELD,
    "sensor_msgs/PointCloud2": _POINT_CLOUD,
    "sensor_msgs/Image": _IMAGE,
}
"""Definitions of common messages, by type without ``msg``. Source: ros2/common_interfaces and ros2/rcl_interfaces."""
NUMBERS = ("bool", "float32", "float64", "int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64")
TEXT = "string"
_BYTES = {"byte": "uint8", "char": "uint8"}
_FIELD = re.compile(r"([\w/]+)(?:<=(\d+))?(?:\[(<=)?(\d*)(\])|)\s+([A-Za-z]\w*)(?:\s+[^=\s].*)?")
_CONSTANT = re.compile(r"[\w/]+(?:<=\d+)?\s+\w+\s*=.*")
_DDS_NAME = re.compile(r"(\w+)::(msg|srv)::dds_::(\w+)_")
_DEEPEST = 16


class MessageField(NamedTuple):
    """A field of a definition.

    Attributes:
        kind: one of ``NUMBERS``, ``string``, or another type.
        longest: characters of a text; 0: any number.
        length: elements of an array; 0: a sequence; None: one value.
        most: elements of a sequence; 0: any number.
    """

    name: str
    kind: str
    longest: int = 0
    length: int | None = None
    most: int = 0


_OF_EMPTY = MessageField("structure_needs_at_least_one_member", "uint8")
"""The field that ROS gives a message without any."""


class Definitions:
    """Definitions of a type and all that are in it.

    Args:
        type_name: with or without ``msg``.
        texts: by type without ``msg``; names in them may leave out the package.

    Attributes:
        texts: of the types that are used, with nothing but fields.

    Raises:
        ConfigurationError: a definition is missing or is none.
    """

    def __init__(self, type_name: str, texts: Mapping[str, str]) -> None:
        self.type_name = type_name
        self.texts: dict[str, str] = {}
        self._fields: dict[str, Sequence[MessageField]] = {}
        self._add(_without_msg(type_name), texts, ())

    def __getitem__(self, type_name: str) -> Sequence[MessageField]:
        return self._fields[_without_msg(type_name)]

    def _add(self, type_name: str, texts: Mapping[str, str], outer: tuple[str, ...]) -> None:
        if type_name in outer or len(outer) > _DEEPEST:
            raise ConfigurationError(f"type {type_name} is within itself")
        if type_name in self._fields:
            return
        if type_name not in texts:
            raise ConfigurationError(f"the definition of type {type_name} is missing")
        fields, lines = [], []
        for line in map(str.strip, re.sub(r"#.*", "", texts[type_name]).splitlines()):
            if not line or _CONSTANT.fullmatch(line):
                continue
            match = _FIELD.fullmatch(line)
            if match is None:
                raise ConfigurationError(f"definition of {type_name}: {line!r} is no field")
            plain, longest, is_bounded, count, is_list, name = match.groups()
            kind = _BYTES.get(plain, plain)
            if kind not in (*NUMBERS, TEXT):
                kind = _qualified(plain, type_name)
                self._add(kind, texts, (*outer, type_name))
            length = None if not is_list else 0 if is_bounded else int(count or 0)
            fields.append(MessageField(name, kind, int(longest or 0), length, int(count) if is_bounded else 0))
            lines.append(line[: match.end(6)])
        self.texts[type_name] = "\n".join([*lines, ""])
        self._fields[type_name] = fields or [_OF_EMPTY]


def dds_name(type_name: str) -> str:
    """Return the name in DDS: ``sensor_msgs::msg::dds_::PointCloud2_`` of ``sensor_msgs/msg/PointCloud2``.

    A name with one slash is of no type of ROS, and its parts are the same in DDS.
    """
    *package, plain = type_name.split("/")
    return f"{'::'.join(package)}::dds_::{plain}_" if len(package) > 1 else f"{package[0]}::{plain}"


def ros_name(name: str) -> str:
    """Return the type with a name in DDS; empty if it is no type of a message."""
    if match := _DDS_NAME.fullmatch(name):
        return "/".join(match.groups())
    return name.replace("::", "/") if re.fullmatch(r"\w+::\w+", name) else ""


def _without_msg(type_name: str) -> str:
    return type_name.replace("/msg/", "/")


def _qualified(plain: str, type_name: str) -> str:
    if plain == "Header":
        return "std_msgs/Header"
    return _without_msg(plain) if "/" in plain else f"{type_name.rpartition('/')[0]}/{plain}"
