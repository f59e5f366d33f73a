"""Regions by hand: what was touched while somebody stroked a skin."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from skinware.tactile.neighbours import NONE


def without_holes(touched: npt.NDArray[np.bool_], neighbours: npt.NDArray[Any]) -> npt.NDArray[np.bool_]:
    """(n,) bool: the touched taxels, and those most of whose neighbours are among them, until there are no more.

    At the edge of a skin, where taxels have few neighbours, more than half of what others have must be; otherwise a
    region would grow along the edge.

    Args:
        touched: (n,) bool.
        neighbours: (n, k) int, which taxels lie beside each other, -1 fills its rows.
    """
    is_neighbour = neighbours != NONE
    count = is_neighbour.sum(axis=1)
    usual = np.percentile(count, 90) if len(count) else 0
    enough = np.maximum(count, usual) / 2
    found = touched.astype(bool)
    while True:
        inside = (found[neighbours] & is_neighbour).sum(axis=1)
        holes = ~found & (inside > enough)
        if not holes.any():
            return found
        found |= holes
