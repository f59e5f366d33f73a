"""The touch of LinkerHands of each generation: its modules, its frames, and the questions for it.

All frames to and from a hand have one identifier; byte 0 is the command. Sources: see ``linkerhand``.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from skinware.geometry import Geometry
from skinware.nominal_hand import FINGERS
from skinware.sensor_types import PRESSURE, PROXIMITY, SensorType
from skinware.status import Status
from skinware_drivers import Match, Module, Sensor, taxels
from skinware_drivers.fields import Bits, Byte, Condition, Identifier, Sentinel
from skinware_drivers.hand import PITCH_M, Grid, Hand
from skinware_drivers.layout import Cycle, Frame, Layout, Values

PARTS = (*FINGERS, "palm")
Beginnings = Mapping[tuple[int, int], int]
"""Number of a hand's frames by first byte and length."""
MATRIX = 0xB1
"""Command for the thumb's matrix; the next ones are for the others of ``PARTS``."""
_SATURATED = Sentinel(Status.OUT_OF_RANGE, 255)
"""The end of every range; for the direction of a force: there is none."""
_HAND, _COMMAND = Bits(0, 11), Bits(0, 8, byte=0)
_LONGEST_REPLY_S, _LONGEST_RUNS_S, _RUNS_WAIT_S = 0.008, 0.02, 0.05
_RUN, _SUMS, _ASKS_FOR_RUNS = 5, 0xFF, 4
_DENSE_PITCH_M = 0.0015
_PERIOD_S = 0.05  # a usual time between two updates
_VENDOR = 0x27027 << 12
TANGENTIAL = SensorType("tangential_force", _VENDOR | 1, "counts", minimum=0, maximum=255)
DIRECTION = SensorType("force_direction", _VENDOR | 2, "counts", minimum=0, maximum=254)
FORCE = PRESSURE.measured(unit="counts", minimum=0, maximum=255)


class TouchQuestion(NamedTuple):
    """A command that asks for touch.

    The last frame of the reply begins with ``last`` and is not shorter than ``shortest``: no program's question is.
    """

    payload: bytes
    last: bytes
    shortest: int
    patience_s: float = 0.02

    def end(self, hand: int) -> Match:
        return Match(hand, prefix=self.last, shortest=self.shortest)


@dataclass(frozen=True)
class _Matrices:
    """A matrix for each part.

    Attributes:
        finger: rows and columns of a finger's matrix.
        palm: rows and columns of the palm's matrix.
    """

    finger: tuple[int, int]
    palm: tuple[int, int]
    types = (FORCE,)
    period_s = _PERIOD_S
    pitch_m = PITCH_M

    def size(self, part: str) -> tuple[int, int]:
        return self.palm if part == "palm" else self.finger

    def modules(self, hand: int, parts: Sequence[str]) -> list[Module]:
        """Return the modules of a hand that has these parts; ``hand`` is its identifier."""
        found = []
        for part in parts:
            rows, columns = self.size(part)
            sensors = taxels(rows * columns, first_uid=_uid(hand, part))
            found.append(Module(sensors, MATRIX + PARTS.index(part), f"{rows}x{columns}", part))
        return found

    def geometry(self, hand: int, parts: Sequence[str], side: Hand) -> Geometry:
        found = []
        for part in parts:
            grid, first = Grid(*self.size(part), self.pitch_m), _uid(hand, part)
            uids = range(first, first + grid.rows * grid.columns)
            found.append(grid.at(side.down(part, [grid])[0], [FORCE.name], uids))
        return Geometry.joined(found)


class RowMatrices(_Matrices):
    """One frame for each row, in order (second generation): at most 12 rows of at most 6, also of the palm."""

    def layout(self, identifier: Identifier) -> Layout:
        """Return a layout that publishes a matrix when all its rows have come, the first one first."""
        n_rows, n_columns = self.finger
        rows = [
            Frame(
                f"row {row} of {n_rows}",
                [identifier, Byte(1, row << 4)],
                [2 + n_columns],
                Values(2, "u1", n_columns, to=range(row * n_columns, (row + 1) * n_columns)),
                patch=_HAND,
                module=_COMMAND,
                flags=[_SATURATED],
            )
            for row in range(n_rows)
        ]
        return Layout([_other(identifier), *rows], Cycle([row.name for row in rows], maximum_age_s=_LONGEST_REPLY_S))

    def questions(self, parts: Sequence[str]) -> list[TouchQuestion]:
        commands = [MATRIX + PARTS.index(part) for part in parts]
        n_rows, n_columns = self.finger
        size, last = n_rows << 4 | n_columns, n_rows - 1 << 4
        return [TouchQuestion(bytes((command, size)), bytes((command, last)), 2 + n_columns) for command in commands]

    def known(self, heard: Beginnings) -> int:
        """Return how many rows were heard; 0 if a program asks for runs, which look like rows of six."""
        return 0 if _of_matrices(heard, _ASKS_FOR_RUNS) else _of_matrices(heard, 2 + self.finger[1])


