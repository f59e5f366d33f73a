"""Medians of groups of unequal sizes, of some members only."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

_WIDEST_WASTE = 2
"""Groups share a table as long as its rows are at most so many times as wide as the smallest of them."""


class GroupMedian:
    """Medians of n values by group, of those that count.

    Groups of similar size are rows of one table, which is sorted at once: one huge group beside a thousand small ones
    costs no more than their members.

    Args:
        group: (n,) int, the group of each value, 0 or more.
    """

    def __init__(self, group: npt.NDArray[np.integer]) -> None:
        self.n_groups = int(group.max(initial=-1)) + 1
        self._group = group
        sizes = np.bincount(group, minlength=self.n_groups)
        members = np.split(np.argsort(group, kind="stable"), np.cumsum(sizes)[:-1])
        self._tables: list[tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]] = []
        by_size = [int(number) for number in np.argsort(sizes, kind="stable") if sizes[number]]
        while by_size:
            widest = _WIDEST_WASTE * sizes[by_size[0]]
            rows = [number for number in by_size if sizes[number] <= widest]
            by_size = by_size[len(rows) :]
            table = np.full((len(rows), sizes[rows[-1]]), len(group), np.intp)  # beyond the values stands infinity
            for row, number in enumerate(rows):
                table[row, : sizes[number]] = members[number]
            self._tables.append((np.array(rows, np.intp), table))
        self._values = np.full(len(group) + 1, np.inf, np.float32)

    def __call__(
        self, values: npt.NDArray[np.float32], counts: npt.NDArray[np.bool_]
    ) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.intp]]:
        """The medians.

        Args:
            values: (n,) finite where they count.
            counts: (n,) which of them count.

        Returns:
            (n_groups,) medians, NaN where none counts; (n_groups,) how many do.
        """
        medians = np.full(self.n_groups, np.nan, np.float32)
        found = np.bincount(self._group[counts], minlength=self.n_groups)
        self._values[:-1] = np.where(counts, values, np.inf)
        for rows, table in self._tables:
            ordered = np.sort(self._values[table], axis=1)
            each, number = np.arange(len(rows)), found[rows]
            twice = ordered[each, np.maximum(number - 1, 0) // 2] + ordered[each, number // 2]
            medians[rows] = np.where(number > 0, twice / 2, np.nan)
        return medians, found
