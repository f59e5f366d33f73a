"""What goes wrong with one board: its triangles, its frames, its timing. All chance comes from one seeded source."""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from skinware_drivers.virtual.roboskin.firmware import CHANNELS, NO_ACK, NOT_CONNECTED, TRIANGLES, ArrayI
from skinware_drivers.virtual.roboskin.options import RoboskinOptions

WRONG_LENGTHS = (0, 1, 2, 3, 4, 5, 7)
"""Neither 8 nor the 6 of old firmware."""

_BEYOND_COUNTS = 1024
"""How far a broken taxel is beyond twice the range: more than warmth and noise can take away."""


TriangleState = Literal["unplugged", "plugged_in", "no_ack", "ack"]
"""Out of or in its plug; its converter stopped or began again to acknowledge."""


class Fate(NamedTuple):
    """What becomes of one data frame: cut or filled up to ``length`` bytes, or lost (None)."""

    length: int | None


class TriangleTrigger(NamedTuple):
    """A triangle that breaks with burst ``cycle``."""

    cycle: int
    triangle: int
    fault: TriangleState


class BoardFaults:
    """The faults of one board.

    Args:
        options: of the patch.
        address: of the board, as the options name it.
        ordinal: of the board in the patch.

    Attributes:
        disconnected: (16,) bool, triangles of which the I2C lines read 0xFFFF.
        not_acknowledging: (16,) bool, triangles of which the registers stay 0.
        broken: (16, 12) bool, taxels far out of range.
        version: another number whenever one of these three is changed by :meth:`set_triangle`.
        last_cycle: bursts after which the board dies; None to live on.
    """

    def __init__(self, options: RoboskinOptions, address: int, ordinal: int) -> None:
        self._random = np.random.default_rng([options.seed, ordinal, 1])
        self._lose, self._wrong_length = options.lose, options.wrong_length
        self._jitter_us = options.jitter_us
        self.last_cycle: int | None = options.dead_after_cycles if address in options.dead else None
        self.disconnected: npt.NDArray[np.bool_] = np.zeros(TRIANGLES, np.bool_)
        self.not_acknowledging: npt.NDArray[np.bool_] = np.zeros(TRIANGLES, np.bool_)
        self.version: int = 0
        self.broken: npt.NDArray[np.bool_] = np.zeros((TRIANGLES, CHANNELS), np.bool_)
        for board, triangle in options.places("not_connected", 2):
            if board == address:
                self.disconnected[triangle] = True
        for board, triangle, taxel in options.places("out_of_range", 3):
            if board == address:
                self.broken[triangle, taxel] = True
        self._triggers = [
            TriangleTrigger(options.unplugged_after_cycles, triangle, "unplugged")
            for board, triangle in options.places("unplugged", 2)
            if board == address
        ] + [
            TriangleTrigger(options.no_ack_after_cycles, triangle, "no_ack")
            for board, triangle in options.places("no_ack", 2)
            if board == address
        ]

    def triangles_breaking(self, cycle: int) -> list[TriangleTrigger]:
        """Break the triangles whose time has come by burst ``cycle``, and tell which."""
        due = [trigger for trigger in self._triggers if trigger.cycle <= cycle]
        if due:
            self._triggers = [trigger for trigger in self._triggers if trigger.cycle > cycle]
        for trigger in due:
            self.set_triangle(trigger.triangle, trigger.fault)
        return due

    def set_triangle(self, triangle: int, fault: TriangleState) -> None:
        mask = self.disconnected if fault in ("unplugged", "plugged_in") else self.not_acknowledging
        mask[triangle] = fault in ("unplugged", "no_ack")
        self.version += 1

    def distort(self, raw: ArrayI) -> None:
        """Overwrite what unplugged and silent triangles read in ``raw``, (n, 16, 12)."""
        raw[:, self.not_acknowledging] = NO_ACK
        raw[:, self.disconnected] = NOT_CONNECTED

    def break_taxels(self, raw: ArrayI, baseline: ArrayI, bottom: ArrayI) -> None:
        """Put broken taxels in ``raw`` far out of range.

        Args:
            raw: (n, 16, 12) capacitances, changed in place.
            baseline: (16, 12) of the last calibration.
            bottom: (16, 1) difference at which a value reaches 0.
        """
        if self.broken.any():
            far = np.minimum(baseline + 2 * bottom + _BEYOND_COUNTS, 0xFFFE)
            raw[:, self.broken] = far[self.broken]

    def delay_ns(self) -> int:
        """How late the next burst begins."""
        return int(self._random.integers(0, self._jitter_us, endpoint=True)) * 1000 if self._jitter_us else 0

    def fates(self, count: int) -> dict[int, Fate]:
        """What goes wrong with the next ``count`` data frames, by position."""
        found: dict[int, Fate] = {}
        if self._wrong_length:
            for position in self._chosen(self._wrong_length, count):
                found[position] = Fate(int(self._random.choice(WRONG_LENGTHS)))
        if self._lose:
            for position in self._chosen(self._lose, count):
                found[position] = Fate(None)
        return found

    def _chosen(self, probability: float, count: int) -> list[int]:
        chosen: npt.NDArray[np.int64] = np.flatnonzero(self._random.random(count) < probability)
        return [int(position) for position in chosen]