class RunMatrices(_Matrices):
    """Runs of five values that go on from one row to the next (third generation, G20)."""

    period_s = 0.1
    pitch_m = _DENSE_PITCH_M

    def layout(self, identifier: Identifier) -> Layout:
        """Return a layout that publishes a matrix when all its runs have come, in order; sums are skipped."""
        is_palm = Byte(0, MATRIX + PARTS.index("palm"))
        fingers = _runs("finger", [identifier], *self.finger)
        palm = _runs("palm", [identifier, is_palm], *self.palm)
        of_finger = Cycle([run.name for run in fingers], _LONGEST_RUNS_S)
        of_palm = Cycle([run.name for run in palm], 2 * _LONGEST_RUNS_S)
        return Layout([_other(identifier), *fingers, *palm], of_finger, [of_palm])

    def questions(self, parts: Sequence[str]) -> list[TouchQuestion]:
        """Return one question for each part, with the byte that makes the hand end its answer with sums."""
        questions = []
        for part in parts:
            command = MATRIX + PARTS.index(part)
            questions.append(
                TouchQuestion(bytes((command, *self.size(part), 1)), bytes((command, _SUMS)), 4, _RUNS_WAIT_S)
            )
        return questions

    def known(self, heard: Beginnings) -> int:
        """Return the number of runs, if it fits the number of questions; a sum may look like a question."""
        runs, questions = _of_matrices(heard, 3 + _RUN), _of_matrices(heard, _ASKS_FOR_RUNS)
        of_finger = self.finger[0] * self.finger[1] // _RUN
        return runs if 0.4 * of_finger * questions <= runs <= 1.1 * of_finger * questions else 0


def _runs(name: str, when: Sequence[Condition], rows: int, columns: int) -> list[Frame]:
    count = rows * columns
    found = []
    for first in range(0, count, _RUN):
        row, column = divmod(first, columns)
        values = Values(3, "u1", min(_RUN, count - first), to=range(first, min(first + _RUN, count)))
        at = Byte(1, row), Byte(2, column)
        what = f"{name} {row}, {column}"
        found.append(Frame(what, [*when, *at], [values.end], values, _HAND, _COMMAND, [_SATURATED]))
    return found


@dataclass(frozen=True)
class FingerValues:
    """Four values for each finger; a frame has one of them for all fingers (first generation).

    Attributes:
        command: question for the first of them; the next commands are for the others.
    """

    command: int
    period_s = _PERIOD_S
    types = (FORCE, TANGENTIAL, DIRECTION, PROXIMITY.measured(unit="counts", minimum=0, maximum=255))

    def modules(self, hand: int, parts: Sequence[str]) -> list[Module]:
        fingers = [part for part in parts if part in FINGERS]
        return [
            Module([Sensor(one.name, _uid(hand, finger)) for finger in fingers], self.command + at, name=one.name)
            for at, one in enumerate(self.types)
        ]

    def layout(self, identifier: Identifier) -> Layout:
        """Return a layout of frames that stand alone. A sixth value, which some hands send, is dropped."""
        is_reply = identifier, Byte(len(FINGERS), 0, mask=0)  # long enough
        lengths, values = (1 + len(FINGERS), 2 + len(FINGERS)), Values(1, "u1", len(FINGERS))
        what = f"values {self.command:X}"
        frame = Frame(what, is_reply, lengths, values, _HAND, _COMMAND, [_SATURATED])
        return Layout([_other(identifier), frame])

    def questions(self, parts: Sequence[str]) -> list[TouchQuestion]:
        del parts
        commands = [bytes([self.command + at]) for at in range(len(self.types))]
        return [TouchQuestion(command, command, 1 + len(FINGERS)) for command in commands]

    def geometry(self, hand: int, parts: Sequence[str], side: Hand) -> Geometry:
        grid, names = Grid(1, 1), [one.name for one in self.types]
        fingers = [part for part in parts if part in FINGERS]
        return Geometry.joined([grid.at(side.down(f, [grid])[0], names, [_uid(hand, f)]) for f in fingers])

    def known(self, heard: Beginnings) -> int:
        commands = range(self.command, self.command + len(self.types))
        return sum(n for (first, length), n in heard.items() if first in commands and length in (6, 7))


TouchKind = RowMatrices | RunMatrices | FingerValues
TOUCH: dict[str, TouchKind] = {
    "12x6": RowMatrices((12, 6), (12, 6)),
    "10x4": RowMatrices((10, 4), (10, 4)),
    "fingers": FingerValues(0x20),
    "fingers_90": FingerValues(0x90),
    "hand_23x9": RunMatrices((23, 9), (28, 20)),
    "hand_12x6": RunMatrices((12, 6), (14, 16)),
}
"""By the values of the option ``touch``."""


def every_layout(identifier: Identifier) -> Layout:
    """Return all frames by which a hand is recognized, whatever its touch: to compare with a bus, not to decode."""
    layouts = [touch.layout(identifier) for touch in TOUCH.values() if not isinstance(touch, RunMatrices)]
    frames = [frame for layout in layouts for frame in layout.frames[1:]]
    return Layout([_other(identifier), *frames], None, [cycle for layout in layouts for cycle in layout.cycles])


def parts_heard(touch: TouchKind, commands: Collection[int]) -> list[str]:
    """Return the parts of a hand that sent frames with these first bytes; its fingers in any case."""
    if isinstance(touch, FingerValues):
        return list(FINGERS)
    return [part for at, part in enumerate(PARTS) if part in FINGERS or MATRIX + at in commands]


def _of_matrices(heard: Beginnings, length: int) -> int:
    return sum(heard.get((MATRIX + at, length), 0) for at in range(len(FINGERS)))


def _other(identifier: Identifier) -> Frame:
    """Return a frame for questions, motion and everything else: half of a command names no module."""
    return Frame("other", [identifier], range(9), Values(0, "u1", 0), patch=_HAND, module=Bits(4, 4, byte=0))


def _uid(hand: int, part: str) -> int:
    return hand << 16 | PARTS.index(part) << 12
