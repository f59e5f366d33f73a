"""The compiled libraries of the package, called through ctypes: one serves every Python (decision 0026).

The structs that C and Python share are read from the headers of the C code. Every field has 8 bytes.
"""

from __future__ import annotations

import ctypes
import functools
import re
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from skinware.errors import PlatformError

__all__ = ["FOLDERS", "Library", "checksum", "core", "load"]

_HERE = Path(__file__).parent
_CORE = _HERE / "libskinware.so"

FOLDERS = (_HERE.parent / "include", _HERE)
"""Folders of the headers that the library of the core is compiled with."""

_COMMENT = re.compile(r"/\*.*?\*/", re.DOTALL)
_STRUCT = re.compile(r"^struct (\w+) \{(.*?)^\};", re.DOTALL | re.MULTILINE)
_FUNCTION = re.compile(r"(\w+) \(\*(\w+)\)\((.*)\)", re.DOTALL)
_VARIABLES = re.compile(r"(?:const )?(?:struct )?(\w+) (.*)", re.DOTALL)
_ARRAY = re.compile(r"(\w+)\[(\d+)\]")
_NUMBERS: dict[str, Any] = {"void": None, "int64_t": ctypes.c_int64, "double": ctypes.c_double}
_DTYPES: dict[str, npt.DTypeLike] = {
    "float": np.float32,
    "double": np.float64,
    "int32_t": np.int32,
    "int64_t": np.int64,
    "uint8_t": np.bool_,
}


@dataclass(frozen=True)
class Library:
    """A loaded library.

    Attributes:
        waiting: its functions, called without the interpreter lock: for those that sleep.
        quick: its functions, called with the lock kept: for those that never block.
    """

    waiting: ctypes.CDLL
    quick: ctypes.PyDLL


def checksum(folders: Iterable[Path]) -> int:
    """Return the checksum of the headers in folders, as setup.py gives it to the compiler."""
    headers = [header for folder in folders for header in sorted(folder.glob("*.h"))]
    return zlib.crc32(b"".join(header.read_bytes() for header in headers))


@functools.cache
def load(file: Path, folders: tuple[Path, ...]) -> Library:
    """Load a library of this package once for the process, if it was compiled with the headers in these folders."""
    try:
        file.stat()
        library = Library(ctypes.CDLL(str(file)), ctypes.PyDLL(str(file)))
        found, wanted = library.quick.skinware_native_headers() & 0xFFFFFFFF, checksum(folders)
    except FileNotFoundError:
        raise PlatformError(f"{file} is missing: install this package again, which compiles it") from None
    except (OSError, AttributeError) as error:
        raise PlatformError(f"{file} cannot be loaded ({error}): install this package again") from None
    if found != wanted:
        raise PlatformError(f"{file} was compiled with other headers: install this package again, which compiles it")
    return library


def core() -> Library:
    """Return the library of the core."""
    return load(_CORE, FOLDERS)


def _fields(declaration: str, kinds: dict[str, Any]) -> Iterator[tuple[str, Any, str]]:
    """Yield the name and kind of each variable, and what it points to."""
    if function := _FUNCTION.fullmatch(declaration):
        returned, name, parameters = function.groups()
        taken = [
            ctypes.c_void_p if "*" in parameter else kinds[parameter.split()[-2]]
            for parameter in parameters.split(",")
            if parameter != "void"
        ]
        yield name, ctypes.CFUNCTYPE(kinds[returned], *taken), ""
    elif variables := _VARIABLES.fullmatch(declaration):
        for variable in variables[2].split(","):
            name = variable.strip(" *")
            if "*" in variable:
                yield name, ctypes.c_void_p, variables[1]
            elif array := _ARRAY.fullmatch(name):
                yield array[1], kinds[variables[1]] * int(array[2]), ""
            else:
                yield name, kinds[variables[1]], ""


def read_structs(headers: Iterable[Path], left_out: Sequence[str] = ()) -> dict[str, type[ctypes.Structure]]:
    """Return a class for each struct: ``AskedRead`` for ``struct asked_read``, with the fields of the struct.

    ``pointers`` of a class has the types that its pointers point to, by name.

    Args:
        headers: files, a struct after those that it contains.
        left_out: names of structs with fields of other sizes, which Python never sees.
    """
    kinds, classes = dict(_NUMBERS), {}
    text = "".join(header.read_text() for header in headers)
    for name, body in _STRUCT.findall(_COMMENT.sub("", text)):
        if name not in left_out:
            fields = [field for one in body.split(";") if one.strip() for field in _fields(one.strip(), kinds)]
            in_python = "".join(word.capitalize() for word in name.split("_"))
            members = {
                "_fields_": [(field, kind) for field, kind, _ in fields],
                "pointers": {field: of for field, _, of in fields if of},
            }
            classes[in_python] = kinds[name] = type(in_python, (ctypes.Structure,), members)
    return classes


def give_arrays(
    words: Any, n: int, sizes: Mapping[str, int], given: Mapping[str, npt.NDArray[Any]] | None = None
) -> dict[str, npt.NDArray[Any]]:
    """Point a struct at arrays, and return them by name; they have to live as long as it.

    Args:
        words: the struct. Its pointers to other structs are left alone, unless their memory is given.
        n: number of elements of an array.
        sizes: of arrays with other numbers of elements.
        given: arrays that there are; the others are new, and 0.
    """
    arrays = dict(given or {})
    for name, of in words.pointers.items():
        if name not in arrays and of in _DTYPES:
            arrays[name] = np.zeros(sizes.get(name, n), _DTYPES[of])
    for name, array in arrays.items():
        setattr(words, name, array.ctypes.data)
    return arrays
