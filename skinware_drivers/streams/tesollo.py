"""Tesollo's hands DG-3F-M, DG-4F, DG-5F and DG-5F-S, with tactile or force sensors in their fingertips.

Wire format: the maker's program dg_tcp_comm (github.com/tesollodelto/dg_tcp_comm, BSD-3), commits of 2026. TCP port
502, but no Modbus. Everything is big-endian: ``length u16 of all | command u8 | ...``. There is no checksum.

* ``00 03 08`` -> ``00 09 08 | model u16 | firmware 2 bytes | kind of sensors u8 | fingers that have one u8``; older
  firmware: ``00 07 08 | model u16 | firmware``.
* ``length 01 | what ...`` with what = 1 joints, 2 currents, 3 temperatures, 4 velocities, 5 fingertips, 6 GPIO ->
  ``length 01 | 8 bytes for each motor | each finger's sensor | GPIO``. The program always asks for 1 to 4, or 1 to 5.
* ``00 03 0B``: the force sensors take their present values as zero; the program waits for no answer.
* Force sensors of three axes send (x, y, z, nc, nc, nc), of four axes (x, y, z, nc, nc, tz): commit 116a684
  (2026-03-26).

The program contradicts itself: one commit (8c85809) expects bytes of all fingers, another (0ea90ef) only of those that
have a sensor. The length shows which, so both are read.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Annotated, Literal, NamedTuple

import numpy as np
import numpy.typing as npt
from msgspec import Meta

from skinware.errors import BusError
from skinware.geometry import Geometry
from skinware.nominal_hand import FINGERS
from skinware.sensor_types import FORCE, PRESSURE, SensorType
from skinware.status import Status
from skinware_drivers.description import Module, Patch, Sensor
from skinware_drivers.fields import Identifier, Match, Sentinel
from skinware_drivers.hand import Grid, Hand
from skinware_drivers.layout import Frame, Layout, Values
from skinware_drivers.link import Link
from skinware_drivers.operations import operation
from skinware_drivers.options import Options
from skinware_drivers.polling import Notice, Poll, ZeroWatch
from skinware_drivers.serial.adapter import SerialAdapter
from skinware_drivers.serial.framing import Encoding, Field, Framing
from skinware_drivers.serial.framings import LengthFirst, Part, Split, by_length

log: logging.Logger = logging.getLogger("skinware.driver")

_ASK, _VERSION, _OFFSET = 0x01, 0x08, 0x0B
_EVERYTHING = bytes((1, 2, 3, 4, 5))
_FINGER = 0x100  # identifier of the frame of finger 0
_HEADER, _MOTOR = 3, 8
_VERSIONS = frozenset({(_VERSION, 7), (_VERSION, 9)})
_TIMEOUT_S, _TRIES = 1.0, 3
_MOST_BODY = 20 * _MOTOR + 5 * 36
_VENDOR = 0x7E5
_TORQUE = tuple(
    SensorType(f"torque_{axis}", _VENDOR << 12 | number, "N m", scale=1e-3) for number, axis in enumerate("xyz", 1)
)
_AXES = (*(force.measured(scale=0.1) for force in FORCE), *_TORQUE)


class _Model(NamedTuple):
    name: str
    motors: int
    fingers: int
    side: Literal["right", "left"] = "right"


_MODELS = {
    0x1F02: _Model("DG-1F", 3, 1),
    0x2F03: _Model("DG-2F", 6, 2),
    0x3F02: _Model("DG-3F-M", 12, 3),
    0x4F02: _Model("DG-4F", 18, 4),
    0x5F02: _Model("DG-5F", 20, 5),
    0x5F12: _Model("DG-5F left", 20, 5, "left"),
    0x5F22: _Model("DG-5F right", 20, 5),
    0x5F14: _Model("DG-5F-S left", 20, 5, "left"),
    0x5F24: _Model("DG-5F-S right", 20, 5),
    0x5F34: _Model("DG-5F-S15 left", 15, 5, "left"),
    0x5F44: _Model("DG-5F-S15 right", 15, 5),
}


_PITCH_M = 0.0035
"""Distance of cells that fill a fingertip: the maker publishes none."""


class _Tip(NamedTuple):
    """A fingertip: cells in a grid or, without a grid, axes of a force sensor."""

    name: str
    dtype: str
    values: int
    grid: Grid | None = None

    @property
    def size(self) -> int:
        return np.dtype(self.dtype).itemsize * self.values


_TIPS = {
    1: _Tip("six axes", ">i2", 6),
    2: _Tip("three axes", ">i2", 6),
    3: _Tip("TACTILE_M", "u1", 15, Grid(3, 5, _PITCH_M)),
    4: _Tip("four axes", ">i2", 6),
    5: _Tip("TACTILE_S", ">u2", 18, Grid(3, 6, _PITCH_M)),
}
_FORCES = ["force_x", "force_y", "force_z"]
_MEASURED: dict[int, Sequence[str]] = {2: _FORCES, 4: [*_FORCES, "torque_z"]}
"""Axes of sensors that have fewer than six; their other values are not connected."""


class TesolloOptions(Options, frozen=True):
    period_ms: Annotated[int, Meta(ge=1, le=1000, description="time between two questions, ms")] = 10
    timeout_ms: Annotated[int, Meta(ge=1, le=5000, description="wait for an answer before asking again, ms")] = 30
    sensors: Annotated[
        Literal[0, 1, 2, 3, 4, 5],
        Meta(description="kind of sensors, for hands whose firmware does not report it; 0: ask the hand"),
    ] = 0


class _Hand(NamedTuple):
    model: int
    firmware: bytes
    sensors: int
    fitted: tuple[int, ...]


class TesolloDriver(SerialAdapter[TesolloOptions]):
    """One hand; uid = finger << 8 | cell, or finger << 8 for the axes of a force sensor."""

    framing: Framing = LengthFirst(length=Field(0, 2, "big"), identifier=Field(2), answers=_VERSIONS)
    commands: Encoding | None = framing
    baudrate: int = 100_000_000  # Ethernet
    dtype: npt.DTypeLike = np.uint8
    layout: Layout
    watch = ZeroWatch
    payload_size = -(-_MOST_BODY // 8) * 8  # of any hand: the model is known only after it was asked

    def __init__(self, options: TesolloOptions) -> None:
        super().__init__(options)
        self.period_s: float = options.period_ms / 1e3
        self.geometry: Geometry | None = None
        self._hand: _Hand | None = None

    @property
    def polls(self) -> Sequence[Poll]:
        return [Poll(_ASK, _EVERYTHING, self.period_s, Match(_FINGER, 0x700), self.options.timeout_ms / 1e3)]

    async def describe(self, link: Link) -> Sequence[Patch]:
        """Ask the hand for its model and its sensors."""
        if link.listen_only:
            raise BusError("a hand of Tesollo only answers: listening is not enough")
        self.change_framing(type(self).framing)
        self._hand = hand = await self._ask_version(link)
        model, tip = _MODELS[hand.model], _TIPS[hand.sensors]
        log.info("%s: %s, firmware %s, %s", link.bus_name, model.name, hand.firmware.hex("."), tip.name)
        self.dtype = np.dtype(tip.dtype).newbyteorder("=")
        self.types, names = self._channels(hand.sensors)
        names_of = FINGERS if model.fingers == len(FINGERS) else [f"finger {n + 1}" for n in range(model.fingers)]
        modules = [
            Module(
                [
                    None if name is None else Sensor(name, finger << 8 | (cell if tip.grid else 0))
                    for cell, name in enumerate(names)
                ],
                key=finger,
                kind=f"{tip.grid.rows}x{tip.grid.columns}" if tip.grid else "force",
                name=f"{names_of[finger]} tip",
            )
            for finger in hand.fitted
        ]
        self.geometry = _geometry(model, tip, hand.fitted, [kind.name for kind in self.types])
        self.layout = _layout(hand, tip)
        self.change_framing(self._framing(hand))
        return [Patch(model.name, modules)]

    @classmethod
    async def identify(cls, link: Link, *, idle: bool) -> str | None:  # noqa: ARG003
        """Ask for the model, which disturbs nothing; serial lines are not asked, because no hand has one."""
        if "tcp://" not in link.bus_name:
            return None
        hand = await cls(TesolloOptions(sensors=1))._ask_version(link)  # noqa: SLF001
        return f"Tesollo {_MODELS[hand.model].name}"

    async def probe(self, link: Link, patch: Patch) -> bool:
        if await self._ask_version(link, tries=1) == self._hand:
            return True
        self.tell(patch, Notice.CHANGED)
        return False

    @operation(sets_up=True)
    async def tare(self, link: Link, patches: Sequence[Patch]) -> None:  # noqa: ARG002
        """Let the force sensors take their present values as zero; tactile sensors have no such command."""
        if self._hand is None or _TIPS[self._hand.sensors].grid is not None:
            raise BusError("only hands with force sensors can be tared")
        await link.send(_OFFSET, b"")

    async def _ask_version(self, link: Link, tries: int = _TRIES) -> _Hand:
        body = (await link.request(_VERSION, b"", Match(_VERSION), timeout_s=_TIMEOUT_S, tries=tries)).payload
        model = int.from_bytes(body[:2], "big")
        if model not in _MODELS:
            raise BusError(f"the hand says it is of model {model:04X}, which is not known to have sensors")
        sensors, fitted = (body[4], body[5]) if len(body) >= 6 else (self.options.sensors, 0xFF)
        fingers = tuple(finger for finger in range(_MODELS[model].fingers) if fitted >> finger & 1)
        name = f"the hand ({_MODELS[model].name})"
        if len(body) < 6 and not sensors:
            raise BusError(f"{name} has a firmware that does not report its sensors: say sensors")
        if sensors not in _TIPS or not fingers:
            raise BusError(f"{name} says it has no sensors in its fingertips")
        return _Hand(model, body[2:4], sensors, fingers)

    def _channels(self, sensors: int) -> tuple[Sequence[SensorType], list[str | None]]:
        """Return the types of a fingertip, and the type name of each value; None: it is not measured."""
        tip = _TIPS[sensors]
        if tip.grid is not None:
            most = np.iinfo(np.dtype(tip.dtype)).max
            return (PRESSURE.measured(unit="counts", minimum=0, maximum=most),), ["pressure"] * tip.values
        names = _MEASURED.get(sensors, [axis.name for axis in _AXES])
        types = [axis for axis in _AXES if axis.name in names]
        return types, [axis.name if axis.name in names else None for axis in _AXES]

    def _framing(self, hand: _Hand) -> Framing:
        """Return the framing of this hand's answers, with bytes of all fingers or only of those with a sensor."""
        model, tip = _MODELS[hand.model], _TIPS[hand.sensors]
        start = _MOTOR * model.motors
        answers = {}
        for present in (hand.fitted, tuple(range(model.fingers))):
            places = {finger: start + tip.size * place for place, finger in enumerate(present)}
            answers[_ASK, start + tip.size * len(present)] = [
                Part(_FINGER | finger, places[finger], places[finger] + tip.size) for finger in hand.fitted
            ]
        known = _VERSIONS | {(_OFFSET, _HEADER)} | {(command, _HEADER + size) for command, size in answers}
        whole = LengthFirst(length=Field(0, 2, "big"), identifier=Field(2), answers=known)
        return Split(whole, by_length(answers))


def _layout(hand: _Hand, tip: _Tip) -> Layout:
    ends = np.iinfo(np.dtype(tip.dtype))
    saturated = [Sentinel(Status.OUT_OF_RANGE, end) for end in (ends.min, ends.max) if end]
    values = Values(0, tip.dtype, tip.values)
    frames = [
        Frame(f"finger {number}", [Identifier(_FINGER | number)], [tip.size], values, module=number, flags=saturated)
        for number in hand.fitted
    ]
    return Layout(frames)


def _geometry(model: _Model, tip: _Tip, fitted: Sequence[int], type_names: Sequence[str]) -> Geometry:
    """Return nominal places: the fingers of a hand with fewer than five are the first ones of a human hand."""
    grid = tip.grid or Grid(1, 1)
    places = []
    for finger in fitted:
        [centre] = Hand(model.side).down(FINGERS[finger], [grid])
        places.append(grid.at(centre, type_names, [finger << 8 | cell for cell in range(grid.rows * grid.columns)]))
    return Geometry.joined(places)
