"""Unitree's Dex3-1 hands on a G1: nine pads of 12 taxels a hand, on topics of DDS.

Sources: unitreerobotics/unitree_ros2, commit eea2719 (2026-06-15), ``unitree_hg/msg``; unitreerobotics/unitree_sdk2,
commit 21d0a3b (2026-07-09), ``idl/hg`` and ``example/g1/dex3``; the maker's page on the hand for valid values.
There are two editions of the type: ``PressSensorState_`` had no ``lost`` before, and has none in unitree_sdk2_python,
commit bddc17a. DDS shows both by the same name.

The maker publishes no places of pads and taxels. Owners found them by touch: Skvayzer/unitree_sim_isaaclab, commit
9e881f2 (2026-04-26), the pads of both hands; sri299792458/dex3_pressure_tools, commit e0b706d (2026-06-25), the pads of
a right hand, its taxels after a figure, and that only 33 of its 108 taxels have readings, which lie 10 to 12 mm apart.

A sample has fixed places for seven motors and a known number of pads: u32 7, seven motors of 56 bytes, u32 9, the pads,
and the rest with the quaternion of an IMU first. A pad is 12 pressures and 12 temperatures, float32, and ``lost`` and
``reserve``, u32. It becomes a frame for each pad: time u32, the values, a number u32 that counts samples and what the
pad says to be lost, and a status byte for each value.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Sequence
from typing import Annotated, Literal

import numpy as np
import numpy.typing as npt
from msgspec import Meta

from skinware.errors import BusError, ConfigurationError
from skinware.geometry import Geometry
from skinware.ros_types import Definitions
from skinware.sensor_types import PRESSURE, TEMPERATURE, SensorType
from skinware.status import Status
from skinware_drivers.description import Module, Patch, taxels
from skinware_drivers.fields import Bits, Identifier, Match, SequenceNumber, StatusBytes
from skinware_drivers.hand import Grid, Hand
from skinware_drivers.layout import Frame, Layout, Values
from skinware_drivers.link import Link
from skinware_drivers.operations import operation
from skinware_drivers.options import Options
from skinware_drivers.polling import Notice
from skinware_drivers.serial.framing import Framing
from skinware_drivers.serial.framings import Split
from skinware_drivers.streams.dds import ENCAPSULATION, SOURCE_TIME, DdsAdapter, DdsTopic, samples

_SIDES: tuple[Literal["left", "right"], ...] = ("left", "right")
_STATE = "unitree_hg/msg/HandState"
_TEXTS = {
    "unitree_hg/MotorState": (
        "uint8 mode\nfloat32 q\nfloat32 dq\nfloat32 ddq\nfloat32 tau_est\nint16[2] temperature\nfloat32 vol\n"
        "uint32[2] sensor\nuint32 motorstate\nuint32[4] reserve\n"
    ),
    "unitree_hg/IMUState": (
        "float32[4] quaternion\nfloat32[3] gyroscope\nfloat32[3] accelerometer\nfloat32[3] rpy\nint16 temperature\n"
    ),
    "unitree_hg/PressSensorState": "float32[12] pressure\nfloat32[12] temperature\nuint32 lost\nuint32 reserve\n",
    "unitree_hg/HandState": (
        "unitree_hg/MotorState[] motor_state\nunitree_hg/PressSensorState[] press_sensor_state\n"
        "unitree_hg/IMUState imu_state\nfloat32 power_v\nfloat32 power_a\nfloat32 system_v\nfloat32 device_v\n"
        "uint32[2] error\nuint32[2] reserve\n"
    ),
}
_OLD_PAD = {"unitree_hg/PressSensorState": "float32[12] pressure\nfloat32[12] temperature\n"}
_EDITIONS = Definitions(_STATE, _TEXTS), Definitions(_STATE, _TEXTS | _OLD_PAD)
_BEGINNINGS = {"full": "rt/dex3", "low": "rt/lf/dex3"}

_MOTORS, _TAXELS, _MOST_PADS = 7, 12, 16
_FINGERS = ("thumb pad", "thumb tip", "middle pad", "middle tip", "index pad", "index tip")
_ASIDE_M = {"palm middle": -0.026, "palm centre": 0.0, "palm index": 0.026}
"""The pads of the palm, by the finger that is nearest."""
_PADS_OF = {"left": (*_FINGERS, *reversed(_ASIDE_M)), "right": (*_FINGERS, *_ASIDE_M)}
_FROM_END_M = {"tip": 0.018, "pad": 0.059}
_BELOW_FINGERS_M = 0.0105
_ON_FINGER, _ON_PALM = Grid(4, 3, 0.004), Grid(3, 4, 0.004)
_CELLS = np.arange(_TAXELS)
_LITTLE_ENDIAN = (b"\0\1", b"\0\7")
"""Encapsulations: plain CDR of version 1 and 2, which are the same for these types."""
_MOTORS_END = ENCAPSULATION + 4 + 56 * _MOTORS
_PADS = _MOTORS_END + 4
_REST = 52 + 4 + 16 + 16
_VALUES = [("values", "<f4", 2 * _TAXELS)]
_PAD_TYPES = (np.dtype([*_VALUES, ("lost", "<u4"), ("reserve", "<u4")]), np.dtype(_VALUES))
_ROW = np.dtype([("time", "<u4"), *_VALUES, ("number", "<u4"), ("status", "u1", 2 * _TAXELS)])
_VALUES_AT, _NUMBER_AT, _STATUS_AT = 4, 100, 104
_UNIT = (0.9, 1.1)
_LEAST_VALID, _NO_READING = 100_000, 30_000

_PAD = 0x100
"""Identifier of a pad's frame: this, hand << 4, pad."""
_FIRST_S, _LISTEN_S, _AGAIN_S = 5.0, 0.25, 5.0


