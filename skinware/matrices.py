"""Modules whose sensors lie in rows and columns: which of them is where."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from skinware._columns import frozen, group
from skinware.errors import StructureError

ModuleKey = tuple[str, str, str]
"""Names of a driver, of its patch, and of a module in there: empty for an unnamed module that is alone in its patch."""
Key = TypeVar("Key", bound=ModuleKey | str)

_KIND = re.compile(r"([1-9]\d*)x([1-9]\d*)")
_MOST_NAMES = 20
"""That an error lists."""


def rows_and_columns(kind: str) -> tuple[int, int] | None:
    """Return the size in a module's kind, such as ``4x6``; None if the kind is no such text."""
    said = _KIND.fullmatch(kind)
    return (int(said[1]), int(said[2])) if said else None


def filled_by(kind: str, count: int) -> tuple[int, int] | None:
    """Rows and columns of a module of this kind, if so many sensors fill them; else None."""
    shape = rows_and_columns(kind)
    return shape if shape is not None and shape[0] * shape[1] == count else None


class _NotHere(StructureError, KeyError):
    """A matrix that is missing: a KeyError for ``get`` and ``in``."""

    __str__ = StructureError.__str__


class Matrices(Mapping[Key, npt.NDArray[np.int64]]):
    """Where the sensors of a type are in each module that is a matrix of them, by the module's key.

    Values are (rows, columns) int64, read-only: positions among the sensors of the type. So they are indices for all
    arrays of that type. A key that is not here raises a StructureError, which says why.

    Args:
        module_of: (n,) the module of each sensor; in a matrix, they are row by row.
        names: of all modules; a name that only one of them has is as good as its key.
    """

    def __init__(
        self,
        type_name: str,
        keys: Sequence[Key],
        kinds: Sequence[str],
        module_of: npt.NDArray[np.int64],
        names: Sequence[str] = (),
    ) -> None:
        self._type_name, self._kind_of = type_name, dict(zip(keys, kinds, strict=True))
        self._keys_of: dict[str, list[Key]] = {}
        for name, key in zip(names, keys, strict=bool(names)):
            self._keys_of.setdefault(name, []).append(key)
        self._matrices: dict[Key, npt.NDArray[np.int64]] = {}
        positions = np.arange(len(module_of))
        for key, kind, index in zip(keys, kinds, group(module_of.astype(np.uint32), len(keys)), strict=True):
            shape = filled_by(kind, len(positions[index]))
            if shape is not None:
                self._matrices[key] = frozen(positions[index].reshape(shape))

    def __getitem__(self, key: Key | str) -> npt.NDArray[np.int64]:
        """Return (rows, columns) int64 of a module.

        Raises:
            StructureError: no such module, several of that name, or it is no matrix of these sensors.
        """
        known = [key] if key in self._kind_of else self._keys_of.get(str(key), [])
        if not known:
            more = f" ... ({len(self)} in all)" if len(self) > _MOST_NAMES else ""
            there_are = ", ".join(map(repr, list(self)[:_MOST_NAMES])) or "none"
            raise _NotHere(f"no module {key!r} here; matrices of {self._type_name}: {there_are}{more}")
        if len(known) > 1:
            raise _NotHere(f"several drivers have a module {key!r}; say which: {', '.join(map(repr, known))}")
        (one,) = known
        if one not in self._matrices:
            kind = self._kind_of[one]
            if rows_and_columns(kind) is None:
                raise _NotHere(f"module {key!r} is no matrix but {kind!r}; its geometry has the places of its sensors")
            raise _NotHere(f"module {key!r} is {kind}, but does not have a {self._type_name} sensor at each place")
        return self._matrices[one]

    def __iter__(self) -> Iterator[Key]:
        return iter(self._matrices)

    def __len__(self) -> int:
        return len(self._matrices)
