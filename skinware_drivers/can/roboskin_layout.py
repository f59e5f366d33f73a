"""The frames and sensor types of ROBOSKIN boards.

Skin: robotology/icub-firmware embot_prot_can_skin_periodic.{h,cpp}; robotology/icub-main SkinDiagnostics.h. Two
frames a period and triangle. HEAD: ``40``, channels 0 to 6. TAIL: ``C0``, channels 7 to 11, two bytes of diagnostics
(big-endian; bit 4 + k: channel k out of range, bit 0: a channel did not acknowledge, bit 1: not connected; MTB3 sets
one of the two, MTB4 may set both; old firmware sends none). Values: uint8, lower = more pressure.

Inertial: embot_prot_can_inertial_periodic.{h,cpp}. ``500 | board << 4 | {0 gyroscope, 1 accelerometer}``: three int16,
little-endian. ``503 | board << 4``: sequence, sensor {0 accelerometer, 1 magnetometer, 2 gyroscope}, three int16.
Scales: an MTB3 has an LIS331DLH of 2 g and an L3G4200D of 250 deg/s (robotology/icub-main pull request 543); an MTB4 a
BNO055, whose numbers it sends as they are (1/100 m/s2, 1/16 deg/s, 1/16 uT: its data sheet).

The key of a patch is the message class and the board's address together. The inertial sensors of a board are a patch of
their own, as they have a rate of their own, and may send between the two halves of a triangle.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from skinware.sensor_types import ACCELERATION, ANGULAR_RATE, MAGNETIC_FIELD, PRESSURE, TEMPERATURE, SensorType
from skinware.status import Status
from skinware_drivers import Module, Patch, Sensor
from skinware_drivers.can.roboskin_options import CHANNELS, Inertial, InertialSensor, RoboskinOptions
from skinware_drivers.fields import Bits, Byte, Flag, Identifier, Sentinel, SequenceNumber
from skinware_drivers.layout import Cycle, Frame, Layout, Values

OLD_SKIN, SKIN, INERTIAL = 3, 4, 5
"""Message classes: robotology/icub-firmware-shared iCubCanProto_classes.h."""
HEAD_BYTE, TAIL_BYTE = 0x40, 0xC0
SKIN_TYPES = (
    PRESSURE.measured(unit="counts", scale=-1.0, offset=255.0, minimum=0.0, maximum=255.0),
    TEMPERATURE.measured(unit="counts", minimum=0.0, maximum=255.0),
)

_PATCH = Bits(shift=4, width=7)
_TRIANGLE = Bits(shift=0, width=4)
_IDENTIFIER = Bits(shift=0, width=11)
_IMU_SENSOR = Bits(shift=0, width=8, byte=1)
_IMU_CODES = {"imu_accelerometer": 0, "imu_magnetometer": 1, "imu_gyroscope": 2}

_KINDS: dict[InertialSensor, tuple[str, tuple[SensorType, SensorType, SensorType]]] = {
    "accelerometer": ("accelerometer", ACCELERATION),
    "external_accelerometer": ("accelerometer", ACCELERATION),
    "imu_accelerometer": ("accelerometer", ACCELERATION),
    "gyroscope": ("gyroscope", ANGULAR_RATE),
    "imu_gyroscope": ("gyroscope", ANGULAR_RATE),
    "imu_magnetometer": ("magnetometer", MAGNETIC_FIELD),
}
_G = 9.80665
_SCALES = {
    ("mtb3", "accelerometer"): 2 * _G / 0x8000,
    ("mtb3", "gyroscope"): math.radians(250) / 0x8000,
    ("mtb4", "accelerometer"): 0.01,
    ("mtb4", "gyroscope"): math.radians(1) / 16,
    ("mtb4", "magnetometer"): 1e-6 / 16,
}
_INERTIAL_UID = 0x1000


def make_layout(options: RoboskinOptions, shortest_period_s: float) -> Layout:
    """Return the layout of a bus. A tail belongs to the frame right before it from the same board, or to none.

    Args:
        shortest_period_s: of all boards; head and tail are at most half of it apart.
    """
    # set up the old way, an MTB3 sends class 3 and an MTB4 class 4: the keys of the patches distinguish them
    of_class = () if options.old_style else (Identifier(SKIN << 8, mask=0x700),)
    head = Frame(
        "head",
        when=(*of_class, Byte(0, HEAD_BYTE)),
        length=(8,),
        patch=_PATCH,
        module=_TRIANGLE,
        values=Values(offset=1, dtype="u1", count=7, to=range(7)),
    )
    tail = Frame(
        "tail",
        when=(*of_class, Byte(0, TAIL_BYTE)),
        length=(6, 8),
        patch=_PATCH,
        module=_TRIANGLE,
        values=Values(offset=1, dtype="u1", count=5, to=range(7, 12)),
        flags=(
            Flag(Status.OUT_OF_RANGE, offset=6, dtype=">u2", each=[(k, 4 + k) for k in range(CHANNELS)]),
            Flag(Status.NO_ACK, offset=6, dtype=">u2", mask=0x1),
            Flag(Status.NOT_CONNECTED, offset=6, dtype=">u2", mask=0x2),
        ),
    )
    pair = Cycle(("head", "tail"), shortest_period_s / 2, within="patch", period_s=shortest_period_s)
    return Layout(frames=(head, tail, *_inertial_frames(options)), cycle=pair)


def _inertial_frames(options: RoboskinOptions) -> list[Frame]:
    sent = {sensor for inertial in options.all_inertial for sensor in inertial}
    frames = []
    if any(sensor not in _IMU_CODES for sensor in sent):
        for name, low in (("gyroscope", 0), ("accelerometer", 1)):
            # an MTB3's accelerometer has 12 bits, left-justified: -1 means that there is none
            absent = (Sentinel(Status.NOT_CONNECTED, -1),) if (options.inertial_scale, low) == ("mtb3", 1) else ()
            frames.append(
                Frame(
                    name,
                    when=(Identifier(INERTIAL << 8 | low, mask=0x70F),),
                    length=(6,),
                    patch=_PATCH,
                    module=_IDENTIFIER,
                    values=Values(offset=0, dtype="<i2", count=3),
                    flags=absent,
                )
            )
    if any(sensor in _IMU_CODES for sensor in sent):
        frames.append(
            Frame(
                "imu",
                when=(Identifier(INERTIAL << 8 | 3, mask=0x70F),),
                length=(8,),
                patch=_PATCH,
                module=_IMU_SENSOR,
                values=Values(offset=2, dtype="<i2", count=3),
                sequence=SequenceNumber(offset=0, dtype="u1"),
            )
        )
    return frames


def make_types(options: RoboskinOptions) -> tuple[SensorType, ...]:
    found: dict[str, SensorType] = {}
    for inertial in options.all_inertial:
        for sensor in inertial:
            kind, types = _KINDS[sensor]
            scale = _SCALES[options.inertial_scale, kind]
            for sensor_type in types:
                found[sensor_type.name] = sensor_type.measured(
                    scale=scale, minimum=-0x8000 * scale, maximum=0x7FFF * scale
                )
    return (*SKIN_TYPES, *found.values())


def board_of(patch: Patch) -> int:
    return patch.key & 0xF


def is_inertial(patch: Patch) -> bool:
    return patch.key >> 4 == INERTIAL


def inertial_patch(board: int, inertial: Inertial) -> Patch:
    """Return the inertial sensors of a board; uid = board << 16 | 0x1000, for all axes of all of them."""
    modules = []
    for sensor in inertial:
        kind, types = _KINDS[sensor]
        low = 0 if kind == "gyroscope" else 1
        key = _IMU_CODES.get(sensor, INERTIAL << 8 | board << 4 | low)
        modules.append(Module([Sensor(t.name, board << 16 | _INERTIAL_UID) for t in types], key=key, kind=kind))
    return Patch(f"board {board} inertial", modules, key=INERTIAL << 4 | board)


def skin_patch(board: int, modules: Sequence[Module], message_class: int) -> Patch:
    return Patch(f"board {board}", modules, key=message_class << 4 | board)


def triangle_module(board: int, triangle: int, kind: str, thermal: Sequence[int]) -> Module:
    """Return a triangle; uid = board << 16 | triangle << 8 | channel."""
    uid = board << 16 | triangle << 8
    names = ["temperature" if channel in thermal else "pressure" for channel in range(CHANNELS)]
    channels = [Sensor(name, uid | channel) for channel, name in enumerate(names)]
    return Module(channels, key=triangle, kind=kind, name=f"{kind} {triangle}")
