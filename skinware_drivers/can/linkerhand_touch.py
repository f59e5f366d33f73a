"""What LinkerHands tell of touch, in each generation: which modules, in which frames, and how they are asked for.

All that is said to a hand and by it has one identifier; byte 0 tells what it is.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from skinware.geometry import Geometry
from skinware.sensor_types import PRESSURE, PROXIMITY, SensorType
from skinware.status import Status
from skinware_drivers.description import Module, Sensor, taxels
from skinware_drivers.hand import FINGERS, Grid, Hand
from skinware_drivers.layout import Bits, Byte, Cycle, Frame, Identifier, Layout, Sentinel, Values

PARTS = (*FINGERS, "palm")
MATRIX = 0xB1
"""Command for the thumb's matrix; the next ones are for the others of ``PARTS``."""
NO_DIRECTION = 255
_HAND, _COMMAND = Bits(0, 11), Bits(0, 8, byte=0)
_LONGEST_REPLY_S = 0.008
_VENDOR = 0x27027 << 12
TANGENTIAL = SensorType("tangential_force", _VENDOR | 1, "counts", minimum=0, maximum=255)
DIRECTION = SensorType("force_direction", _VENDOR | 2, "counts", minimum=0, maximum=254)
FORCE = PRESSURE.measured(unit="counts", minimum=0, maximum=255)


class Question(NamedTuple):
    """A command that asks for touch.

    Attributes:
        payload: of the question.
        last: how the last frame of the reply begins.
        shortest: bytes of that frame, at least: more than other programs' questions have.
    """

    payload: bytes
    last: bytes
    shortest: int


class Touch(ABC):
    """One way in which hands tell of touch.

    Attributes:
        types: of the sensors.
    """

    types: Sequence[SensorType]

    @abstractmethod
    def modules(self, hand: int, parts: Sequence[str]) -> list[Module]:
        """The modules of a hand that has these parts; ``hand`` is its identifier."""

    @abstractmethod
    def layout(self, identifier: Identifier) -> Layout:
        """What the frames of hands with such identifiers mean."""

    @abstractmethod
    def questions(self, parts: Sequence[str]) -> list[Question]:
        """What has to be asked to know it all, in order."""

    @abstractmethod
    def geometry(self, hand: int, parts: Sequence[str], side: Hand) -> Geometry:
        """Nominal places of a hand's sensors."""

    @abstractmethod
    def knows(self, first_byte: int, length: int) -> bool:
        """Whether a frame that begins so is told in this way."""


@dataclass(frozen=True)
class Matrices(Touch):
    """A matrix for each part, one frame for each of its rows, in order (second generation).

    Attributes:
        rows: of a matrix, at most 12.
        columns: of a matrix, at most 6.
    """

    rows: int
    columns: int
    types = (FORCE,)

    def modules(self, hand: int, parts: Sequence[str]) -> list[Module]:
        """One for each part."""
        count = self.rows * self.columns
        return [
            Module(taxels(count, first_uid=_uid(hand, part)), MATRIX + PARTS.index(part), self._kind, part)
            for part in parts
        ]

    def layout(self, identifier: Identifier) -> Layout:
        """A matrix is shown when all its rows have come, the first one first."""
        rows = [
            Frame(
                f"row {row}",
                [identifier, Byte(1, row << 4)],
                [2 + self.columns],
                Values(2, "u1", self.columns, to=range(row * self.columns, (row + 1) * self.columns)),
                patch=_HAND,
                module=_COMMAND,
            )
            for row in range(self.rows)
        ]
        return Layout([_other(identifier), *rows], Cycle([row.name for row in rows], maximum_age_s=_LONGEST_REPLY_S))

    def questions(self, parts: Sequence[str]) -> list[Question]:
        """One for each part."""
        commands = [MATRIX + PARTS.index(part) for part in parts]
        size, last = self.rows << 4 | self.columns, self.rows - 1 << 4
        return [Question(bytes((command, size)), bytes((command, last)), 2 + self.columns) for command in commands]

    def geometry(self, hand: int, parts: Sequence[str], side: Hand) -> Geometry:
        """A grid on each part."""
        grid = Grid(self.rows, self.columns)
        uids = [range(_uid(hand, part), _uid(hand, part) + self.rows * self.columns) for part in parts]
        centres = [side.down(part, [grid])[0] for part in parts]
        return Geometry.joined([grid.at(c, [FORCE.name], uid) for c, uid in zip(centres, uids, strict=True)])

    def knows(self, first_byte: int, length: int) -> bool:
        """Rows."""
        return MATRIX <= first_byte < MATRIX + len(PARTS) and length == 2 + self.columns

    @property
    def _kind(self) -> str:
        return f"{self.rows}x{self.columns}"


