"""Keep what a chain has learned in a file, for the next start."""

from __future__ import annotations

import logging
import os
import threading
import time
from pathlib import Path

import numpy as np

from skinware.errors import ConfigurationError
from skinware.realtime import NS_PER_S, now_ns
from skinware.tactile.arrays import read_arrays, write_arrays
from skinware.tactile.baseline import FORGET_AFTER_S
from skinware.tactile.chain import HEALTH, Chain, ChainState

log: logging.Logger = logging.getLogger("skinware.calm")

_VERSION = 2
_SAVE_EVERY_NS = 20 * NS_PER_S


def save_state(path: Path, state: ChainState) -> None:
    """Write a state; raises OSError if that fails."""
    path.parent.mkdir(parents=True, exist_ok=True)
    head = {"time_s": np.array(time.time()), "fingerprint": np.array(state.fingerprint)}
    write_arrays(path, _VERSION, head | state.arrays)


def read_state(path: Path) -> tuple[ChainState | None, str]:
    """Read a state; if it is older than 10 minutes, only what it says of health.

    Returns:
        The state, or None; and what is missing and why, empty if there is simply no file.
    """
    try:
        arrays = read_arrays(path, _VERSION)
        if arrays is None:
            return None, ""
        age_s, fingerprint = time.time() - float(arrays.pop("time_s")), str(arrays.pop("fingerprint"))
    except (ConfigurationError, KeyError, ValueError, TypeError) as error:
        return None, str(error) if isinstance(error, ConfigurationError) else f"{path} cannot be read: {error}"
    if age_s < 0:
        return None, f"{path} is of the future ({-age_s:.0f} s)"
    if any(f"{name.rpartition('/')[0]}/uid" not in arrays for name in arrays):
        return None, f"{path} is no state of a chain"
    if age_s < FORGET_AFTER_S:
        return ChainState(fingerprint, arrays), ""
    why = f"{path} is {age_s:.0f} s old; baselines older than {FORGET_AFTER_S:.0f} s are measured again"
    return ChainState(fingerprint, {name: arrays[name] for name in arrays if name.startswith(HEALTH)}), why


def default_path(namespace: str, name: str) -> Path:
    """Return where the state of a driver's chain is kept: below ``$STATE_DIRECTORY`` (systemd) or the user's own."""
    given = os.environ.get("STATE_DIRECTORY", "").partition(":")[0]
    if given:
        return Path(given) / f"{namespace}.{name}.npz"
    home = os.environ.get("XDG_STATE_HOME") or os.path.join(os.path.expanduser("~"), ".local", "state")
    return Path(home) / "skinware" / "calm" / f"{namespace}.{name}.npz"


class LearnedState:
    """Keeps what one chain has learned in a file (None: in none); ``restored`` baselines began with that."""

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self.restored = 0
        self._saving: threading.Thread | None = None
        self._next_save_ns = now_ns() + _SAVE_EVERY_NS

    def restore(self, chain: Chain, state: ChainState | None = None) -> int:
        """Let a new chain go on with a state, or else with that in the file; return how many baselines that gave.

        A state that does not fit is not used, and a line in the log says why.
        """
        found, why = state, ""
        if state is None and self._path is not None:
            found, why = read_state(self._path)
        restored = 0
        try:
            restored = 0 if found is None else chain.restore(found)
        except ConfigurationError as error:
            why = f"{self._path}: {error}"
        if why:
            log.warning("the learned state does not fit: %s", why)
        self.restored = restored if state is None else self.restored
        return restored

    def keep(self, chain: Chain | None) -> None:
        """Save it if that was long ago; in a thread, as a disk may take long."""
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
        state = chain.state()

        def save() -> None:
            try:
                save_state(path, state)
            except OSError as error:
                log.warning("the learned state cannot be kept: %s: %s", path, error.strerror or error)

        self._saving = threading.Thread(target=save, name="calm-state")
        self._saving.start()
