"""Assign rows to columns for the largest sum of gains."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Gains = npt.NDArray[np.float64]


def assign(gain: Gains) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Assign rows to columns, each at most once, so that the sum of gains is the largest.

    Args:
        gain: (r, c) gain of each pair; 0 or less: the pair is impossible.

    Returns:
        (p,) int64 rows, in ascending order, and (p,) int64, the column of each.
    """
    possible = gain > 0
    column_of = np.full(len(gain), -1, np.int64)
    is_clear = possible & (possible.sum(axis=1) == 1)[:, None] & (possible.sum(axis=0) == 1)
    row, column = np.nonzero(is_clear)
    column_of[row] = column
    rows = np.flatnonzero(possible.any(axis=1) & (column_of < 0))
    columns = np.flatnonzero((possible & ~is_clear).any(axis=0))
    if len(rows):
        cost = -np.maximum(gain[np.ix_(rows, columns)], 0.0)
        if len(rows) <= len(columns):
            column_of[rows] = columns[_cheapest(cost)]
        else:
            column_of[rows[_cheapest(cost.T)]] = columns
    row = np.flatnonzero(column_of >= 0)
    row = row[possible[row, column_of[row]]]
    return row, column_of[row]


def _cheapest(cost: Gains) -> npt.NDArray[np.int64]:
    """(r,) int64: a column for each of r rows (at most as many as columns), for the smallest sum.

    By shortest augmenting paths: each row joins along the path of exchanges that costs least. ``of_row`` and
    ``of_column`` are the dual prices, ``row_at`` is the row of each column; column 0 stands for the row that joins.
    """
    rows, columns = cost.shape
    of_row, of_column = np.zeros(rows + 1), np.zeros(columns + 1)
    row_at = np.zeros(columns + 1, np.int64)
    for new in range(1, rows + 1):
        row_at[0] = new
        column = 0
        distance = np.full(columns + 1, np.inf)
        before = np.zeros(columns + 1, np.int64)
        is_open = np.ones(columns + 1, bool)
        while column == 0 or row_at[column]:
            is_open[column] = False
            row = row_at[column]
            reached = cost[row - 1] - of_row[row] - of_column[1:]
            shorter = is_open[1:] & (reached < distance[1:])
            distance[1:][shorter] = reached[shorter]
            before[1:][shorter] = column
            column = int(np.where(is_open, distance, np.inf)[1:].argmin()) + 1
            step = distance[column]
            of_row[row_at[~is_open]] += step
            of_column[~is_open] -= step
            distance[is_open] -= step
        while column:
            row_at[column], column = row_at[before[column]], int(before[column])
    found = np.zeros(rows, np.int64)
    taken = np.flatnonzero(row_at[1:])
    found[row_at[1:][taken] - 1] = taken
    return found
