"""Hold the tracks of contacts, expect where they go, correct that by what is found, and assign them to it."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

from skinware import native
from skinware.tactile.arrays import Doubles, Flags, Whole

Tracks: TypeAlias = Any
"""Array with the fields of ``TRACK``; checking the types of its sums as those of arrays takes mypy seconds."""

LONGEST_GUESS_S = 0.1
"""Seconds for which a velocity is extrapolated."""

_calls = native.core().quick
_expect, _correct = _calls.skinware_tracks_expect, _calls.skinware_tracks_correct
_move, _judge = _calls.skinware_tracks_move, _calls.skinware_tracks_judge
for _call in (_expect, _correct, _move, _judge):
    _call.restype = None
_expect.argtypes = ctypes.c_void_p, ctypes.c_int64, ctypes.c_int64
_correct.argtypes = ctypes.c_void_p, ctypes.c_int64, ctypes.c_void_p, ctypes.c_int64
_move.argtypes = ctypes.c_void_p, ctypes.c_int64, ctypes.c_void_p, ctypes.c_double
_judge.argtypes = (*(ctypes.c_void_p, ctypes.c_int64) * 2, ctypes.c_int64, ctypes.c_void_p)

TRACK = np.dtype(
    [
        ("key", "i8"),  # never given to another track
        ("id", "i8"),  # 0: no contact yet
        ("born_ns", "i8"),
        ("gone_ns", "i8"),  # when it went; 0 while it is there
        ("seen_ns", "i8"),
        ("frames", "i8"),  # in which it was seen
        ("steps", "i8"),  # number of moves in the velocity
        ("size", "i8"),
        ("frame", "i8"),
        ("home", "i8"),  # its blob; -1 if it has gone
        ("kind", "i8"),
        ("place", "f8", 3),  # and velocity, filtered, to expect the next one
        ("pace", "f8", 3),
        ("spread", "f8", 3),  # variances of place, of place and velocity, of velocity
        ("found", "f8", 3),  # where it was in this frame
        ("velocity", "f8", 3),  # as published
        ("motion", "f8", 3),  # the same, smoothed once more, so that noise does not look like sliding
        ("now", "f8"),  # load of this frame
        ("height", "f8"),  # peak of this frame
        ("load", "f8"),  # smoothed
        ("peak", "f8"),  # smoothed
        ("width", "f8"),  # smoothed
        ("noise", "f8"),  # variance of the place that was found
        ("sure", "?"),  # it was touched for sure
        ("shared", "?"),  # its blob has other tracks, too
        ("jumps", "?"),  # its centre may have moved because contacts merged or split
    ],
    align=True,
)
"""``struct track`` of tracks.c."""


@dataclass(frozen=True, eq=False)
class TouchedBlobs:
    """The m blobs of the a touched taxels of a frame.

    Attributes:
        taxels, blob, value: (a,) the taxels, the blob of each, and its value.
        load, peak: (m,) sum and maximum of the values of each blob.
        frame: (m,) int64, number of its coordinate frame, -1 for none.
        cop_m: (m, 3) m, its centre; NaN if it is not known.
        is_sure: (m,) bool, whether any of its taxels is touched for sure.
        frames: (m,) int64, how many frames speak for it: 2 where a taxel has an onset, 0 where no value is clear.
    """

    taxels: Whole
    blob: Whole
    value: Doubles
    load: Doubles
    peak: Doubles
    frame: Whole
    cop_m: Doubles
    is_sure: Flags
    frames: Whole


def expected_at(tracks: Tracks, time_ns: int) -> Tracks:
    """The tracks as they are expected at a time: places and spreads go on with the velocities."""
    expected = tracks.copy()
    _expect(expected.ctypes.data, len(expected), time_ns)
    return expected


def correct(tracks: Tracks, rows: Whole, time_ns: int) -> None:
    """Take in where tracks were found, instead of where they were expected."""
    _correct(tracks.ctypes.data, len(rows), rows.ctypes.data, time_ns)


def move(tracks: Tracks, before: Tracks, velocity_s: float) -> None:
    """Update the velocities that are published; they stay where contacts merge or split, as their centres jump."""
    _move(tracks.ctypes.data, len(before), before.ctypes.data, velocity_s)


def judge(tracks: Tracks, before: Tracks, time_ns: int, settings: Doubles) -> None:
    """Update what is smoothed, and the kinds: by velocity_s, touch_s, sliding_m_s, steady, and the pitch, m."""
    _judge(tracks.ctypes.data, len(tracks), before.ctypes.data, len(before), time_ns, settings.ctypes.data)


def assign(gain: Doubles) -> tuple[Whole, Whole]:
    """Assign rows to columns, each at most once, so that the sum of (r, c) gains is the largest; 0 or less: impossible.

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


def _cheapest(cost: Doubles) -> Whole:
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
