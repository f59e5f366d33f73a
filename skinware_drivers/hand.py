"""Nominal positions of taxels on a hand, for hands whose makers publish none: grids on the fingers of a nominal hand.

Gaps and unpublished pitches are typical ones, as are the lengths of :mod:`skinware.nominal_hand`. A geometry that a
person gives takes the place of these positions.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from skinware.geometry import Geometry, Triple
from skinware.nominal_hand import NominalHand

PITCH_M = 0.002
"""Distance of taxels if the maker publishes none, m."""
_GAP_M = 0.003
"""Distance of two grids of a finger, m."""


@dataclass(frozen=True)
class Place:
    """Where a grid lies.

    Attributes:
        frame: name of the coordinate frame.
        centre_m: of the grid.
        turned_rad: from x to y.
    """

    frame: str
    centre_m: Triple = (0.0, 0.0, 0.0)
    turned_rad: float = 0.0


@dataclass(frozen=True)
class Grid:
    """Taxels in rows and columns, row by row from the upper left one, as a person sees the palm with the fingers up.

    Attributes:
        rows: the first one is nearest to the fingertip.
        columns: from left to right.
        pitch_m: distance of neighbours, m.
    """

    rows: int
    columns: int
    pitch_m: float = PITCH_M

    def at(
        self, place: Place, type_names: Sequence[str], uid: Sequence[int], cells: Sequence[int] | None = None
    ) -> Geometry:
        """Return the positions of a grid's taxels.

        Args:
            type_names: types of the sensors of each taxel (``["pressure"]``, or its axes).
            uid: uids of the taxels, row by row; the last ones may be missing.
            cells: the cell of each taxel, counted row by row; default: they fill the grid in this order.

        Raises:
            ValueError: more taxels than the grid has places.
        """
        n = len(uid)
        if n > self.rows * self.columns:
            raise ValueError(f"{n} taxels have no place in a grid of {self.rows} x {self.columns}")
        row, column = np.divmod(np.arange(n) if cells is None else np.array(cells), self.columns)
        right, up = (column - (self.columns - 1) / 2) * self.pitch_m, ((self.rows - 1) / 2 - row) * self.pitch_m
        cos, sin = math.cos(place.turned_rad), math.sin(place.turned_rad)
        position = np.stack([cos * right - sin * up, sin * right + cos * up, np.zeros(n)], axis=1) + place.centre_m
        k = len(type_names)
        return Geometry(
            type_name=np.repeat(np.array(type_names, object), n),
            uid=np.tile(np.array(uid, np.uint64), k),
            frame=np.full(k * n, place.frame, object),
            position_m=np.tile(position, (k, 1)),
            normal=np.tile([0.0, 0.0, 1.0], (k * n, 1)),
            radius_m=np.full(k * n, np.nan),
            confidence=np.full(k * n, np.nan),
        )


@dataclass(frozen=True)
class Hand(NominalHand):
    """A nominal hand with places for grids."""

    def place(self, part: str, from_end_m: float, aside_m: float = 0.0) -> Place:
        """Return a place on the middle line of a finger, or of the palm, with its tip up.

        Args:
            part: a finger, or ``palm``.
            from_end_m: distance from its upper end.
            aside_m: from the middle line to the right, as a person sees the palm of a right hand.

        Raises:
            ValueError: no such part.
        """
        if part not in self.parts:
            raise ValueError(f"a {self.build} has no part {part!r}; it has {', '.join(self.parts)}")
        (x, y), turned = self.parts[part].end, self.parts[part].turned_rad
        mirrored = 1 if self.side == "right" else -1
        x += from_end_m * math.sin(turned) + aside_m * math.cos(turned)
        y += aside_m * math.sin(turned) - from_end_m * math.cos(turned)
        return Place(self.frame, (mirrored * x, y, 0.0), mirrored * turned)

    def down(self, part: str, grids: Sequence[Grid]) -> list[Place]:
        """Return the places of grids that follow each other from the upper end of a finger, or of the palm, down.

        Args:
            part: a finger, or ``palm``.
            grids: the first one is uppermost.

        Raises:
            ValueError: no such part.
        """
        places, passed = [], 0.0
        for grid in grids:
            height = grid.rows * grid.pitch_m
            places.append(self.place(part, passed + height / 2))
            passed += height + _GAP_M
        return places
