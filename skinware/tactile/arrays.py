"""Name the arrays of this package by what they hold, keep them in files, and check those that are given back."""

from __future__ import annotations

import contextlib
import os
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from skinware.errors import ConfigurationError

Floats = npt.NDArray[np.float32]
Doubles = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]
Whole = npt.NDArray[np.int64]
Bytes = npt.NDArray[np.uint8]
Arrays = dict[str, npt.NDArray[Any]]
Columns = dict[str, tuple[str, tuple[int, ...], str | None, str]]
"""Columns of a service: dtype, shape, unit (None: that of the values) and meaning of each."""

_VERSION = "version"


def write_arrays(path: Path, version: int, arrays: Arrays) -> None:
    """Write a file in one step: programs see the new file or the one before, never a part of it; raises OSError."""
    draft = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with draft.open("wb") as file:
            np.savez(file, allow_pickle=False, **{_VERSION: np.array(version)}, **arrays)
        draft.replace(path)
    except BaseException:
        with contextlib.suppress(OSError):
            draft.unlink()
        raise


def read_arrays(path: Path, version: int) -> Arrays | None:
    """Read the arrays of a file; None if there is no such file.

    Raises:
        ConfigurationError: it is another kind of file, or of another version.
    """
    try:
        with path.open("rb") as opened, np.load(opened, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        found = int(arrays.pop(_VERSION))
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
        raise ConfigurationError(f"{path} cannot be read: {error}") from None
    if found != version:
        raise ConfigurationError(f"{path} is of another version")
    return arrays


def part_of(arrays: Arrays, begin: str) -> Arrays:
    """Return the arrays whose names begin in this way, without that beginning."""
    return {name.removeprefix(begin): array for name, array in arrays.items() if name.startswith(begin)}


def rows_of(columns: Columns, n: int) -> Columns:
    """Return these columns with n rows each."""
    return {name: (dtype, (n, *shape), unit, text) for name, (dtype, shape, unit, text) in columns.items()}


def check_state(of: str, state: Mapping[str, npt.NDArray[Any]], own: Arrays, rows: npt.NDArray[np.integer]) -> None:
    """Check that a state has arrays like a stage's own, with all rows that are read; raises ConfigurationError."""
    least = int(rows.max(initial=-1)) + 1
    for name, array in own.items():
        given = state.get(name)
        is_like = given is not None and given.ndim == array.ndim and given.shape[1:] == array.shape[1:]
        if given is None or not is_like or given.dtype != array.dtype or len(given) < least:
            raise ConfigurationError(f"no state of {of}: {name} is missing or has a wrong shape or dtype")
