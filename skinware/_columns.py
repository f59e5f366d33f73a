"""Columns of tables: made, checked, grouped."""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from skinware.errors import StructureError

_T = TypeVar("_T", bound=np.generic)

Index = slice | npt.NDArray[np.int64]
"""Positions of sensors in a frame: a slice where they lie together, otherwise (n,) int64."""


def as_index(positions: npt.NDArray[np.int64]) -> Index:
    """``positions`` (ascending) as a slice where they are contiguous, else as they are (read-only int64)."""
    if len(positions) and positions[-1] - positions[0] + 1 == len(positions):
        return slice(int(positions[0]), int(positions[-1]) + 1)
    if not len(positions):
        return slice(0, 0)
    return frozen(positions.astype(np.int64))


def group(owner: npt.NDArray[np.uint32], count: int) -> list[npt.NDArray[np.int64]]:
    """Return positions of what belongs to each of ``count`` owners, in order."""
    order = frozen(np.argsort(owner, kind="stable"))
    bounds = np.searchsorted(owner[order], np.arange(count + 1))
    return [order[bounds[i] : bounds[i + 1]] for i in range(count)]


def column(name: str, data: npt.ArrayLike, code: str) -> npt.NDArray[Any]:
    """Return a column of a dtype, read-only, or say in a StructureError what does not fit."""
    wanted = np.dtype(code)
    given = np.asarray(data)
    if given.ndim != 1:
        raise StructureError(f"{name} must be one-dimensional, not of shape {given.shape}")
    if wanted.kind == "S":
        if given.dtype.kind == "U":
            given = np.array([text.encode() for text in given.tolist()], bytes)
        too_long = (row for row, text in enumerate(given.astype(bytes).tolist()) if len(text) > wanted.itemsize)
        if (row := next(too_long, None)) is not None:
            raise StructureError(f"{name} {row} is longer than {wanted.itemsize} bytes: {given[row]!r}")
        return frozen(given.astype(wanted))
    if given.size and given.dtype.kind not in "ui":
        raise StructureError(f"{name} must be integers, not {given.dtype.name}")
    bounds = np.iinfo(wanted)
    if given.size and (int(given.min()) < 0 or int(given.max()) > bounds.max):
        raise StructureError(f"{name} has a value outside 0 to {bounds.max}")
    return frozen(given.astype(wanted))


def texts(column: npt.NDArray[np.bytes_]) -> list[str]:
    return [text.decode(errors="replace") for text in column.tolist()]


def frozen(array: npt.NDArray[_T]) -> npt.NDArray[_T]:
    array.flags.writeable = False
    return array


def same_length(what: str, *columns: npt.NDArray[np.generic]) -> None:
    """Refuse columns of different lengths."""
    lengths = [len(column) for column in columns]
    if len(set(lengths)) > 1:
        raise StructureError(f"the {what} columns have different lengths: {lengths}")


def within(what: str, owner: str, column: npt.NDArray[np.generic], count: int) -> None:
    """Refuse a row number beyond the table that it is of."""
    if len(column) and int(column.max()) >= count:
        row = int(np.argmax(column))
        raise StructureError(f"{what} {row} belongs to {owner} {column[row]}, but there are only {count}")
