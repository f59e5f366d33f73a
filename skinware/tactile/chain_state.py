"""What a chain has learned, in a file, for the next start."""

from __future__ import annotations

import contextlib
import os
import time
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from skinware.tactile.chain import ChainState

YOUNG_S = 600.0
"""Older ones are worth nothing."""
_VERSION = 1
_OWN = ("version", "time_s", "fingerprint")
_HEALTH = "health/"


def save_state(path: Path, state: ChainState) -> None:
    """Write it, in one step: whoever reads the file sees this state or the one before.

    Raises:
        OSError: it cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    arrays = {f"{kind}/{name}": array for kind, named in state.arrays.items() for name, array in named.items()}
    arrays |= {f"{_HEALTH}{kind}/{name}": array for kind, of in state.health.items() for name, array in of.items()}
    draft = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with draft.open("wb") as file:
            np.savez(
                file,
                allow_pickle=False,
                version=np.array(_VERSION),
                time_s=np.array(time.time()),
                fingerprint=np.array(state.fingerprint),
                **arrays,
            )
        draft.replace(path)
    except BaseException:
        with contextlib.suppress(OSError):
            draft.unlink()
        raise


def read_state(path: Path) -> tuple[ChainState | None, str]:
    """The state of a file; what is known of health alone, if it is older than 10 minutes.

    Returns:
        The state, or None; and what is missing and why, empty if there is simply no file.
    """
    why = ""
    try:
        with path.open("rb") as opened, np.load(opened, allow_pickle=False) as file:
            if int(file["version"]) != _VERSION:
                return None, f"{path} is of another version"
            age_s = time.time() - float(file["time_s"])
            if age_s < 0:
                return None, f"{path} is of the future ({-age_s:.0f} s)"
            fingerprint = str(file["fingerprint"])
            arrays: dict[str, dict[str, npt.NDArray[Any]]] = {}
            health: dict[str, dict[str, npt.NDArray[Any]]] = {}
            for key in file.files:
                if key not in _OWN:
                    kind, _, name = key.removeprefix(_HEALTH).partition("/")
                    (health if key.startswith(_HEALTH) else arrays).setdefault(kind, {})[name] = file[key]
    except FileNotFoundError:
        return None, ""
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
        return None, f"{path} cannot be read: {error}"
    if any("uid" not in named for named in (*arrays.values(), *health.values())):
        return None, f"{path} is no state of a chain"
    if age_s >= YOUNG_S:
        arrays, why = {}, f"{path} is {age_s:.0f} s old; after {YOUNG_S:.0f} s a baseline is worth nothing"
    return ChainState(fingerprint, arrays, health), why


def default_path(namespace: str, name: str) -> Path:
    """Where the state of a driver's chain is kept: under ``$STATE_DIRECTORY`` (systemd) or the user's own."""
    given = os.environ.get("STATE_DIRECTORY", "").partition(":")[0]
    if given:
        return Path(given) / f"{namespace}.{name}.npz"
    home = os.environ.get("XDG_STATE_HOME") or os.path.join(os.path.expanduser("~"), ".local", "state")
    return Path(home) / "skinware" / "calm" / f"{namespace}.{name}.npz"
