"""Arrays whose rows are structures, as arrays of plain numbers: a leaf for each field; and back."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from skinware.conversion.tables import ArrayFormat


class Leaf(NamedTuple):
    """Plain numbers in the rows of an array.

    Attributes:
        path: names of the fields that lead to them; empty: the rows are plain.
        shape: of them in a row.
        dtype: of them: no structure.
    """

    path: tuple[str, ...]
    shape: tuple[int, ...]
    dtype: np.dtype[Any]

    @property
    def size(self) -> int:
        return math.prod(self.shape)

    def of(self, rows: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """(m, size) the numbers in m rows, in place where that is possible."""
        for field in self.path:
            rows = rows[field]
        return rows.reshape(len(rows), self.size)

    def put(self, numbers: npt.NDArray[Any], rows: npt.NDArray[Any]) -> None:
        """Write (m, size) numbers into m rows."""
        for field in self.path:
            rows = rows[field]
        rows[...] = numbers.reshape(rows.shape)

    def name(self, array: str) -> str:
        return ".".join([array, *self.path])


def leaves(each: ArrayFormat) -> list[Leaf]:
    """Of the rows of an array; those in which there is nothing are left out."""
    found = [Leaf((), each.shape, each.dtype)]
    while any(leaf.dtype.names is not None for leaf in found):
        found = [inner for leaf in found for inner in _opened(leaf)]
    return [leaf for leaf in found if leaf.size and leaf.dtype.itemsize]


def _opened(leaf: Leaf) -> list[Leaf]:
    if leaf.dtype.names is None:
        return [leaf]
    fields = leaf.dtype.fields
    assert fields is not None  # noqa: S101, it has names
    opened = []
    for name in leaf.dtype.names:
        base, shape = fields[name][0].base, fields[name][0].shape
        opened.append(Leaf((*leaf.path, name), (*leaf.shape, *shape), base))
    return opened
