"""Modules whose sensors lie in rows and columns: which of them is where."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Never

import numpy as np
import numpy.typing as npt

from skinware._columns import frozen, group
from skinware.errors import StructureError

_KIND = re.compile(r"([1-9]\d*)x([1-9]\d*)")
_MOST_NAMES = 20
"""That an error lists."""


def rows_and_columns(kind: str) -> tuple[int, int] | None:
    """What the kind of a module says, as ``4x6`` does; None: nothing of the sort."""
    said = _KIND.fullmatch(kind)
    return (int(said[1]), int(said[2])) if said else None


def filled_by(kind: str, count: int) -> tuple[int, int] | None:
    """Rows and columns of a module of this kind, if so many sensors fill them; else None."""
    shape = rows_and_columns(kind)
    return shape if shape is not None and shape[0] * shape[1] == count else None


class Matrices(dict[str, npt.NDArray[np.int64]]):
    """Where the sensors of a type are in each module that is a matrix of them, by the module's name.

    Values are (rows, columns) int64, read-only: positions among the sensors of the type. So they are indices for all
    arrays of that type. A name that is not here raises a StructureError, which says why.

    Args:
        type_name: of the sensors.
        names: of all modules.
        kinds: likewise.
        module_of: (n,) the module of each sensor; in a matrix, they are row by row.
    """

    def __init__(
        self, type_name: str, names: Sequence[str], kinds: Sequence[str], module_of: npt.NDArray[np.int64]
    ) -> None:
        super().__init__()
        self._type_name, self._kind_of = type_name, dict(zip(names, kinds, strict=True))
        positions = np.arange(len(module_of))
        for name, kind, index in zip(names, kinds, group(module_of.astype(np.uint32), len(names)), strict=True):
            shape = filled_by(kind, len(positions[index]))
            if shape is not None:
                self[name] = frozen(positions[index].reshape(shape))

    def __missing__(self, name: str) -> Never:
        if name not in self._kind_of:
            more = f" ... ({len(self)} in all)" if len(self) > _MOST_NAMES else ""
            there_are = ", ".join(map(repr, list(self)[:_MOST_NAMES])) or "none"
            raise StructureError(f"no module {name!r} here; matrices of {self._type_name}: {there_are}{more}")
        kind = self._kind_of[name]
        if rows_and_columns(kind) is None:
            raise StructureError(f"module {name!r} is no matrix but {kind!r}; its geometry tells where its sensors are")
        raise StructureError(f"module {name!r} is {kind}, but does not have a {self._type_name} sensor at each place")


__all__ = ["Matrices", "filled_by", "rows_and_columns"]
