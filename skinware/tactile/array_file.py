"""Keep named arrays in a file."""

from __future__ import annotations

import contextlib
import os
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from skinware.errors import ConfigurationError

Arrays = dict[str, npt.NDArray[Any]]
_VERSION = "version"


def write_arrays(path: Path, version: int, arrays: Arrays) -> None:
    """Write the file in one step: programs see the new file or the one before, never a part of it.

    Raises:
        OSError: it cannot be written.
    """
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
