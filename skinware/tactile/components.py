"""Which touched taxels hang together over a table of neighbours.

Each round every tree of taxels is hooked to the smallest one that it touches, and then made flat by jumping from
parent to parent. Every two rounds the smallest tree of a component at least doubles, whatever the pattern: hence a
few rounds for any, where passing the smallest number from taxel to taxel takes as many as a component is wide.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from skinware.tactile.neighbours import NONE, checked

Rows = npt.NDArray[np.int64]


class Components:
    """The components of any touched taxels of a skin.

    Args:
        n: number of taxels.
        neighbours: (n, k) int, -1 fills its rows; None: nothing is known of them.
        module: (n,) int, the module of each taxel: touched taxels of one module that have no neighbours at all hang
            together. None: each is alone.

    Raises:
        ConfigurationError: the table is none of n taxels.
    """

    def __init__(self, n: int, neighbours: npt.NDArray[Any] | None, module: npt.NDArray[Any] | None = None) -> None:
        table = np.zeros((n, 0), np.int32) if neighbours is None else checked(neighbours, n)
        self._forward = _forward(table)
        self._is_lonely = (table == NONE).all(axis=1)
        self._module = module if self._is_lonely.any() else None
        self._position = np.full(n + 1, NONE, np.int32)  # among those that are touched; the last one is that of NONE

    def of(self, touched: Rows) -> tuple[Rows, int]:
        """(m,) int64, the component of each of m touched taxels, counted from 0 in their order; and how many.

        Args:
            touched: (m,) int64, taxels in ascending order.
        """
        self._position[touched] = np.arange(len(touched))
        beside = self._position[self._forward[touched]].reshape(-1)
        self._position[touched] = NONE
        pair = np.flatnonzero(beside != NONE)
        one, other = pair // max(1, self._forward.shape[1]), beside[pair].astype(np.int64)
        if self._module is not None:
            lonely = np.flatnonzero(self._is_lonely[touched])
            _, first, module = np.unique(self._module[touched[lonely]], return_index=True, return_inverse=True)
            one, other = np.concatenate([one, lonely[first][module]]), np.concatenate([other, lonely])
        root = _roots(len(touched), one, other)
        is_root = root == np.arange(len(touched))
        number = np.cumsum(is_root) - 1
        return number[root], int(is_root.sum())


def _roots(count: int, low: Rows, high: Rows) -> Rows:
    """(count,) int64: the smallest member of the component of each, for edges from ``low`` to higher numbers."""
    root = np.arange(count)
    while len(low):
        np.minimum.at(root, high, low)
        while not np.array_equal(root, upper := root[root]):
            root = upper
        one, other = root[low], root[high]
        apart = one != other
        one, other = one[apart], other[apart]
        low, high = np.minimum(one, other), np.maximum(one, other)
    return root


def _forward(table: npt.NDArray[np.int32]) -> npt.NDArray[np.int32]:
    """The same table with each pair once, in the row of the lower number."""
    row, column = np.nonzero(table > np.arange(len(table))[:, None])
    count = np.bincount(row, minlength=len(table))
    forward = np.full((len(table), int(count.max(initial=0))), NONE, np.int32)
    forward[row, np.arange(len(row)) - (np.cumsum(count) - count)[row]] = table[row, column]
    return forward
