"""What the numbers of a feature are like, in little memory: extremes, mean, spread and quantiles of each of them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
TOLD = ("min", "max", "mean", "std", "count", *QUANTILES)
_SAMPLE_ROWS, _LEAST_ROWS = 1000, 32
"""How many rows quantiles are taken of at most; and at least, however large they are."""
_AT_ONCE = 4096

Numbers = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Moments:
    """Of some rows.

    Attributes:
        count: of rows.
        least, greatest, mean: (...) of each number of a row.
        squares: (...) sum of the squared differences from the mean.
    """

    count: int
    least: Numbers
    greatest: Numbers
    mean: Numbers
    squares: Numbers

    @classmethod
    def of(cls, rows: npt.NDArray[Any]) -> Moments:
        mean = rows.mean(axis=0, dtype=np.float64)
        difference = rows - mean
        squares = np.einsum("m...,m...->...", difference, difference)
        return cls(len(rows), rows.min(axis=0).astype(float), rows.max(axis=0).astype(float), mean, squares)

    def with_(self, other: Moments) -> Moments:
        count = self.count + other.count
        apart = other.mean - self.mean
        return Moments(
            count,
            np.minimum(self.least, other.least),
            np.maximum(self.greatest, other.greatest),
            self.mean + apart * (other.count / count),
            self.squares + other.squares + apart * apart * (self.count * other.count / count),
        )


class Sample:
    """Some of the rows that are shown to it, evenly.

    Args:
        shape: of a row.
        dtype: of its numbers.
        rows: that will be shown.
        most_bytes: of those that are kept.
    """

    def __init__(self, shape: tuple[int, ...], dtype: npt.DTypeLike, rows: int, most_bytes: int) -> None:
        row_bytes = np.dtype(dtype).itemsize * math.prod(shape)
        kept = min(max(most_bytes // row_bytes, _LEAST_ROWS), _SAMPLE_ROWS)
        self._step = max(1, -(-rows // kept))
        self._seen = self._kept = 0
        self._rows = np.zeros((-(-rows // self._step), *shape), dtype)

    def add(self, rows: npt.NDArray[Any]) -> None:
        """Show it (m, ...) rows."""
        chosen = rows[-self._seen % self._step :: self._step]
        self._rows[self._kept : self._kept + len(chosen)] = chosen
        self._kept += len(chosen)
        self._seen += len(rows)

    def quantiles(self) -> dict[str, Numbers]:
        """Of each number of a row."""
        rows = self._rows[: self._kept].reshape(self._kept, -1)
        found = np.zeros((len(QUANTILES), rows.shape[1]))
        for first in range(0, rows.shape[1], _AT_ONCE):  # quantiles of all at once would be copies of the whole sample
            part = slice(first, first + _AT_ONCE)
            found[:, part] = np.quantile(rows[:, part], list(QUANTILES.values()), axis=0)
        return dict(zip(QUANTILES, found.reshape(-1, *self._rows.shape[1:]), strict=True))


class Statistics:
    """Of the rows of a feature that are shown to it.

    Args:
        shape: of a row.
        dtype: of its numbers.
        rows: that will be shown.
        most_bytes: of the rows that quantiles are taken of.
        per_item: rows that count as one: pixels of an image.
    """

    def __init__(
        self, shape: tuple[int, ...], dtype: npt.DTypeLike, rows: int, most_bytes: int, per_item: int = 1
    ) -> None:
        self._sample, self._per_item = Sample(shape, dtype, rows, most_bytes), per_item
        self._moments: Moments | None = None

    def add(self, rows: npt.NDArray[Any], moments: Moments) -> None:
        """Show it (m, ...) rows, at least one, whose moments are known."""
        self._sample.add(rows)
        self._moments = moments if self._moments is None else self._moments.with_(moments)

    def told(self) -> dict[str, npt.NDArray[Any]]:
        """:data:`TOLD`, each (...), but ``count``: (1,); at least one row was shown."""
        moments = self._moments
        assert moments is not None  # noqa: S101, there were rows
        return {
            "min": moments.least,
            "max": moments.greatest,
            "mean": moments.mean,
            "std": np.sqrt(moments.squares / moments.count),
            "count": np.array([moments.count // self._per_item]),
            **self._sample.quantiles(),
        }
