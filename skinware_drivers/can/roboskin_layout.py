"""The options, frames and sensor types of ROBOSKIN boards.

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
from collections.abc import Iterable, Sequence
from typing import Annotated, Literal

import msgspec

from skinware.errors import ConfigurationError
from skinware.sensor_types import ACCELERATION, ANGULAR_RATE, MAGNETIC_FIELD, PRESSURE, TEMPERATURE, SensorType
from skinware.status import Status
from skinware_drivers import Module, Patch, Sensor
from skinware_drivers.fields import Bits, Byte, Flag, Identifier, Sentinel, SequenceNumber
from skinware_drivers.layout import Cycle, Frame, Layout, Values

FIRST_BOARD, LAST_BOARD = 1, 14
TRIANGLES = 16
CHANNELS = 12
NON_TACTILE: dict[str, tuple[int, ...]] = {"triangle": (6, 10), "fingertip": (), "palm": (11,)}
"""Channels of each kind of module that do not measure touch."""
_TRIANGLE_SKIN_TYPES = (0, 2, 8)
ERGO_HAND = 3
"""Type of skin of the ergoCub's hand."""
_FINGERTIPS_OF_ERGO_HAND = 5
LONGEST_OLD_PERIOD_MS = 209
"""The longest period of the old set-up: its timer counts to 65535 ticks of 3.2 us."""

InertialSensor = Literal[
    "accelerometer", "external_accelerometer", "gyroscope", "imu_accelerometer", "imu_magnetometer", "imu_gyroscope"
]
"""An inertial sensor of a board; the sensors of an ``imu`` (MTB4 only) send other messages."""

Inertial = tuple[InertialSensor, ...]


def usual_kind(skin_type: int, triangle: int) -> str:
    """Return the kind of a module that no option names.

    The ergoCub's hand has fingertips as its modules 0 to 4 and triangles with thermal pads as 5 to 15:
    robotology/icub-firmware b42992119 (2026-06-17), embot_app_application_theSkin.cpp, computedrift.
    """
    if skin_type == ERGO_HAND:
        return "fingertip" if triangle < _FINGERTIPS_OF_ERGO_HAND else "triangle"
    return "triangle" if skin_type in _TRIANGLE_SKIN_TYPES else "fingertip"


