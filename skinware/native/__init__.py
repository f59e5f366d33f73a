"""What of this package is compiled: shared libraries in C beside Python that does the same, loaded if they are there.

They are plain libraries, called through ctypes: one serves every Python, and where nothing could be compiled, or
``SKINWARE_NATIVE=0`` is set, everything works without them (docs/decisions/0026-native-code.md).
"""

from __future__ import annotations

import ctypes
import functools
import os
from dataclasses import dataclass
from pathlib import Path

__all__ = ["ABI", "Library", "Loaded", "core", "load", "path", "why_python"]

ABI = 6
"""Of the core's own library, ``library.c``: both change together."""

_CORE = Path(__file__).with_name("libskinware.so")


@dataclass(frozen=True)
class Library:
    """A loaded library.

    Attributes:
        waiting: its functions, called without the interpreter lock: for those that sleep.
        quick: its functions, called with the lock kept: for those that never block.
    """

    waiting: ctypes.CDLL
    quick: ctypes.PyDLL


@dataclass(frozen=True)
class Loaded:
    """What came of loading a library.

    Attributes:
        library: None: Python does its work.
        why_python: why there is none; empty if there is one.
    """

    library: Library | None
    why_python: str = ""


@functools.cache
def load(file: Path, abi: int) -> Loaded:
    """A library of this package, once for the process.

    Args:
        file: beside the module that calls it.
        abi: what its ``skinware_native_abi`` has to answer: it was compiled from other sources otherwise.
    """
    if os.environ.get("SKINWARE_NATIVE") == "0":
        return Loaded(None, "SKINWARE_NATIVE=0")
    try:
        file.stat()
        library = Library(ctypes.CDLL(str(file)), ctypes.PyDLL(str(file)))
        found = library.quick.skinware_native_abi()
    except FileNotFoundError:
        return Loaded(None, f"no {file.name}: it was not compiled when this package was installed")
    except (OSError, AttributeError) as error:
        return Loaded(None, f"{file.name} cannot be loaded: {error}")
    if found != abi:
        return Loaded(None, f"{file.name} is of another version ({found}, not {abi}): install this package again")
    return Loaded(library)


def core() -> Library | None:
    """The core's own library, None where Python does its work."""
    return load(_CORE, ABI).library


def path() -> str:
    """Which way frames take through the core: ``native`` or ``python``."""
    return "python" if core() is None else "native"


def why_python() -> str:
    """Why the way is ``python``; empty if it is not."""
    return load(_CORE, ABI).why_python
