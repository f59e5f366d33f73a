"""The bridges over which the services of a namespace come, looked at live."""

from __future__ import annotations

from collections.abc import Iterable

from skinware.bridge_state import BridgeReader, BridgeState
from skinware.errors import BadServiceFile, ConfigurationError, Overrun, ServiceNotFound, ServiceTimeout
from skinware.memory.namespace import Namespace


class LiveBridges:
    """What the bridges of a namespace tell of themselves.

    Args:
        namespace: where to look.
    """

    def __init__(self, namespace: Namespace) -> None:
        self._namespace = namespace
        self._readers: dict[str, BridgeReader] = {}

    def look(self, names: Iterable[str]) -> list[BridgeState]:
        """How those that run are now.

        Args:
            names: of the services that there are; those of drivers may be missing.
        """
        there = set(names)
        for name in self._readers.keys() - there:
            self._drop(name)
        for name in there - self._readers.keys():
            try:
                self._readers[name] = BridgeReader(name, namespace=self._namespace)
            except (BadServiceFile, ConfigurationError, ServiceNotFound):
                continue  # another kind of service, or just gone
        return [state for name in sorted(self._readers) if (state := self._state(name)) is not None]

    def close(self) -> None:
        """Detach from all. Idempotent."""
        for name in list(self._readers):
            self._drop(name)

    def _state(self, name: str) -> BridgeState | None:
        reader = self._readers[name]
        try:
            if reader.refresh() is not None and reader.structure_changed:
                reader.reattach()
            frame = reader.read(timeout_s=0.0)
        except (ServiceTimeout, Overrun):
            return None  # nothing published yet
        except (ServiceNotFound, BadServiceFile):
            self._drop(name)
            return None
        return None if frame.stale else frame.state

    def _drop(self, name: str) -> None:
        self._readers.pop(name).close()


__all__ = ["LiveBridges"]
