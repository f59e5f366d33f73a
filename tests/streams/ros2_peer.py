"""Programs that publish touch on topics of ROS 2, of Cyclone DDS alone, with types by the public definitions.

Every value follows from the number of its sample. ``CASES`` has each message that the driver knows: how it is made, and
the values that it shows.
"""

from __future__ import annotations

import struct
import threading
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Self

import numpy as np
from cyclonedds.idl import make_idl_struct
from cyclonedds.idl import types as idl

u8, u32, f32, f64 = idl.uint8, idl.uint32, idl.float32, idl.float64


def message(package: str, plain: str, **fields: Any) -> Any:
    return make_idl_struct(f"{plain}_", f"{package}.msg.dds_.{plain}_", fields)


Time = message("builtin_interfaces", "Time", sec=idl.int32, nanosec=u32)
Header = message("std_msgs", "Header", stamp=Time, frame_id=str)
Dimension = message("std_msgs", "MultiArrayDimension", label=str, size=u32, stride=u32)
ArrayLayout = message("std_msgs", "MultiArrayLayout", dim=idl.sequence[Dimension], data_offset=u32)
Vector3 = message("geometry_msgs", "Vector3", x=f64, y=f64, z=f64)
Point = message("geometry_msgs", "Point", x=f64, y=f64, z=f64)
Wrench = message("geometry_msgs", "Wrench", force=Vector3, torque=Vector3)
WrenchStamped = message("geometry_msgs", "WrenchStamped", header=Header, wrench=Wrench)
PointField = message("sensor_msgs", "PointField", name=str, offset=u32, datatype=u8, count=u32)
PointCloud2 = message(
    "sensor_msgs",
    "PointCloud2",
    header=Header,
    height=u32,
    width=u32,
    fields=idl.sequence[PointField],
    is_bigendian=bool,
    point_step=u32,
    row_step=u32,
    data=idl.sequence[u8],
    is_dense=bool,
)
Image = message(
    "sensor_msgs",
    "Image",
    header=Header,
    height=u32,
    width=u32,
    encoding=str,
    is_bigendian=u8,
    step=u32,
    data=idl.sequence[u8],
)
FluidPressure = message("sensor_msgs", "FluidPressure", header=Header, fluid_pressure=f64, variance=f64)
MagneticField = message(
    "sensor_msgs", "MagneticField", header=Header, magnetic_field=Vector3, magnetic_field_covariance=idl.array[f64, 9]
)
Channel = message("sensor_msgs", "ChannelFloat32", name=str, values=idl.sequence[f32])
TactileState = message("tactile_msgs", "TactileState", header=Header, sensors=idl.sequence[Channel])
TactileContact = message(
    "tactile_msgs", "TactileContact", header=Header, name=str, position=Point, normal=Vector3, wrench=Wrench
)
TactileContacts = message("tactile_msgs", "TactileContacts", contacts=idl.sequence[TactileContact])
Taxel = message("xela_server_ros2", "Taxel", x=idl.uint16, y=idl.uint16, z=idl.uint16)
Forces = message("xela_server_ros2", "Forces", x=f32, y=f32, z=f32)
SensorFull = message(
    "xela_server_ros2",
    "SensorFull",
    message=u32,
    time=f64,
    model=str,
    sensor_pos=u8,
    taxels=idl.sequence[Taxel],
    forces=idl.sequence[Forces],
)
SensStream = message("xela_server_ros2", "SensStream", sensors=idl.sequence[SensorFull])
PaxiniTaxel = message("paxini_hardware", "TactileTaxel", index=u32, position=Point, normal=Vector3, force=Vector3)
PaxiniSensor = message(
    "paxini_hardware", "TactileSensor", header=Header, resultant_force=Vector3, taxels=idl.sequence[PaxiniTaxel]
)
_PARTS = ("tip", 9), ("top", 96), ("palm", 80)
_TOUCH = {
    **{f"finger{finger}_{part}_touch": n for finger in ("one", "two", "three", "four") for part, n in _PARTS},
    "fingerfive_tip_touch": 9,
    "fingerfive_top_touch": 96,
    "fingerfive_middle_touch": 9,
    "fingerfive_palm_touch": 96,
    "palm_touch": 112,
}
InspireTouch = make_idl_struct(
    "inspire_hand_touch",
    "inspire.inspire_hand_touch",
    {name: idl.sequence[idl.int16, n] for name, n in _TOUCH.items()},
)


