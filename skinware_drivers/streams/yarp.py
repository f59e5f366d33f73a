"""The skin ports of a robot that runs YARP, such as iCub: one vector of values a message, in the carrier ``fast_tcp``.

The port does not say which sensors its values belong to; the robot's files do (``skin-import icub --yarp``). The module
``yarp_messages`` parses messages, ``yarp_bus`` finds and reads the port.

By robotology/icub-main, the port of a part (``/icub/skin/left_hand``) has the values of its boards, 0 to 255, where
less is more pressure and unused triangles have a place too. The ports of skinManager (``/icub/skin/left_hand_comp``)
have the rest of it beyond the baseline: 0 at rest, up to 255.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Sequence
from typing import Annotated, Literal

import msgspec
import numpy as np
import numpy.typing as npt
from msgspec import Meta

from skinware.errors import BusError, ConfigurationError
from skinware.sensor_types import PRESSURE, TEMPERATURE, SensorType
from skinware_drivers.can.roboskin_layout import CHANNELS, NON_TACTILE, TRIANGLES
from skinware_drivers.description import Module, Patch, Sensor
from skinware_drivers.fields import NO_NUMBER, Bits, DeviceTime, Identifier, Match
from skinware_drivers.layout import Frame, Layout, Values
from skinware_drivers.link import Link
from skinware_drivers.options import Options
from skinware_drivers.polling import Notice
from skinware_drivers.serial.adapter import SerialAdapter
from skinware_drivers.serial.framing import Framing
from skinware_drivers.streams.yarp_messages import LENGTH, MOST_VALUES, PLAIN, TIMED, VALUES_OF_A_FRAME, YarpMessages

log: logging.Logger = logging.getLogger("skinware.driver")

_FIRST_S = 5.0
_LENGTHS = Match(LENGTH << 8)
_KIND = 0x700
_OF_A_BOARD = TRIANGLES * CHANNELS
_MOST_PATCHES = 16
_COMPENSATED = (PRESSURE.measured(unit="counts", minimum=0.0, maximum=255.0),)
_RAW = (
    PRESSURE.measured(unit="counts", scale=-1.0, offset=255.0, minimum=0.0, maximum=255.0),
    TEMPERATURE.measured(unit="counts", minimum=0.0, maximum=255.0),
)


class Triangles(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Triangles of a board that have a place in the port's vector.

    Attributes:
        first: place of the first value of its triangle 0, even if that is missing; below 0: before the vector.
        kind: ``triangle``, ``fingertip`` or ``palm``.
        thermal: channels that feel no touch, unless they are those of the kind.
    """

    board: int
    first: int
    triangles: tuple[Annotated[int, Meta(ge=0, lt=TRIANGLES)], ...]
    kind: Literal["triangle", "fingertip", "palm"] = "triangle"
    thermal: tuple[Annotated[int, Meta(ge=0, lt=CHANNELS)], ...] | None = None

    def places(self) -> list[tuple[int, int]]:
        return [(triangle, self.first + CHANNELS * triangle) for triangle in self.triangles]

    def non_tactile(self) -> Sequence[int]:
        return NON_TACTILE[self.kind] if self.thermal is None else self.thermal


class YarpOptions(Options, frozen=True):
    values: Annotated[
        Literal["compensated", "raw"],
        Meta(description="compensated: 0 is no touch; raw: the values of the boards, where less is more pressure"),
    ] = "compensated"
    length: Annotated[
        int, Meta(ge=0, le=MOST_VALUES, description="values of a message; 0: as many as the port sends")
    ] = 0
    period_ms: Annotated[float, Meta(ge=1, le=10_000, description="nominal time between two messages, ms")] = 20
    triangles: Annotated[
        tuple[Triangles, ...],
        Meta(description="places of the triangles in a message (configuration file only, as skin-import writes it)"),
    ] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        taken: set[int] = set()
        for run in self.triangles:
            for triangle, place in run.places():
                where = f"option triangles: triangle {triangle} of board {run.board} begins at value {place}"
                if not 0 <= place <= (self.length or MOST_VALUES) - CHANNELS:
                    raise ConfigurationError(
                        f"{where}, outside of the {self.length or MOST_VALUES} values of a message"
                    )
                if any(abs(place - other) < CHANNELS for other in taken):
                    raise ConfigurationError(f"{where}, where another one is")
                taken.add(place)
        if self.triangles and not self.length:
            raise ConfigurationError("option triangles: give length too, as skin-import does")
        if len({run.board for run in self.triangles}) > _MOST_PATCHES:
            raise ConfigurationError(f"option triangles: more than {_MOST_PATCHES} boards")


