"""Encode ROS 2 messages (CDR) and keep the definitions that viewers and ROS 2 read."""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from mcap.records import Schema

from skinware import ros_types
from skinware.driver_snapshot import DriverSnapshot
from skinware.realtime import NS_PER_S
from skinware.structure import Structure

_ENCAPSULATION = b"\x00\x01\x00\x00"


class Cdr:
    """A message that is being written, field by field in the order of its definition."""

    def __init__(self) -> None:
        self._parts: list[bytes] = [_ENCAPSULATION]
        self._size = 0

    def numbers(self, code: str, *values: float) -> Cdr:
        """Fields of one type.

        Args:
            code: of :mod:`struct`: ``I``, ``q``, ``?`` ...
        """
        self._align(struct.calcsize(f"<{code}"))
        self._append(struct.pack(f"<{len(values)}{code}", *values))
        return self

    def text(self, text: str) -> Cdr:
        data = text.encode() + b"\0"
        self.numbers("I", len(data))
        self._append(data)
        return self

    def texts(self, texts: Sequence[str]) -> Cdr:
        self.numbers("I", len(texts))
        for text in texts:
            self.text(text)
        return self

    def array(self, array: npt.NDArray[np.generic]) -> Cdr:
        """A sequence of numbers; of structures without gaps their bytes."""
        is_bytes = array.dtype.names is not None
        self.numbers("I", array.nbytes if is_bytes else array.size)
        if array.size and not is_bytes:
            self._align(array.dtype.itemsize)
        self._append(np.ascontiguousarray(array).tobytes())
        return self

    def header(self, time_ns: int, frame: str) -> Cdr:
        """A ``std_msgs/Header``.

        Args:
            time_ns: wall clock.
        """
        return self.numbers("i", time_ns // NS_PER_S).numbers("I", time_ns % NS_PER_S).text(frame)

    def done(self) -> bytes:
        return b"".join(self._parts)

    def _align(self, to: int) -> None:
        self._append(bytes(-self._size % to))

    def _append(self, data: bytes) -> None:
        self._parts.append(data)
        self._size += len(data)


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
TEXTS = {**ros_types.TEXTS, "skinware_msgs/SkinFrame": _SKIN_FRAME, "skinware_msgs/Sensors": _SENSORS}
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


def acquired_ns(frame: DriverSnapshot, time_ns: int) -> int:
    """Return when the newest data of a sample was acquired, wall clock; without data the time of publication.

    Args:
        time_ns: when it was published, wall clock.
    """
    return time_ns - (frame.published_ns - frame.acquired_ns if frame.acquired_ns else 0)


def skin_frame(frame: DriverSnapshot, time_ns: int, status: npt.NDArray[np.uint8] | None = None) -> bytes:
    """Return all values of a sample as ``skinware_msgs/SkinFrame``.

    Args:
        time_ns: when it was published, wall clock.
        status: (n_sensors,) of the sensors; default: as of the frame.
    """
    structure = frame.structure
    values = structure.physical_values(frame.values).astype(np.float64)
    cdr = Cdr().header(acquired_ns(frame, time_ns), "").numbers("Q", frame.generation, frame.sequence)
    cdr.numbers("q", frame.acquired_ns, frame.published_ns)
    return cdr.array(values).array(frame.status if status is None else status).array(frame.module_time_ns).done()


def sensors(structure: Structure, names: Sequence[str], generation: int, time_ns: int) -> bytes:
    """Return the sensors of a generation as ``skinware_msgs/Sensors``.

    Args:
        time_ns: wall clock.
    """
    types = {each.id: each for each in structure.types}
    of_sensors = [types[type_id] for type_id in structure.sensor_type.tolist()]
    cdr = Cdr().header(time_ns, "").numbers("Q", generation).array(structure.sensor_uid)
    cdr.texts(names).texts([each.name for each in of_sensors]).texts([each.unit for each in of_sensors])
    cdr.array(np.array([each.scale for each in of_sensors])).array(np.array([each.offset for each in of_sensors]))
    cdr.array(structure.sensor_module)
    geometry = structure.geometry
    places = np.full((structure.n_sensors, 3), np.nan) if geometry is None else geometry.position_m
    cdr.texts([""] * structure.n_sensors if geometry is None else geometry.frame.tolist())
    for axis in range(3):
        cdr.array(places[:, axis])
    return cdr.done()