class Talker:
    """Publishes samples of rising numbers, every 10 ms, as long as it is entered.

    Attributes:
        number: of the next sample.
        is_silent: whether it pauses.
    """

    def __init__(self, publish: Callable[[int], object], first: int = 0) -> None:
        self.publish, self.number, self.is_silent = publish, first, False
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def _run(self) -> None:
        while not self._over.wait(0.01):
            if not self.is_silent:
                self.publish(self.number)
                self.number += 1

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()
        del self.publish  # and what it publishes with


class Case(NamedTuple):
    """A message: its type, how sample ``number`` is made, the values that it shows, and the kinds of its modules."""

    type_name: str
    idl_type: Any
    sample: Callable[[int], Any]
    shown: Callable[[int], Sequence[float]]
    kinds: Sequence[str]
    dtype: str = "float32"


_DTYPES = {
    **dict.fromkeys(("Float32", "Float64", "Int64", "UInt32", "UInt64"), "float32"),
    "UInt8": "uint8",
    "Int8": "int16",
    "Int16": "int16",
    "UInt16": "uint16",
    "Int32": "int32",
}
"""A skin has no values of 64 bits, nor without a sign of 32."""


def header(number: int, frame: str = "palm") -> Any:
    return Header(Time(1_700_000_000 + number, 5), frame)


def ramp(number: float, n: int, step: float = 1.0) -> list[float]:
    return [number + step * k for k in range(n)]


