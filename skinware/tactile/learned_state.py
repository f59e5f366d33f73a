"""What a chain has learned, kept in a file while it runs: saved now and then in a thread, and read once."""

from __future__ import annotations

import logging
import threading
from pathlib import Path

from skinware.errors import ConfigurationError
from skinware.realtime import NS_PER_S, now_ns
from skinware.tactile.chain import Chain
from skinware.tactile.chain_state import read_state, save_state

log: logging.Logger = logging.getLogger("skinware.calm")

_SAVE_EVERY_NS = 20 * NS_PER_S


class LearnedState:
    """The file of what one chain has learned.

    Args:
        path: of the file; None: nothing is kept.
    """

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self._saving: threading.Thread | None = None
        self._next_save_ns = now_ns() + _SAVE_EVERY_NS

    def restore(self, chain: Chain) -> int:
        """Let a chain go on with what the file has, if it is young and of the same sensors; else say why not.

        Returns:
            How many sensors go on.
        """
        if self._path is None:
            return 0
        restored = 0
        state, why = read_state(self._path)
        try:
            restored = 0 if state is None else chain.restore(state)
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
        state = chain.state()

        def save() -> None:
            try:
                save_state(path, state)
            except OSError as error:
                log.warning("what was learned cannot be kept: %s: %s", path, error.strerror or error)

        self._saving = threading.Thread(target=save, name="calm-state")
        self._saving.start()


__all__ = ["LearnedState"]
