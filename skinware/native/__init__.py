"""The compiled libraries of the package, called through ctypes: one serves every Python (decision 0026)."""

from __future__ import annotations

import ctypes
import functools
from dataclasses import dataclass
from pathlib import Path

from skinware.errors import PlatformError

__all__ = ["ABI", "Library", "core", "load"]

ABI = 11
"""Number of the interface of ``library.c``: both change together."""

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


@functools.cache
def load(file: Path, abi: int) -> Library:
    """Load a library of this package, once for the process.

    Args:
        file: beside the module that calls it.
        abi: what its ``skinware_native_abi`` has to return.

    Raises:
        PlatformError: it is missing, cannot be loaded, or was compiled from other sources.
    """
    try:
        file.stat()
        library = Library(ctypes.CDLL(str(file)), ctypes.PyDLL(str(file)))
        found = library.quick.skinware_native_abi()
    except FileNotFoundError:
        raise PlatformError(f"{file} is missing: install this package again, which compiles it") from None
    except (OSError, AttributeError) as error:
        raise PlatformError(f"{file} cannot be loaded ({error}): install this package again") from None
    if found != abi:
        raise PlatformError(f"{file} has interface {found}, not {abi}: install this package again, which compiles it")
    return library


def core() -> Library:
    """Return the library of the core."""
    return load(_CORE, ABI)
