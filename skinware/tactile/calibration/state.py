"""What was gathered, in a file, so that a calibration can be interrupted."""

from __future__ import annotations

import contextlib
import os
import zipfile
from pathlib import Path

import numpy as np
import numpy.typing as npt

from skinware.errors import ConfigurationError
from skinware.tactile.calibration.sessions import Session

_VERSION = 1
_ARRAYS = "gathered/"


def save_session(path: Path, session: Session, type_name: str, uid: npt.NDArray[np.uint64]) -> None:
    """Write it, in one step: whoever reads the file sees this state or the one before.

    Args:
        path: of the file.
        session: that gathered.
        type_name: of its taxels.
        uid: (n,) of its taxels.

    Raises:
        OSError: it cannot be written.
    """
    arrays = {f"{_ARRAYS}{name}": array for name, array in session.arrays().items()}
    draft = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with draft.open("wb") as file:
            np.savez(
                file,
                allow_pickle=False,
                version=np.array(_VERSION),
                kind=np.array(session.kind),
                type_name=np.array(type_name),
                uid=uid,
                **arrays,
            )
        draft.replace(path)
    except BaseException:
        with contextlib.suppress(OSError):
            draft.unlink()
        raise


def restore_session(path: Path, session: Session, type_name: str, uid: npt.NDArray[np.uint64]) -> bool:
    """Go on with what a file has; False if there is no such file.

    Args:
        path: of the file.
        session: a new one.
        type_name: of its taxels.
        uid: (n,) of its taxels.

    Raises:
        ConfigurationError: it is no such file, of other taxels, or of something else than this session gathers.
    """
    try:
        with path.open("rb") as opened, np.load(opened, allow_pickle=False) as file:
            if int(file["version"]) != _VERSION:
                raise ConfigurationError(f"{path} is of another version")
            if str(file["kind"]) != session.kind:
                raise ConfigurationError(f"{path} has {file['kind']} of a skin, not {session.kind}")
            if str(file["type_name"]) != type_name or not np.array_equal(file["uid"], uid):
                raise ConfigurationError(f"{path} is of other sensors")
            session.restore({name.removeprefix(_ARRAYS): file[name] for name in file.files if name.startswith(_ARRAYS)})
    except FileNotFoundError:
        return False
    except ConfigurationError as error:
        raise ConfigurationError(str(error) if str(path) in str(error) else f"{path}: {error}") from None
    except (ValueError, KeyError, TypeError, IndexError, EOFError, zipfile.BadZipFile) as error:
        raise ConfigurationError(f"{path} cannot be read: {error}") from None
    return True
