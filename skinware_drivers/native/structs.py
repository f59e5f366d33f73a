"""The structs that C and Python share, read from the headers of the C code. Every field has 8 bytes.

The class of ``struct asked_read`` is ``structs.AskedRead``, a ``ctypes.Structure`` with the fields of the struct.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from skinware.native import read_structs

_HEADERS = ("path.h", "inside.h", "framing.h", "flow.h", "touching.h")
_OF_C_ALONE = ("path", "chain")
"""Structs with fields of other sizes, which Python never sees."""

_classes = read_structs([Path(__file__).with_name(name) for name in _HEADERS], _OF_C_ALONE)


def __getattr__(name: str) -> Any:
    if name not in _classes:
        raise AttributeError(f"the headers have no struct for {name}")
    return _classes[name]


class Arrays:
    """Memory that C code refers to by address; it is kept as long as this object."""

    def __init__(self) -> None:
        self._kept: list[object] = []

    def at(self, array: npt.NDArray[Any]) -> int:
        """Return the address of an array that Python goes on using."""
        if not array.flags.c_contiguous:
            raise ValueError(f"an array of {array.shape} {array.dtype} whose elements lie apart")
        self._kept.append(array)
        return array.ctypes.data

    def of(self, values: npt.ArrayLike, dtype: npt.DTypeLike) -> int:
        return self.at(np.array(values, dtype, order="C"))

    def structs(self, kind: type[Any], rows: Iterable[Any]) -> tuple[int, int]:
        """Return the number and the address of structs."""
        found = list(rows)
        memory = (kind * max(1, len(found)))(*found)
        self._kept.append(memory)
        return len(found), ctypes.addressof(memory)