def _topics(beginning: str, sides: Sequence[str]) -> list[DdsTopic]:
    return [
        DdsTopic(f"{beginning}/{side}/state", edition, _SIDES.index(side)) for side in sides for edition in _EDITIONS
    ]


class Dex3Options(Options, frozen=True):
    hands: Annotated[
        Literal["heard", "both", "left", "right"], Meta(description="hands to read; heard: those that publish")
    ] = "heard"
    rate: Annotated[
        Literal["full", "low"], Meta(description="full: topics rt/dex3/..., low: rt/lf/dex3/..., the same less often")
    ] = "full"
    pads: Annotated[int, Meta(ge=1, le=_MOST_PADS, description="pads of a hand; others are not shown")] = 9
    names: Annotated[
        tuple[str, ...], Meta(description="names of pads, as 0=thumb tip, where a hand differs from those of owners")
    ] = ()
    period_ms: Annotated[float, Meta(ge=1, le=10_000, description="nominal time between two samples, ms")] = 2

    def __post_init__(self) -> None:
        super().__post_init__()
        self.named()

    def named(self) -> dict[int, str]:
        """Return the names of pads, by number."""
        named = {}
        for text in self.names:
            number, equals, name = text.partition("=")
            if not (number.isascii() and number.isdecimal() and equals and name.strip() and int(number) < self.pads):
                raise ConfigurationError(f"option names: {text!r}: write NUMBER=NAME, as 0=thumb tip")
            named[int(number)] = name.strip()
        return named

    def names_of(self, side: Literal["left", "right"]) -> list[str]:
        """Return the names of a hand's pads: those that are given, and others as owners found them."""
        named = self.named()
        known = {pad: name for pad, name in enumerate(_PADS_OF[side]) if name not in named.values()}
        return [named.get(pad) or known.get(pad) or f"pad {pad}" for pad in range(self.pads)]


