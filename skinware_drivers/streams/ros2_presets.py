"""Messages of ROS 2 that the driver ``ros2`` knows: their definitions, and the modules that they become.

Sources: ros2/common_interfaces and ros2/rcl_interfaces for ``std_msgs``, ``sensor_msgs``, ``geometry_msgs``;
ubi-agni/tactile_toolbox, commit 56e8544 (2024-10-13), for ``tactile_msgs``; mcsix/xela_server_ros2, commit 3a890cf
(2025-07-16); NaCl-1374/inspire_hand_ws, commit fc75490 (2025-02-21), ``hand_idl``; adnan-saood/paxini_ros2, commit
25009ba, ``paxini_hardware/msg``.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from skinware import ros_types
from skinware_drivers.streams.cdr import CdrMessage
from skinware_drivers.streams.ros2_parts import (
    FieldRule,
    Making,
    ModulePart,
    Places,
    by_rules,
    check_count,
    frame_of,
    sensor_type,
    vectors,
)

_HEADER = "std_msgs/Header header\n"
_FORCE, _TORQUE = ("force_x", "force_y", "force_z"), ("torque_x", "torque_y", "torque_z")
_NEWTONS = ("N",) * 3 + ("N m",) * 3
_NUMBERS = ("Float32", "Float64", "Int8", "Int16", "Int32", "Int64", "UInt8", "UInt16", "UInt32", "UInt64")
_FINGERS = ("little", "ring", "middle", "index")
_ORDINALS = dict(zip(_FINGERS, ("one", "two", "three", "four"), strict=True))
_MATRICES = {"tip": (3, 3), "top": (12, 8), "palm": (10, 8)}
_INSPIRE: Mapping[str, tuple[str, int | tuple[int, int]]] = {
    **{
        f"finger{_ORDINALS[name]}_{at}_touch": (f"{name} {at}", shape)
        for name in _FINGERS
        for at, shape in _MATRICES.items()
    },
    "fingerfive_tip_touch": ("thumb tip", (3, 3)),
    "fingerfive_top_touch": ("thumb top", (12, 8)),
    "fingerfive_middle_touch": ("thumb middle", (3, 3)),
    "fingerfive_palm_touch": ("thumb palm", (12, 8)),
    "palm_touch": ("palm", 112),
}

TEXTS: Mapping[str, str] = {
    **ros_types.TEXTS,
    "std_msgs/MultiArrayDimension": "string label\nuint32 size\nuint32 stride\n",
    "std_msgs/MultiArrayLayout": "std_msgs/MultiArrayDimension[] dim\nuint32 data_offset\n",
    **{f"std_msgs/{name}": f"{name.lower()} data\n" for name in _NUMBERS},
    **{f"std_msgs/{name}MultiArray": f"std_msgs/MultiArrayLayout layout\n{name.lower()}[] data\n" for name in _NUMBERS},
    "geometry_msgs/Point": "float64 x\nfloat64 y\nfloat64 z\n",
    "geometry_msgs/Wrench": "geometry_msgs/Vector3 force\ngeometry_msgs/Vector3 torque\n",
    "geometry_msgs/WrenchStamped": _HEADER + "geometry_msgs/Wrench wrench\n",
    "sensor_msgs/FluidPressure": _HEADER + "float64 fluid_pressure\nfloat64 variance\n",
    "sensor_msgs/MagneticField": _HEADER
    + "geometry_msgs/Vector3 magnetic_field\nfloat64[9] magnetic_field_covariance\n",
    "sensor_msgs/ChannelFloat32": "string name\nfloat32[] values\n",
    "tactile_msgs/TactileState": _HEADER + "sensor_msgs/ChannelFloat32[] sensors\n",
    "tactile_msgs/TactileContact": _HEADER
    + "string name\ngeometry_msgs/Point position\ngeometry_msgs/Vector3 normal\ngeometry_msgs/Wrench wrench\n",
    "tactile_msgs/TactileContacts": "tactile_msgs/TactileContact[] contacts\n",
    "xela_server_ros2/Taxel": "uint16 x\nuint16 y\nuint16 z\n",
    "xela_server_ros2/Forces": "float32 x\nfloat32 y\nfloat32 z\n",
    "xela_server_ros2/SensorFull": "uint32 message\nfloat64 time\nstring model\nuint8 sensor_pos\n"
    "xela_server_ros2/Taxel[] taxels\nxela_server_ros2/Forces[] forces\n",
    "xela_server_ros2/SensStream": "xela_server_ros2/SensorFull[] sensors\n",
    "inspire/inspire_hand_touch": "".join(
        f"int16[<={np.prod(shape)}] {name}\n" for name, (_, shape) in _INSPIRE.items()
    ),
    "paxini_hardware/TactileTaxel": "uint32 index\ngeometry_msgs/Point position\ngeometry_msgs/Vector3 normal\n"
    "geometry_msgs/Vector3 force\n",
    "paxini_hardware/TactileSensor": _HEADER
    + "geometry_msgs/Vector3 resultant_force\npaxini_hardware/TactileTaxel[] taxels\n",
}
"""Definitions, by type without ``msg``."""

_MOST_COUNT = 64
_POINT_DTYPES = ("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8")
_AXES, _NORMAL = ("x", "y", "z"), ("normal_x", "normal_y", "normal_z")
_IMAGE = re.compile(r"(8|16|32|64)(U|S|F)C(\d*)")
_NAMED_IMAGES = {"mono8": "8UC1", "mono16": "16UC1", **dict.fromkeys(("rgb8", "bgr8"), "8UC3")}
_XELA_GRID = re.compile(r"(?:uSPa|XR19|XR18)(\d)(\d)")


def _cloud(message: CdrMessage, topic: str) -> Sequence[ModulePart]:
    """Make one part of the fields of points, with places if there are x, y and z."""
    height, width, step, row_step = (message.number(name) for name in ("height", "width", "point_step", "row_step"))
    data, order = message.numbers["data"][()], "<>"[bool(message.number("is_bigendian"))]
    columns: dict[str, tuple[int, str]] = {}
    for element in range(message.counts["fields"][()]):
        offset, datatype, count = (message.number(f"fields.{of}", (element,)) for of in ("offset", "datatype", "count"))
        if not 1 <= datatype <= len(_POINT_DTYPES) or not 1 <= count <= _MOST_COUNT:
            raise ValueError(f"field {element} of its points has datatype {datatype} and count {count}")
        dtype, name = order + _POINT_DTYPES[datatype - 1], message.texts["fields.name"][(element,)]
        for number in range(count):
            place = offset + number * np.dtype(dtype).itemsize
            columns[f"{name}_{number}" if count > 1 else name] = place, dtype
    shown = [name for name in columns if name not in _AXES + _NORMAL]
    if not height * width or not shown:
        raise ValueError("a cloud without points, or of positions alone")
    check_count(height * width * len(columns))
    last = (height - 1) * row_step + (width - 1) * step
    for name, (place, dtype) in columns.items():
        if last + place + np.dtype(dtype).itemsize > data.length:
            raise ValueError(f"{height} x {width} points with {name!r} do not fit into {data.length} bytes")
    points = data.start + np.add.outer(np.arange(height) * row_step, np.arange(width) * step).reshape(-1)
    position, normal = (
        vectors(message.sample, *zip(*((points + columns[name][0], columns[name][1]) for name in names), strict=True))
        if columns.keys() >= set(names)
        else None
        for names in (_AXES, _NORMAL)
    )
    kind = f"{height}x{width}" if height > 1 else "points"
    shown_columns = [(name, points + columns[name][0], columns[name][1]) for name in shown]
    part = _part(topic, "points", kind, shown_columns)
    return [replace(part, position_m=position, normal=normal, frame=frame_of(message, topic))]


def _image(message: CdrMessage, topic: str) -> Sequence[ModulePart]:
    encoding = message.texts["encoding"][()]
    match = _IMAGE.fullmatch(_NAMED_IMAGES.get(encoding, encoding))
    if match is None or match[1] + match[2] in ("64U", "64S", "8F", "16F"):
        raise ValueError(f"a picture in encoding {encoding!r}")
    size, channels = int(match[1]) // 8, int(match[3] or 1)
    dtype = "<>"[bool(message.number("is_bigendian"))] + {"U": "u", "S": "i", "F": "f"}[match[2]] + str(size)
    height, width, step = (message.number(name) for name in ("height", "width", "step"))
    data = message.numbers["data"][()]
    if not 1 <= channels <= 16 or width * channels * size > step or height * step > data.length or not height * width:
        raise ValueError(f"{height} x {width} pixels of {channels} channels do not fit into {data.length} bytes")
    check_count(height * width * channels)
    at = data.start + np.add.outer(np.arange(height) * step, np.arange(width) * channels * size).reshape(-1)
    names = ["pressure"] if channels == 1 else [f"channel_{number}" for number in range(channels)]
    columns = [(name, at + number * size, dtype) for number, name in enumerate(names)]
    return [_part(topic, "image", f"{height}x{width}", columns)]


def _array(message: CdrMessage, topic: str) -> Sequence[ModulePart]:
    """Make taxels of an array: of two dimensions a matrix; of three with 3 at last, one of taxels with three axes."""
    data = message.numbers["data"][()]
    sizes = [message.number("layout.dim.size", (element,)) for element in range(message.counts["layout.dim"][()])]
    places = data.places[message.number("layout.data_offset") :]
    axes = 3 if len(sizes) == 3 and sizes[2] == 3 else 1
    shape = sizes[:2] if np.prod(sizes, dtype=float) == len(places) and len(sizes) == (3 if axes == 3 else 2) else []
    axes = axes if shape else 1
    check_count(len(places))
    if not len(places):
        return ()
    names = ["pressure"] if axes == 1 else _FORCE
    columns = [(name, places[axis::axes], data.dtype) for axis, name in enumerate(names)]
    return [_part(topic, "array", f"{shape[0]}x{shape[1]}" if shape else "taxels", columns)]


def _part(topic: str, name: str, kind: str, columns: Sequence[tuple[str, Places, str]]) -> ModulePart:
    """Return a part of columns: quantity, places and dtype of each."""
    names, places, dtypes = zip(*columns, strict=True)
    return ModulePart(topic, name, kind, tuple(sensor_type(each, "counts") for each in names), places, dtypes)


def _xela(message: CdrMessage, topic: str) -> Sequence[ModulePart]:
    parts = _xela_sensors(message, topic)
    grids = [(part, _XELA_GRID.search(part.name)) for part in parts]
    return [
        replace(part, kind=f"{grid[1]}x{grid[2]}") if grid and int(grid[1]) * int(grid[2]) == part.taxels else part
        for part, grid in grids
    ]


def _xyz(prefix: str) -> tuple[str, str, str]:
    return f"{prefix}.x", f"{prefix}.y", f"{prefix}.z"


_xela_sensors = by_rules(
    *(
        FieldRule(_xyz(f"sensors.{field}"), names, unit, module="{sensors.model} {sensors.sensor_pos}", each="sensors")
        for field, names, unit in (
            ("forces", _FORCE, "N"),
            ("taxels", ("shear_x", "shear_y", "pressure"), "counts"),
        )
    )
)


def _contact(prefix: str, each: str) -> Making:
    fields = (*_xyz(f"{prefix}wrench.force"), *_xyz(f"{prefix}wrench.torque"), *_xyz(f"{prefix}position"))
    quantities = _FORCE + _TORQUE + ("position_x", "position_y", "position_z")
    return by_rules(FieldRule(fields, quantities, (*_NEWTONS, *("m",) * 3), module=f"{{{prefix}name}}", each=each))


def _wrench(prefix: str) -> Making:
    fields = (*_xyz(f"{prefix}force"), *_xyz(f"{prefix}torque"))
    return by_rules(FieldRule(fields, _FORCE + _TORQUE, _NEWTONS, module="wrench"))


_MAKINGS: Mapping[str, Making] = {
    "sensor_msgs/PointCloud2": _cloud,
    "sensor_msgs/Image": _image,
    **{f"std_msgs/{name}MultiArray": _array for name in _NUMBERS},
    **{f"std_msgs/{name}": by_rules(FieldRule("data", module="value")) for name in _NUMBERS},
    "geometry_msgs/WrenchStamped": _wrench("wrench."),
    "geometry_msgs/Wrench": _wrench(""),
    "sensor_msgs/FluidPressure": by_rules(FieldRule("fluid_pressure", unit="Pa", module="pressure")),
    "sensor_msgs/MagneticField": by_rules(
        FieldRule(_xyz("magnetic_field"), tuple(f"magnetic_field_{axis}" for axis in _AXES), "T", module="magnetometer")
    ),
    "tactile_msgs/TactileState": by_rules(FieldRule("sensors.values", module="{sensors.name}", each="sensors")),
    "tactile_msgs/TactileContact": _contact("", ""),
    "tactile_msgs/TactileContacts": _contact("contacts.", "contacts"),
    "xela_server_ros2/SensStream": _xela,
    "inspire/inspire_hand_touch": by_rules(
        *(FieldRule(field, module=name, taxels=taxels) for field, (name, taxels) in _INSPIRE.items())
    ),
    "paxini_hardware/TactileSensor": by_rules(
        FieldRule(
            _xyz("taxels.force"),
            _FORCE,
            "N",
            module="taxels",
            position=_xyz("taxels.position"),
            normal=_xyz("taxels.normal"),
        ),
        FieldRule(_xyz("resultant_force"), _FORCE, "N", module="resultant"),
    ),
}
PRESETS: Mapping[str, Making] = {
    name if name.startswith("inspire/") else name.replace("/", "/msg/"): making for name, making in _MAKINGS.items()
}
"""Functions that make the parts of a message, by type. Captures know a type by its place here: only append."""