def _cloud(number: int) -> Any:
    """Two rows of three points with gaps, one of them nowhere."""
    fields = [PointField(name, at, 7, 1) for name, at in (("x", 0), ("y", 4), ("z", 8))]
    fields += [PointField("pressure", 12, 4, 1), PointField("slip", 16, 8, 2)]
    data = bytearray(2 * 100)
    for n in range(6):
        x = float("nan") if n == 5 else 0.5 * n
        struct.pack_into("<3fH2x2d", data, n // 3 * 100 + n % 3 * 32, x, 1, 2, number + n, number / 8, n)
    return PointCloud2(header(number), 2, 3, fields, False, 32, 100, list(data), False)


def _image(number: int) -> Any:
    rows = b"".join(struct.pack(">3H2x", *(number + 3 * row + n for n in range(3))) for row in range(2))
    return Image(header(number), 2, 3, "16UC1", 1, 8, list(rows))


def _array(name: str, code: type, step: float) -> Case:
    array = message("std_msgs", f"{name}MultiArray", layout=ArrayLayout, data=idl.sequence[code])

    def sample(number: int) -> Any:
        layout = ArrayLayout([Dimension("r", 3, 12), Dimension("c", 4, 4)], 0)
        return array(layout, [number % 100 + step * n for n in range(12)])

    type_name = f"std_msgs/msg/{name}MultiArray"
    return Case(type_name, array, sample, lambda number: ramp(number % 100, 12, step), ["3x4"], _DTYPES[name])


def _single(name: str, code: type) -> Case:
    one = message("std_msgs", name, data=code)
    type_name = f"std_msgs/msg/{name}"
    return Case(type_name, one, lambda n: one(n % 100), lambda n: [n % 100], ["taxels"], _DTYPES[name])


def _vector(start: float) -> Any:
    return Vector3(start, start + 0.25, start + 0.5)


def _wrench(number: float) -> Any:
    return Wrench(_vector(number), _vector(-number))


def _six(number: float) -> list[float]:
    return [*ramp(number, 3, 0.25), *ramp(-number, 3, 0.25)]


def _contact(number: int, name: str) -> Any:
    return TactileContact(header(number), name, Point(1, 2, number), _vector(1), _wrench(number))


def _xela(number: int, *, forces: bool) -> Any:
    taxels = [Taxel(number + n, n, 65535 - n) for n in range(16)]
    felt = [Forces(number + n, n / 2, -n) for n in range(16)] if forces else []
    return SensStream([SensorFull(number, 1.5, "uSPa44", pos, taxels, felt) for pos in (1, 2)])


def _paxini(number: int) -> Any:
    taxels = [
        PaxiniTaxel(n, Point(n / 1000, 0, 0), Vector3(0, 0, 2 if n else 0), _vector(number + n)) for n in range(3)
    ]
    return PaxiniSensor(header(number), _vector(number), taxels)


def _inspire(number: int) -> Any:
    return InspireTouch(*([number % 4096] * n for n in _TOUCH.values()))


_NUMBERS = {
    "Float32": f32,
    "Float64": f64,
    "Int8": idl.int8,
    "Int16": idl.int16,
    "Int32": idl.int32,
    "Int64": idl.int64,
    "UInt8": u8,
    "UInt16": idl.uint16,
    "UInt32": u32,
    "UInt64": idl.uint64,
}
CASES = [
    Case(
        "sensor_msgs/msg/PointCloud2",
        PointCloud2,
        _cloud,
        lambda number: [value for n in range(6) for value in (number + n, number / 8, n)],
        ["2x3"],
    ),
    Case("sensor_msgs/msg/Image", Image, _image, lambda number: ramp(number, 6), ["2x3"], "uint16"),
    *(_array(name, code, 0.5 if name.startswith("Float") else 1) for name, code in _NUMBERS.items()),
    *(_single(name, code) for name, code in _NUMBERS.items()),
    Case(
        "geometry_msgs/msg/WrenchStamped",
        WrenchStamped,
        lambda number: WrenchStamped(header(number), _wrench(number)),
        _six,
        ["taxels"],
    ),
    Case("geometry_msgs/msg/Wrench", Wrench, _wrench, _six, ["taxels"]),
    Case(
        "sensor_msgs/msg/FluidPressure",
        FluidPressure,
        lambda number: FluidPressure(header(number), number, 0),
        lambda number: [number],
        ["taxels"],
    ),
    Case(
        "sensor_msgs/msg/MagneticField",
        MagneticField,
        lambda number: MagneticField(header(number), _vector(number), [0] * 9),
        lambda number: ramp(number, 3, 0.25),
        ["taxels"],
    ),
    Case(
        "tactile_msgs/msg/TactileState",
        TactileState,
        lambda number: TactileState(header(number), [Channel("thumb", ramp(number, 5)), Channel("", ramp(-number, 3))]),
        lambda number: [*ramp(number, 5), *ramp(-number, 3)],
        ["taxels"] * 2,
    ),
    Case(
        "tactile_msgs/msg/TactileContact",
        TactileContact,
        lambda number: _contact(number, "tip"),
        lambda number: [*_six(number), 1, 2, number],
        ["taxels"],
    ),
    Case(
        "tactile_msgs/msg/TactileContacts",
        TactileContacts,
        lambda number: TactileContacts([_contact(number, "tip"), _contact(number + 1, "palm")]),
        lambda number: [*_six(number), 1, 2, number, *_six(number + 1), 1, 2, number + 1],
        ["taxels"] * 2,
    ),
    Case(
        "xela_server_ros2/msg/SensStream",
        SensStream,
        lambda number: _xela(number, forces=True),
        lambda number: [value for n in range(16) for value in (number + n, n / 2, -n)] * 2,
        ["4x4"] * 2,
    ),
    Case(
        "inspire/inspire_hand_touch",
        InspireTouch,
        _inspire,
        lambda number: [number % 4096] * sum(_TOUCH.values()),
        [*["3x3", "12x8", "10x8"] * 4, "3x3", "12x8", "3x3", "12x8", "taxels"],
        "int16",
    ),
    Case(
        "paxini_hardware/msg/TactileSensor",
        PaxiniSensor,
        _paxini,
        lambda number: [*(value for n in range(3) for value in ramp(number + n, 3, 0.25)), *ramp(number, 3, 0.25)],
        ["taxels"] * 2,
    ),
]
RAW_XELA = Case(
    "xela_server_ros2/msg/SensStream",
    SensStream,
    lambda number: _xela(number, forces=False),
    lambda number: [value for n in range(16) for value in (number + n, n, 65535 - n)] * 2,
    ["4x4"] * 2,
    "uint16",
)


def case_of(type_name: str) -> Case:
    return next(case for case in CASES if case.type_name == type_name)


def serialized(sample: Any) -> bytes:
    """The sample as it is on the wire."""
    return bytes(sample.serialize())


def same(values: Any, expected: Sequence[float]) -> bool:
    shown = np.asarray(values)
    return bool(shown.tolist() == np.asarray(expected, shown.dtype).tolist())