class Dex3Driver(DdsAdapter[Dex3Options]):
    """One or two hands; uid = hand << 8 | pad << 4 | taxel, of both pressure and temperature."""

    topics: Sequence[DdsTopic] = [topic for beginning in _BEGINNINGS.values() for topic in _topics(beginning, _SIDES)]
    types: Sequence[SensorType] = (
        PRESSURE.measured(unit="counts", minimum=_LEAST_VALID),
        TEMPERATURE.measured(unit="counts"),
    )
    dtype: npt.DTypeLike = np.float32
    layout = Layout(
        [
            Frame(
                "pad",
                [Identifier(_PAD, 0x7E0)],
                [_ROW.itemsize],
                Values(_VALUES_AT, "<f4", 2 * _TAXELS),
                patch=Bits(shift=4, width=1),
                module=Bits(shift=0, width=4),
                flags=[StatusBytes(_STATUS_AT, Status.SUSPECT | Status.NOT_CONNECTED)],
                sequence=SequenceNumber(_NUMBER_AT, "<u4"),
                time=SOURCE_TIME,
            )
        ]
    )
    payload_size = _ROW.itemsize

    def __init__(self, options: Dex3Options) -> None:
        super().__init__(options)
        self.period_s: float = options.period_ms / 1e3
        sides = (options.hands,) if options.hands in _SIDES else _SIDES
        self.topics = _topics(_BEGINNINGS[options.rate], sides)
        self._sizes = {_PADS + options.pads * pad.itemsize + _REST: pad for pad in _PAD_TYPES}
        self.framing: Framing = Split(samples(max(self._sizes)), self._split)
        self._lost = np.full((len(_SIDES), options.pads), -1, np.int64)  # as the pads count; -1: not known yet
        self._numbers = np.zeros((len(_SIDES), options.pads), np.int64)
        self._totals = np.zeros((len(_SIDES), options.pads), np.int64)
        self._described: Sequence[Patch] = ()
        self.geometry: Geometry | None = None

    async def describe(self, link: Link) -> Sequence[Patch]:
        """Return the hands of the options, or those that are heard."""
        return await self.join(link, ())

    async def join(self, link: Link, known: Sequence[Patch]) -> Sequence[Patch]:
        """Return the hands that are known, and those of the options or those that are heard."""
        hands = {_SIDES.index(side) for side in _SIDES if self.options.hands in (side, "both")}
        if not hands:
            hands = await self._heard(link) | {patch.key for patch in known}
        names = {hand: self.options.names_of(_SIDES[hand]) for hand in sorted(hands)}
        places = [place for hand, of_hand in names.items() for place in _nominal(hand, of_hand)]
        self.geometry = Geometry.joined(places) if places else None
        self._described = [
            Patch(
                f"{_SIDES[hand]} hand",
                [
                    Module(
                        [
                            *taxels(_TAXELS, "pressure", first_uid=hand << 8 | pad << 4),
                            *taxels(_TAXELS, "temperature", first_uid=hand << 8 | pad << 4),
                        ],
                        key=pad,
                        kind="4x3",
                        name=name,
                    )
                    for pad, name in enumerate(of_hand)
                ],
                key=hand,
            )
            for hand, of_hand in names.items()
        ]
        return self._described

    async def attend(self, link: Link) -> None:
        """Notice when the other hand begins to publish, unless the options say which hands there are."""
        while self.options.hands == "heard":
            known = [patch.key for patch in self._described]
            others = [Match(_PAD | hand << 4) for hand in range(len(_SIDES)) if hand not in known]
            if not others:
                return
            with link.follow(*others) as frames:
                while len((await frames.get()).payload) != _ROW.itemsize:
                    pass
            self.tell(self._described[0], Notice.CHANGED)
            await link.sleep(_AGAIN_S)

    @classmethod
    async def identify(cls, link: Link, *, idle: bool) -> str | None:  # noqa: ARG003
        """Return the hands that publish; other buses are not waited for."""
        if "dds:" not in link.bus_name:
            return None
        hands = await cls(Dex3Options())._heard(link)  # noqa: SLF001
        return f"Unitree Dex3-1: {', '.join(_SIDES[hand] for hand in sorted(hands))}"

    @operation(looks=True)
    async def lost(self, link: Link, patches: Sequence[Patch]) -> dict[str, int]:  # noqa: ARG002
        """Return what the pads said to have lost since the driver began, by hand and pad, without zeros."""
        counted = zip(*np.nonzero(self._totals), strict=True)
        return {f"{_SIDES[hand]} hand, pad {pad}": int(self._totals[hand, pad]) for hand, pad in counted}

    async def _heard(self, link: Link) -> set[int]:
        hands: set[int] = set()
        for _ in range(round(_FIRST_S / _LISTEN_S)):
            heard = await link.listen(_LISTEN_S)
            new = {one.identifier >> 4 & 1 for one in heard if one.length == _ROW.itemsize}
            if hands:
                return hands | new
            hands = new
        why = f" that fit ({self.troubles[-1]})" if self.troubles else ""
        raise BusError(f"{link.bus_name}: no samples of a hand{why} within {_FIRST_S:g} s")

    def _split(self, hand: int, body: bytes) -> Iterable[tuple[int, bytes]]:
        """Return the frames of a sample's pads; a short one, counted by its length, if it does not fit."""
        sample = body[SOURCE_TIME.end :]
        wrong = self._misfit(sample) if hand < len(_SIDES) else "a topic that is not known"
        if wrong:
            self.log_once(f"{_SIDES[hand & 1]} hand: {wrong}")
            return [(_PAD | (hand & 1) << 4, body[: SOURCE_TIME.end])]
        pads = np.frombuffer(sample, self._sizes[len(sample)], self.options.pads, _PADS)
        rows = np.zeros(len(pads), _ROW)
        rows["time"], rows["values"], rows["status"] = np.frombuffer(body, "<u4", 1), pads["values"], _status(pads)
        lost = self._lost_of(hand, pads)
        rows["status"][lost > 0] |= np.uint8(Status.SUSPECT)
        self._numbers[hand] += 1 + lost
        rows["number"] = self._numbers[hand] & 0xFFFF_FFFF
        return [(_PAD | hand << 4 | pad, row.tobytes()) for pad, row in enumerate(rows)]

    def _misfit(self, sample: bytes) -> str:
        """Return why a sample is none of the type, although DDS says so; empty if it is one."""
        if len(sample) < _PADS or sample[:2] not in _LITTLE_ENDIAN:
            return f"a sample of {len(sample)} bytes that is no little-endian HandState_"
        motors, pads = (int.from_bytes(sample[at : at + 4], "little") for at in (ENCAPSULATION, _MOTORS_END))
        if motors != _MOTORS or pads != self.options.pads:
            return (
                f"{motors} motors and {pads} pads instead of {_MOTORS} and {self.options.pads}, or another HandState_"
            )
        if len(sample) not in self._sizes:
            return f"a sample of {len(sample)} bytes, not {' or '.join(map(str, self._sizes))}"
        at = _PADS + pads * self._sizes[len(sample)].itemsize
        length = sum(part * part for part in struct.unpack_from("<4f", sample, at))
        if length != 0 and not _UNIT[0] <= length <= _UNIT[1]:  # 0: no IMU
            return "a quaternion of another length than 1: another HandState_"
        return ""

    def _lost_of(self, hand: int, pads: npt.NDArray[np.void]) -> npt.NDArray[np.int64]:
        """Return (pads,) int64: how many more each pad says to be lost; a count that went back has begun again."""
        if "lost" not in (pads.dtype.names or ()):
            return np.zeros(len(pads), np.int64)
        now, before = pads["lost"].astype(np.int64), self._lost[hand]
        more = np.where((before >= 0) & (now > before), now - before, 0)
        self._lost[hand] = now
        self._totals[hand] += more
        for pad in np.flatnonzero((more > 0) & (self._totals[hand] == more)).tolist():
            self.log_once(f"{_SIDES[hand]} hand: pad {pad} loses data (logged once)")
        return more


