"""Check the order of a matrix' taxels by two strokes of a finger over all of it.

The first stroke goes down, from the first row to the last, the second across, from the first column to the last. The
moment at which a taxel answers shows its place; the speed of the finger does not matter. Arrays only, no service.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from skinware.matrices import filled_by

Floats = npt.NDArray[np.float64]
Places = npt.NDArray[np.int64]
"""(n, 2): row and column of each taxel."""

_SURE = 0.5
"""Least agreement of an order: three of four pairs of taxels have it."""


class Matrix(NamedTuple):
    rows: int
    columns: int

    @classmethod
    def of_kind(cls, kind: str, count: int) -> Matrix | None:
        """Return the matrix of a module's kind (``4x6``) if ``count`` taxels fill it."""
        shape = filled_by(kind, count)
        return cls(*shape) if shape is not None and count > 1 else None

    @property
    def places(self) -> Places:
        """Return (n, 2) int64: row and column of each taxel."""
        numbers = np.arange(self.rows * self.columns)
        return np.stack(np.divmod(numbers, self.columns), axis=1)


@dataclass(frozen=True)
class Order:
    """The order of a matrix by two strokes.

    Attributes:
        wrong: faults of the whole matrix in words, such as mirrored rows.
        misplaced: taxels that answer at the places of others, in words.
        silent: numbers of taxels that answered to neither stroke.
        judged: number of taxels that answered to both.
    """

    wrong: Sequence[str]
    misplaced: Sequence[str]
    silent: Sequence[int]
    judged: int


def judge(matrix: Matrix, down: Floats, across: Floats, threshold: float) -> Order:
    """Compare the moments at which taxels answered with their declared places.

    Args:
        down: (frames, n) distance of each taxel from its rest while a finger went over the rows.
        across: the same while it went over the columns.
    """
    heard = (_peak(down) > threshold) & (_peak(across) > threshold)
    silent = np.flatnonzero((_peak(down) <= threshold) & (_peak(across) <= threshold))
    moments = np.stack([_moments(down, threshold), _moments(across, threshold)], axis=1)
    wrong, places = _turned(matrix, moments, heard)
    misplaced = [] if places is None else _misplaced(matrix, moments, heard, places)
    return Order(wrong, misplaced, silent.tolist(), int(heard.sum()))


def _peak(stroke: Floats) -> Floats:
    return np.asarray(stroke.max(axis=0)) if len(stroke) else np.zeros(stroke.shape[1])


def _moments(stroke: Floats, threshold: float) -> Floats:
    """Return (n,) the moment of the strongest press of each taxel, in frames: the centre of its answer's upper half."""
    weight = np.maximum(stroke - np.maximum(_peak(stroke) / 2, threshold), 0)
    total = weight.sum(axis=0)
    frames = np.arange(len(stroke))[:, np.newaxis]
    moments: Floats = (weight * frames).sum(axis=0) / np.where(total > 0, total, np.nan)
    return moments


def _turned(matrix: Matrix, moments: Floats, heard: npt.NDArray[np.bool_]) -> tuple[list[str], Places | None]:
    """Return faults of the whole matrix, and the places of its taxels then; None: unknown."""
    places = matrix.places
    if heard.sum() < 2:
        return [], None
    straight = [_agreement(moments[heard, axis], places[heard, axis]) for axis in (0, 1)]
    crossed = [_agreement(moments[heard, axis], places[heard, 1 - axis]) for axis in (0, 1)]
    if min(matrix) > 1 and min(np.abs(crossed)) > max(_SURE, *np.abs(straight)):
        return ["rows and columns are exchanged"], None
    wrong = []
    turned = places.copy()
    for axis, (size, name) in enumerate(zip(matrix, ("rows", "columns"), strict=True)):
        if size == 1:
            continue
        if straight[axis] <= -_SURE:
            wrong.append(f"{name} are mirrored: the last comes first")
            turned[:, axis] = size - 1 - turned[:, axis]
        elif straight[axis] < _SURE:
            other = Matrix(matrix.columns, matrix.rows)
            fits = [abs(_agreement(moments[heard, one], other.places[heard, one])) >= _SURE for one in (0, 1)]
            if matrix.rows != matrix.columns and all(fits):
                shapes = f"{other.rows} rows of {other.columns}, not {matrix.rows} rows of {matrix.columns}"
                return [*wrong, f"it answers as {shapes}"], None
            return [*wrong, f"{name} answer in no order"], None
    return wrong, turned


def _agreement(moments: Floats, places: npt.NDArray[np.int64]) -> float:
    """Return how many pairs of taxels in different lines answered in the order of the lines: 1 all, -1 none.

    Two exchanged taxels, however far apart, are in few pairs.
    """
    apart = np.sign(places[:, np.newaxis] - places)
    if not apart.any():
        return 0.0
    return float((np.sign(moments[:, np.newaxis] - moments) * apart).sum() / np.abs(apart).sum())


def _misplaced(matrix: Matrix, moments: Floats, heard: npt.NDArray[np.bool_], places: Places) -> list[str]:
    found: dict[int, tuple[int, int]] = {}
    at = np.stack(
        [_nearest(moments[:, axis], places[:, axis], heard, size) for axis, size in enumerate(matrix)], axis=1
    )
    for taxel in np.flatnonzero(heard & (at != places).any(axis=1)).tolist():
        found[taxel] = (int(at[taxel, 0]), int(at[taxel, 1]))
    whose = {(int(row), int(column)): taxel for taxel, (row, column) in enumerate(places.tolist())}
    words = []
    for taxel, place in found.items():
        other = whose[place]
        if other in found and whose[found[other]] == taxel:
            if taxel < other:
                words.append(f"taxels {taxel} and {other} are exchanged")
        else:
            words.append(f"taxel {taxel} answers at the place of taxel {other}")
    return words


def _nearest(moments: Floats, place: Places, heard: npt.NDArray[np.bool_], size: int) -> Places:
    """Return (n,) the row or column whose taxels answered at the moment of each taxel."""
    counts = [int((heard & (place == line)).sum()) for line in range(size)]
    if size < 2 or min(counts) < 3:  # with fewer, a misplaced one would move its own row
        return place
    usual = np.array([np.median(moments[heard & (place == line)]) for line in range(size)])
    distance = np.abs(np.nan_to_num(moments)[:, np.newaxis] - usual)
    nearest = distance.argmin(axis=1)
    own = distance[np.arange(len(place)), place]
    gap = np.median(np.abs(np.diff(usual)))
    return np.where(heard & (own > 0.75 * gap), nearest, place)
