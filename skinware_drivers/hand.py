"""Nominal positions of taxels on a hand, for hands whose makers publish none: grids on fingers and palm.

They show a person which taxels are neighbours, and on which finger they are. They are not measured: lengths of fingers,
gaps and unpublished pitches are typical ones, and all fingers lie in one plane. The coordinate frame is therefore
called ``hand_nominal``. A geometry that a person gives takes their place.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from skinware.geometry import Geometry, Triple

FRAME = "hand_nominal"
PITCH_M = 0.002
"""Distance of taxels if the maker publishes none, m."""

FINGERS = ("thumb", "index", "middle", "ring", "little")

_TOP_M = {
    "thumb": (0.072, 0.030),
    "index": (0.036, 0.085),
    "middle": (0.012, 0.095),
    "ring": (-0.012, 0.088),
    "little": (-0.036, 0.070),
    "palm": (0.0, -0.010),
}
"""x and y of the upper end of each part of a right hand, seen on its palm with the fingers up: x points to the right,
where the thumb is, y up, z out of the palm."""
_GAP_M = 0.003
"""Distance of two grids of a finger, m."""


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
        self,
        centre_m: Triple,
        type_names: Sequence[str],
        uid: Sequence[int],
        frame: str = FRAME,
        cells: Sequence[int] | None = None,
    ) -> Geometry:
        """Return the positions of a grid's taxels.

        Args:
            type_names: types of the sensors of each taxel (``["pressure"]``, or its axes).
            uid: uids of the taxels, row by row; the last ones may be missing.
            frame: coordinate frame, if not that of a hand.
            cells: the cell of each taxel, counted row by row; default: they fill the grid in this order.

        Raises:
            ValueError: more taxels than the grid has places.
        """
        n = len(uid)
        if n > self.rows * self.columns:
            raise ValueError(f"{n} taxels have no place in a grid of {self.rows} x {self.columns}")
        row, column = np.divmod(np.arange(n) if cells is None else np.array(cells), self.columns)
        place = np.zeros((n, 3))
        place[:, 0] = (column - (self.columns - 1) / 2) * self.pitch_m
        place[:, 1] = ((self.rows - 1) / 2 - row) * self.pitch_m
        place += centre_m
        k = len(type_names)
        return Geometry(
            type_name=np.repeat(np.array(type_names, object), n),
            uid=np.tile(np.array(uid, np.uint64), k),
            frame=np.full(k * n, frame, object),
            position_m=np.tile(place, (k, 1)),
            normal=np.tile([0.0, 0.0, 1.0], (k * n, 1)),
            radius_m=np.full(k * n, np.nan),
            confidence=np.full(k * n, np.nan),
        )


@dataclass(frozen=True)
class Hand:
    """A nominal hand.

    Attributes:
        side: of the body; a left hand mirrors a right one.
    """

    side: Literal["right", "left"] = "right"

    def down(self, part: str, grids: Sequence[Grid]) -> list[Triple]:
        """Return the centres of grids that follow each other from the upper end of a finger, or of the palm, down.

        Args:
            part: one of ``FINGERS``, or ``palm``.
            grids: the first one is uppermost.

        Raises:
            ValueError: no such part.
        """
        if part not in _TOP_M:
            raise ValueError(f"a hand has no part {part!r}; it has {', '.join(_TOP_M)}")
        x, top = _TOP_M[part]
        centres = []
        for grid in grids:
            height = grid.rows * grid.pitch_m
            centres.append((x if self.side == "right" else -x, top - height / 2, 0.0))
            top -= height + _GAP_M
        return centres
