"""Services of one kind in a namespace, followed live: they come, die, come back changed, and go."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, Generic, TypeVar

from skinware.errors import BadServiceFile, ConfigurationError, Overrun, ServiceNotFound, ServiceTimeout
from skinware.memory.namespace import Namespace
from skinware.memory.ring import SampleT
from skinware.service import ServiceReader

ReaderT = TypeVar("ReaderT", bound=ServiceReader[Any])


class LiveServices(Generic[ReaderT, SampleT]):
    """The services of one kind in one namespace.

    Args:
        namespace: where to look.
        reader: class of the readers of this kind; attaching to a service of another one raises
            :class:`skinware.errors.BadServiceFile`.
    """

    def __init__(self, namespace: Namespace, reader: Callable[..., ReaderT]) -> None:
        self._namespace, self._reader = namespace, reader
        self._readers: dict[str, ReaderT] = {}

    def look(self, names: Iterable[str]) -> None:
        """Look for services of the kind that are new, and for those that went.

        Args:
            names: of the services that there are now; those of drivers may be missing.
        """
        there = set(names)
        for name in self._readers.keys() - there:
            self._drop(name)
        for name in there - self._readers.keys():
            try:
                self._readers[name] = self._reader(name, namespace=self._namespace)
            except (BadServiceFile, ConfigurationError, ServiceNotFound):
                continue  # another kind of service, or just gone
        self._readers = dict(sorted(self._readers.items()))

    def close(self) -> None:
        for name in list(self._readers):
            self._drop(name)

    def _newest(self, name: str) -> SampleT | None:
        """What a service of a living writer told last; None where there is nothing."""
        reader = self._readers[name]
        try:
            reader.refresh()
            if reader.structure_changed:
                reader.reattach()
            frame: SampleT = reader.read(timeout_s=0.0)
        except (ServiceTimeout, Overrun):
            return None  # nothing published yet
        except (ServiceNotFound, BadServiceFile):
            self._drop(name)
            return None
        return None if frame.stale else frame

    def _drop(self, name: str) -> None:
        self._readers.pop(name).close()
