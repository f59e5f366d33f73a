"""The structs that C and Python share, read from the headers of the C code. Every field has 8 bytes.

The class of ``struct asked_read`` is ``structs.AskedRead``, a ``ctypes.Structure`` with the fields of the struct.
"""

from __future__ import annotations

import ctypes
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from skinware_drivers.wire_tap import Kept

_HEADERS = ("path.h", "inside.h", "framing.h", "flow.h")
_COMMENT = re.compile(r"/\*.*?\*/", re.DOTALL)
_STRUCT = re.compile(r"^struct (\w+) \{(.*?)^\};", re.DOTALL | re.MULTILINE)
_FUNCTION = re.compile(r"(\w+) \(\*(\w+)\)\((.*)\)", re.DOTALL)
_VARIABLES = re.compile(r"(?:const )?(?:struct )?(\w+) (.*)", re.DOTALL)
_OF_C_ALONE = ("path", "chain")
"""Structs with fields of other sizes, which Python never sees."""

_kinds: dict[str, Any] = {"void": None, "int64_t": ctypes.c_int64, "double": ctypes.c_double}
_classes: dict[str, type[ctypes.Structure]] = {}


def _fields(declaration: str) -> Iterator[tuple[str, Any]]:
    if function := _FUNCTION.fullmatch(declaration):
        returned, name, parameters = function.groups()
        kinds = [
            ctypes.c_void_p if "*" in parameter else _kinds[parameter.split()[-2]]
            for parameter in parameters.split(",")
            if parameter != "void"
        ]
        yield name, ctypes.CFUNCTYPE(_kinds[returned], *kinds)
    elif variables := _VARIABLES.fullmatch(declaration):
        for variable in variables[2].split(","):
            yield variable.strip(" *"), ctypes.c_void_p if "*" in variable else _kinds[variables[1]]


def _read_headers() -> None:
    text = "".join(Path(__file__).with_name(name).read_text() for name in _HEADERS)
    for name, body in _STRUCT.findall(_COMMENT.sub("", text)):
        if name not in _OF_C_ALONE:
            fields = [field for one in body.split(";") if one.strip() for field in _fields(one.strip())]
            in_python = "".join(word.capitalize() for word in name.split("_"))
            _classes[in_python] = _kinds[name] = type(in_python, (ctypes.Structure,), {"_fields_": fields})


_read_headers()


def __getattr__(name: str) -> Any:
    """Return the class of a struct."""
    if name not in _classes:
        raise AttributeError(f"the headers have no struct for {name}")
    return _classes[name]


_MEASURED = (
    *("Plan", "Words", "Batch", "Kind", "Flag", "Run", "Form", "Cycle", "Number", "Assembly", "Flow", "Source"),
    *("Framing", "Stream", "Asker", "AskedRead", "AskedBlock", "Tap", "Update"),
)
SIZES = tuple(ctypes.sizeof(Kept if name == "Tap" else _classes[name]) for name in _MEASURED)
"""The sizes that ``skinware_path_size`` returns, if the library was compiled with these headers."""


class Arrays:
    """Memory that C code refers to by address; it is kept as long as this object."""

    def __init__(self) -> None:
        self._kept: list[object] = []

    def at(self, array: npt.NDArray[Any]) -> int:
        """Return the address of an array that Python goes on using.

        Raises:
            ValueError: its elements do not lie one after the other.
        """
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
