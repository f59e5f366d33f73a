"""Pieces of one buffer as rows of an array, without a loop over the pieces."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

Bytes = npt.NDArray[np.uint8]
Indices = npt.NDArray[np.int64]


def windows(data: Bytes, start: Indices, width: int) -> Bytes:
    """(n, width) uint8: ``width`` bytes from each start; all must lie within ``data``."""
    if not len(start) or not width:
        return np.zeros((len(start), width), np.uint8)
    every = np.ndarray((len(data) - width + 1,), np.dtype((np.void, width)), data.data, 0, (1,))
    return every[start].view(np.uint8).reshape(len(start), width)


def by_width(length: Indices) -> Iterator[tuple[Indices | slice, int]]:
    """Groups of pieces whose lengths differ by less than a factor of two: which, and the longest of them."""
    if not len(length):
        return
    longest = int(length.max())
    if longest == int(length.min()):
        yield slice(None), longest
        return
    magnitude = np.frexp(length)[1]
    for power in np.unique(magnitude):
        group = np.flatnonzero(magnitude == power)
        yield group, int(length[group].max())


def copy_rows(data: Bytes, start: Indices, length: Indices, rows: Bytes) -> None:
    """Copy pieces into rows, with zeros behind them.

    Args:
        data: the buffer; behind the last piece it goes on for the length of the longest.
        start: (n,) first byte of each piece.
        length: (n,) bytes of each piece, at most the width of a row.
        rows: (n, width) uint8, filled.
    """
    for group, width in by_width(length):
        rows[group, :width] = windows(data, start[group], width)
        rows[group, width:] = 0
        if not isinstance(group, slice):
            behind = np.arange(width) >= length[group][:, None]
            part = rows[group, :width]
            part[behind] = 0
            rows[group, :width] = part


def flush_right(data: Bytes, stop: Indices, length: Indices, width: int) -> Bytes:
    """(n, width) uint8: the pieces that end at each ``stop``, with zeros before them.

    ``data`` begins at least ``width`` bytes before the first piece ends.
    """
    rows = windows(data, stop - width, width)
    if int(length.min()) < width:
        rows[np.arange(width) < width - length[:, None]] = 0
    return rows