def _nominal(hand: int, names: Sequence[str]) -> list[Geometry]:
    """Return nominal places of the pads whose names say where they are."""
    of_side, places = Hand(_SIDES[hand], "claw"), []
    for pad, name in enumerate(names):
        if name in _ASIDE_M:
            place, grid = of_side.place("palm", _BELOW_FINGERS_M, _ASIDE_M[name]), _ON_PALM
            cells = 4 * (_CELLS % 3) + 3 - _CELLS // 3  # by columns, from the upper right
        elif name in _FINGERS:
            finger, part = name.split()
            place, grid = of_side.place(finger, _FROM_END_M[part]), _ON_FINGER
            cells = _CELLS if part == "tip" else _CELLS[::-1]
        else:
            continue
        uids = hand << 8 | pad << 4 | _CELLS
        places.append(grid.at(place, ["pressure", "temperature"], uids.tolist(), cells.tolist()))
    return places


def _status(pads: npt.NDArray[np.void]) -> npt.NDArray[np.uint8]:
    """Return (pads, 24) uint8 by the maker's words: 30000 is no reading, less than 100000 is not valid."""
    values = pads["values"]
    status = np.where(np.isfinite(values), 0, Status.SUSPECT).astype(np.uint8)
    status[:, :_TAXELS][~(values[:, :_TAXELS] >= _LEAST_VALID)] = Status.SUSPECT
    status[values == _NO_READING] = Status.NOT_CONNECTED
    return status
