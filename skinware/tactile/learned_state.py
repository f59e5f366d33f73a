"""What a chain and its health have learned, kept in a file while they run: saved now and then, and read once."""

from __future__ import annotations

import logging
import threading
from dataclasses import replace
from pathlib import Path

from skinware.errors import ConfigurationError
from skinware.realtime import NS_PER_S, now_ns
from skinware.tactile.calm_health import CalmHealth
from skinware.tactile.chain import Chain, ChainState
from skinware.tactile.chain_state import read_state, save_state

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