class Kind(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A range of triangles of a board that differ from the rest. If several name a triangle, the last one counts.

    Attributes:
        kind: ``triangle``, ``fingertip`` or ``palm``; empty: by the board's type of skin.
        thermal: channels that are not tactile; None: those of the kind.
        enabled: switched on or off in the board; None: as the rest of the board.
        shift: resolution of the board's arithmetic (SET_TRIANG_CFG); None: as the rest.
        cdc_offset: offset register of the capacitance converter (SET_TRIANG_CFG); None: as the rest.
    """

    board: int
    triangles: tuple[int, ...]
    kind: str = ""
    thermal: tuple[int, ...] | None = None
    enabled: bool | None = None
    shift: Annotated[int, msgspec.Meta(ge=0, le=255)] | None = None
    cdc_offset: Annotated[int, msgspec.Meta(ge=0, le=0xFFFF)] | None = None


class SpecialBoards(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Boards that are set up in another way than the rest of the bus. Attributes that are None are as for the rest.

    A period, type of skin or no-load value of their own is sent in a second SET_BRD_CFG, upon which the firmware
    switches all triangles of the board off: the wanted ones must be switched on again in ``modules``.

    Attributes:
        period_ms: time between two updates.
    """

    boards: tuple[int, ...]
    period_ms: Annotated[int, msgspec.Meta(ge=1, le=255)] | None = None
    skin_type: Annotated[int, msgspec.Meta(ge=0, le=15)] | None = None
    no_load: Annotated[int, msgspec.Meta(ge=0, le=255)] | None = None
    inertial: Inertial | None = None

    @property
    def sets_board(self) -> bool:
        return not (self.period_ms is None and self.skin_type is None and self.no_load is None)


class RoboskinOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    boards: Annotated[
        tuple[int, ...], msgspec.Meta(description="addresses of the boards, 1-14; default: all that answer")
    ] = ()
    period_ms: Annotated[int, msgspec.Meta(description="time between two updates, 1-255 ms", ge=1, le=255)] = 50
    skin_type: Annotated[
        int, msgspec.Meta(description="skin type that is sent to the boards: 0, 1, 2, 3, 7 or 8", ge=0, le=15)
    ] = 0
    no_load: Annotated[int, msgspec.Meta(description="value of an idle taxel", ge=0, le=255)] = 0xF0
    shift: Annotated[int, msgspec.Meta(description="resolution shift of the boards", ge=0, le=255)] = 2
    cdc_offset: Annotated[int, msgspec.Meta(description="converter offset register", ge=0, le=0xFFFF)] = 0x2200
    enabled: Annotated[
        bool, msgspec.Meta(description="whether triangles that `modules` does not name are switched on")
    ] = True
    kind: Annotated[
        str, msgspec.Meta(description="kind of all modules: triangle, fingertip or palm; default: by skin type")
    ] = ""
    inertial: Annotated[Inertial, msgspec.Meta(description="inertial sensors that the boards send")] = ()
    inertial_period_ms: Annotated[
        int, msgspec.Meta(description="time between two updates of the inertial sensors, 1-255 ms", ge=1, le=255)
    ] = 50
    inertial_scale: Annotated[
        Literal["mtb4", "mtb3"], msgspec.Meta(description="kind of the boards with inertial sensors: it sets the scale")
    ] = "mtb4"
    old_style: Annotated[
        bool, msgspec.Meta(description="configure boards with the old commands 4C and 4E; skin data in message class 3")
    ] = False
    learn_s: Annotated[float, msgspec.Meta(description="time in which a listener learns the modules, s", gt=0)] = 1.0
    special_boards: Annotated[
        tuple[SpecialBoards, ...], msgspec.Meta(description="boards that differ (configuration file only)")
    ] = ()
    modules: Annotated[
        tuple[Kind, ...], msgspec.Meta(description="ranges of triangles that differ (configuration file only)")
    ] = ()

    def __post_init__(self) -> None:
        special = [board for entry in self.special_boards for board in entry.boards]
        for board in (*self.boards, *special, *(m.board for m in self.modules)):
            if not FIRST_BOARD <= board <= LAST_BOARD:
                raise ConfigurationError(
                    f"board address {board}: boards have {FIRST_BOARD} to {LAST_BOARD} (0 is the host, 15 everybody)"
                )
        if len(set(self.boards)) < len(self.boards):
            raise ConfigurationError(f"boards {self.boards}: an address occurs twice")
        for kind in (self.kind, *(m.kind for m in self.modules)):
            if kind and kind not in NON_TACTILE:
                raise ConfigurationError(f"kind {kind!r}: choose one of {', '.join(NON_TACTILE)}")
        for module in self.modules:
            if any(not 0 <= t < TRIANGLES for t in module.triangles):
                raise ConfigurationError(f"board {module.board}: triangles {module.triangles} are not all 0 to 15")
            if any(not 0 <= channel < CHANNELS for channel in module.thermal or ()):
                raise ConfigurationError(f"board {module.board}: thermal channels {module.thermal} are not all 0 to 11")
        for inertial in self.all_inertial:
            _check_inertial(inertial, self.inertial_scale)
        if self.old_style:
            _check_old_style(self)

    @property
    def all_inertial(self) -> list[Inertial]:
        """The sets of inertial sensors that boards send."""
        own = [special.inertial for special in self.special_boards if special.inertial is not None]
        return [inertial for inertial in (self.inertial, *own) if inertial]


def _check_inertial(inertial: Inertial, scale: str) -> None:
    if len(set(inertial)) < len(inertial):
        raise ConfigurationError(f"inertial sensors {', '.join(inertial)}: one occurs twice")
    if {"accelerometer", "external_accelerometer"} <= set(inertial):
        raise ConfigurationError("a board's own and its external accelerometer send one message: choose one of them")
    imu = [sensor for sensor in inertial if sensor.startswith("imu_")]
    if imu and len(imu) < len(inertial):
        raise ConfigurationError(
            f"inertial sensors {', '.join(inertial)}: a board sends either those of an imu or the others"
        )
    if imu and scale != "mtb4":
        raise ConfigurationError(f"{imu[0]}: only an MTB4 has it, so inertial_scale must be mtb4")


def _check_old_style(options: RoboskinOptions) -> None:
    if options.all_inertial:
        raise ConfigurationError("old_style: boards that are configured the old way send no inertial data")
    periods = [options.period_ms, *(s.period_ms for s in options.special_boards if s.period_ms is not None)]
    if max(periods) > LONGEST_OLD_PERIOD_MS:
        raise ConfigurationError(f"old_style: a period of {max(periods)} ms, the most is {LONGEST_OLD_PERIOD_MS}")
    for skin_type in (options.skin_type, *(s.skin_type for s in options.special_boards)):
        if skin_type is not None and skin_type > 3:
            raise ConfigurationError(f"old_style: skin type {skin_type} needs the new commands; choose 0 to 3")
    for module in options.modules:
        if module.shift is not None or module.cdc_offset is not None:
            raise ConfigurationError(
                f"old_style: board {module.board}: the old set-up has no shift or cdc_offset for single triangles"
            )


def runs(numbers: Iterable[int]) -> list[tuple[int, int]]:
    """Return the first and last of every run of consecutive numbers."""
    found: list[tuple[int, int]] = []
    for number in sorted(set(numbers)):
        if found and found[-1][1] == number - 1:
            found[-1] = (found[-1][0], number)
        else:
            found.append((number, number))
    return found


def runs_text(numbers: Iterable[int]) -> str:
    """Return numbers as people write them: ``0-4, 7``."""
    return ", ".join(str(first) if first == last else f"{first}-{last}" for first, last in runs(numbers))


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
