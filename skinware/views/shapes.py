"""How the sensors of a module are drawn side by side, by the module's kind. Pure functions."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

from skinware.matrices import filled_by

Cell = tuple[int, int]
"""Row, and column in halves of a sensor: rows of a triangle are shifted by half a sensor."""

_TRIANGLE = ((2, 5), (3, 6), (3, 4), (2, 3), (3, 2), (3, 0), (2, 1), (1, 2), (0, 3), (1, 4))
"""The ten taxels of a ROBOSKIN triangle in the order of their channels (0 to 5, 7 to 9, 11), seen from outside.

They lie 6.5 mm apart in rows of one, two, three and four: see the published positions of an iCub's skin.
"""
_FINGERTIP = ((3, 2), (3, 4), (3, 6), (3, 8), (3, 0), (2, 6), (2, 4), (2, 2), (1, 2), (1, 4), (1, 6), (0, 4))
"""The twelve taxels of a ROBOSKIN fingertip, unrolled, its tip above; after the map that its maker publishes."""

_BY_KIND = {("triangle", 10): _TRIANGLE, ("fingertip", 12): _FINGERTIP}


@dataclass(frozen=True)
class Shape:
    """Places of the sensors of a module.

    Attributes:
        cells: of each sensor, in frame order.
        rows: height.
        halves: width in halves of a sensor.
    """

    cells: tuple[Cell, ...]
    rows: int
    halves: int


@cache
def shape_of(kind: str, count: int) -> Shape:
    """The shape of a module.

    Args:
        kind: of the module: ``triangle``, ``fingertip``, rows and columns as ``4x6``; any other is drawn as a block.
        count: how many sensors are drawn of it.
    """
    known = _BY_KIND.get((kind, count))
    if known is not None:
        return Shape(known, 1 + max(row for row, _ in known), 2 + max(half for _, half in known))
    grid = filled_by(kind, count)
    if grid is not None:
        return rows_of(count, grid[1])
    return rows_of(count, block_columns(count))


@cache
def rows_of(count: int, columns: int) -> Shape:
    cells = tuple((number // columns, 2 * (number % columns)) for number in range(count))
    return Shape(cells, math.ceil(count / columns), 2 * columns)


def block_columns(count: int) -> int:
    """How many of ``count`` sensors of a module are drawn side by side: a compact block with few empty places."""
    narrowest = math.isqrt(count - 1) + 1
    widest = max(narrowest, int(2.5 * math.sqrt(count)))
    return min(range(narrowest, widest + 1), key=lambda columns: (-count % columns, columns))