class YarpDriver(SerialAdapter[YarpOptions]):
    """One port. A patch is a board, or 16 x 12 values where the options name no boards; uid = place in the vector."""

    framing: Framing = YarpMessages()
    dtype: npt.DTypeLike = np.float32
    layout: Layout = Layout(
        [
            Frame(
                name,
                [Identifier(kind << 8, _KIND)],
                [4 + 4 * VALUES_OF_A_FRAME],
                Values(4, "<f4", VALUES_OF_A_FRAME),
                patch=Bits(shift=4, width=4),
                module=Bits(shift=0, width=4),
                flags=NO_NUMBER,
                time=time,
            )
            for name, kind, time in (("plain", PLAIN, None), ("timed", TIMED, DeviceTime(0, "<u4", 1e-3)))
        ]
    )

    def __init__(self, options: YarpOptions) -> None:
        super().__init__(options)
        self.period_s: float = options.period_ms / 1e3
        self.types: Sequence[SensorType] = _RAW if options.values == "raw" else _COMPENSATED
        self._length = options.length
        self._described: Sequence[Patch] = ()

    async def describe(self, link: Link) -> Sequence[Patch]:
        """Return the boards of the options, or patches for as many values as the port sends."""
        if self.options.triangles:
            self._described, parts = self._of_boards()
        else:
            self._length = await self._heard_length(link)
            self._described, parts = self._of_places(self._length)
        self.change_framing(YarpMessages(self._length, tuple(parts)))
        return self._described

    async def attend(self, link: Link) -> None:
        """Notice when the port sends another number of values."""
        with link.follow(_LENGTHS) as lengths:
            while True:
                length = int.from_bytes((await lengths.get()).payload, "little")
                if length == self._length:
                    continue
                if self.options.length:
                    log.warning(
                        "%s: messages have %d values, and not %d as the options say: none is shown. Are these the"
                        " files of this robot?",
                        link.bus_name,
                        length,
                        self._length,
                    )
                elif self._described:
                    log.info("%s: messages have %d values now", link.bus_name, length)
                    self.tell(self._described[0], Notice.CHANGED)

    @classmethod
    async def identify(cls, link: Link, *, idle: bool) -> str | None:  # noqa: ARG003
        """Return the number of values that it sends; other buses are not waited for."""
        if "yarp:" not in link.bus_name:
            return None
        return f"YARP port with {', '.join(patch.name for patch in await cls(YarpOptions()).describe(link))}"

    async def _heard_length(self, link: Link) -> int:
        with link.follow(_LENGTHS) as lengths:
            self.change_framing(YarpMessages())  # reports it again
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(_FIRST_S):
                    while True:
                        length = int.from_bytes((await lengths.get()).payload, "little")
                        if length == (self.options.length or length):
                            return length
        raise BusError(f"{link.bus_name}: no messages with {self.options.length or 'any'} values within {_FIRST_S:g} s")

    def _of_places(self, length: int) -> tuple[list[Patch], list[tuple[int, int]]]:
        """Return boards of sixteen triangles that all feel touch; the last triangle may have fewer channels."""
        patches, parts = [], []
        for patch, start in enumerate(range(0, length, _OF_A_BOARD)):
            modules = []
            for number, first in enumerate(range(start, min(length, start + _OF_A_BOARD), CHANNELS)):
                sensors = [Sensor("pressure", place) for place in range(first, min(length, first + CHANNELS))]
                modules.append(Module([*sensors, *[None] * (CHANNELS - len(sensors))], key=number))
                parts.append((patch << 4 | number, first))
            last = min(length, start + _OF_A_BOARD) - 1
            patches.append(Patch(f"values {start}-{last}", modules, key=patch))
        return patches, parts

    def _of_boards(self) -> tuple[list[Patch], list[tuple[int, int]]]:
        boards: dict[int, list[Module]] = {}
        parts = []
        for run in self.options.triangles:
            modules = boards.setdefault(run.board, [])
            patch = list(boards).index(run.board)
            for triangle, first in run.places():
                sensors = [self._sensor(channel, first, run) for channel in range(CHANNELS)]
                modules.append(Module(sensors, key=triangle, kind=run.kind, name=f"{run.kind} {triangle}"))
                parts.append((patch << 4 | triangle, first))
        patches = [Patch(f"board {board}", modules, key=key) for key, (board, modules) in enumerate(boards.items())]
        return patches, parts

    def _sensor(self, channel: int, first: int, run: Triangles) -> Sensor | None:
        """Return a sensor; None for a channel without touch in compensated values."""
        if channel not in run.non_tactile():
            return Sensor("pressure", first + channel)
        return Sensor("temperature", first + channel) if self.options.values == "raw" else None