@dataclass(frozen=True)
class FingerValues(Touch):
    """Four values for each finger, of which a frame has one of all fingers (first generation).

    Attributes:
        command: that asks for the first of them; the next ones ask for the others.
    """

    command: int
    types = (FORCE, TANGENTIAL, DIRECTION, PROXIMITY.measured(unit="counts", minimum=0, maximum=255))

    def modules(self, hand: int, parts: Sequence[str]) -> list[Module]:
        """One for each of the four."""
        fingers = [part for part in parts if part in FINGERS]
        return [
            Module([Sensor(one.name, _uid(hand, finger)) for finger in fingers], self.command + at, name=one.name)
            for at, one in enumerate(self.types)
        ]

    def layout(self, identifier: Identifier) -> Layout:
        """Frames that stand alone. A sixth value, which some hands send, is dropped."""
        is_reply = identifier, Byte(len(FINGERS), 0, mask=0)  # long enough
        is_direction = Byte(0, self.command + self.types.index(DIRECTION))
        none = Sentinel(Status.OUT_OF_RANGE, NO_DIRECTION)
        lengths, values = (1 + len(FINGERS), 2 + len(FINGERS)), Values(1, "u1", len(FINGERS))
        return Layout(
            [
                _other(identifier),
                Frame("values", is_reply, lengths, values, _HAND, _COMMAND),
                Frame("directions", (*is_reply, is_direction), lengths, values, _HAND, _COMMAND, [none]),
            ]
        )

    def questions(self, parts: Sequence[str]) -> list[Question]:
        """One for each of the four."""
        del parts
        commands = [bytes([self.command + at]) for at in range(len(self.types))]
        return [Question(command, command, 1 + len(FINGERS)) for command in commands]

    def geometry(self, hand: int, parts: Sequence[str], side: Hand) -> Geometry:
        """All four of a finger at its tip."""
        grid, names = Grid(1, 1), [one.name for one in self.types]
        fingers = [part for part in parts if part in FINGERS]
        return Geometry.joined([grid.at(side.down(f, [grid])[0], names, [_uid(hand, f)]) for f in fingers])

    def knows(self, first_byte: int, length: int) -> bool:
        """Values of five or six fingers."""
        return self.command <= first_byte < self.command + len(self.types) and length in (6, 7)


TOUCH: dict[str, Touch] = {
    "12x6": Matrices(12, 6),
    "10x4": Matrices(10, 4),
    "fingers": FingerValues(0x20),
    "fingers_90": FingerValues(0x90),
}
"""By the names of the option ``touch``."""


def parts_heard(touch: Touch, commands: Collection[int]) -> list[str]:
    """The parts that a hand has, of which frames with these first bytes were heard."""
    if isinstance(touch, FingerValues):
        return list(FINGERS)
    return [part for at, part in enumerate(PARTS) if part in FINGERS or MATRIX + at in commands]


def _other(identifier: Identifier) -> Frame:
    """Questions, motion, and whatever else is said to a hand and by it: half of a command names no module."""
    return Frame("other", [identifier], range(9), Values(0, "u1", 0), patch=_HAND, module=Bits(4, 4, byte=0))


def _uid(hand: int, part: str) -> int:
    return hand << 16 | PARTS.index(part) << 12


__all__ = [
    "DIRECTION",
    "FORCE",
    "MATRIX",
    "NO_DIRECTION",
    "PARTS",
    "TANGENTIAL",
    "TOUCH",
    "FingerValues",
    "Matrices",
    "Question",
    "Touch",
    "parts_heard",
]
