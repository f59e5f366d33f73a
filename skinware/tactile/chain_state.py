"""Keep what a chain and its health have learned in a file, for the next start."""

from __future__ import annotations

import contextlib
import logging
import os
import threading
import time
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from skinware.errors import ConfigurationError
from skinware.realtime import NS_PER_S, now_ns
from skinware.tactile.calm_contacts import CalmHealth
from skinware.tactile.chain import Chain, ChainState

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


log: logging.Logger = logging.getLogger("skinware.calm")

_SAVE_EVERY_NS = 20 * NS_PER_S


class LearnedState:
    """The file of what one chain has learned, and what is known of the health of its sensors.

    Args:
        path: of the file; None: nothing is kept.
        health: of the chain; None: nobody looks after it.
    """

    def __init__(self, path: Path | None, health: CalmHealth | None) -> None:
        self._path, self._health = path, health
        self._saving: threading.Thread | None = None
        self._next_save_ns = now_ns() + _SAVE_EVERY_NS

    def state(self, chain: Chain) -> ChainState:
        state = chain.state()
        return state if self._health is None else replace(state, health=self._health.state())

    def restore(self, chain: Chain, state: ChainState | None = None) -> int:
        """Let a chain, which its health follows already, go on with what was learned; else say why not.

        Args:
            chain: a new one.
            state: what was learned; None: what the file has, if it is of the same sensors.

        Returns:
            How many sensors have their baselines again.
        """
        restored, why = 0, ""
        if state is None and self._path is not None:
            state, why = read_state(self._path)
        try:
            if state is not None:
                restored = chain.restore(state)
                if self._health is not None:
                    self._health.restore(state)
        except ConfigurationError as error:
            why = f"{self._path}: {error}"
        if why:
            log.warning("begun anew: %s", why)
        return restored

    def keep(self, chain: Chain | None) -> None:
        """Save it, if that was long ago; in a thread, for a disk may take long."""
        if now_ns() >= self._next_save_ns:
            self._next_save_ns = now_ns() + _SAVE_EVERY_NS
            self._save(chain)

    def close(self, chain: Chain | None) -> None:
        """Save it a last time, and wait until that is done."""
        self._join()
        self._save(chain)
        self._join()

    def _join(self) -> None:
        if self._saving is not None:
            self._saving.join()

    def _save(self, chain: Chain | None) -> None:
        path = self._path
        if path is None or chain is None or (self._saving is not None and self._saving.is_alive()):
            return
        if not any(baseline.ready.any() for baseline in chain.baselines.values()):
            return  # a file from before says more
        state = self.state(chain)

        def save() -> None:
            try:
                save_state(path, state)
            except OSError as error:
                log.warning("what was learned cannot be kept: %s: %s", path, error.strerror or error)

        self._saving = threading.Thread(target=save, name="calm-state")
        self._saving.start()
