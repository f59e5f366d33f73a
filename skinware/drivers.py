"""Follow the drivers of a namespace, or its services of another kind: which there are, which come, change and go."""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import Any, Generic, NamedTuple, Self, TypeVar

from skinware.errors import (
    BadServiceFile,
    ConfigurationError,
    NamespaceError,
    Overrun,
    ServiceNotFound,
    ServiceTimeout,
    StructureChanged,
)
from skinware.memory import futex, segments
from skinware.memory.namespace import Namespace
from skinware.memory.ring import Sample
from skinware.realtime import NS_PER_S, now_ns
from skinware.service import ServiceReader
from skinware.service._reader import wake_word_of

LOOK_EVERY_NS = NS_PER_S // 5
"""Time between two looks for services that came or went."""
_ALIVE_FOR_NS = NS_PER_S // 10
_REFUSED_FOR_NS, _NEVER_NS = 60 * NS_PER_S, 1 << 62

ReaderT = TypeVar("ReaderT", bound=ServiceReader[Any])


class _Refusal(NamedTuple):
    """A file that is not read: its inode, the time of the next attempt, and why (empty: it is not wanted)."""

    inode: int
    until_ns: int
    why: str = ""


class Drivers(Generic[ReaderT]):
    """Keep one reader of every driver in a namespace, and close it when the driver has gone.

    Nothing here waits, and nothing runs by itself: call ``look`` now and then. A file that cannot be read, or is of
    another kind, is tried again when it is replaced, and after a minute.

    Args:
        reader: makes a reader from a name and ``namespace=``. It raises
            :class:`skinware.errors.BadServiceFile` for a service of another kind; a class of readers does.
        names: of the services to follow; None: all.
        wants: called with each new reader, and again when its structure has changed; False: do not follow it.
        only_living: follow a service only once its writer lives and has published, and then until ``drop``. Default:
            follow every service that can be read, dead or alive, as long as its file is there.
        every_ns: shortest time between two looks; default: 0.2 s.

    Attributes:
        readers: by name, in order.
        next_look_ns: time of the next look, CLOCK_MONOTONIC ns.
        trouble: what keeps this program from reading the namespace: rights, descriptors or memory; empty: nothing.
    """

    def __init__(
        self,
        namespace: Namespace,
        reader: Callable[..., ReaderT],
        names: Collection[str] | None = None,
        *,
        wants: Callable[[ReaderT], bool] = lambda _: True,
        only_living: bool = False,
        every_ns: int | None = None,
    ) -> None:
        self.namespace = namespace
        self.readers: dict[str, ReaderT] = {}
        self._others: tuple[str, ...] = ()
        self._reader, self._wants, self._only_living = reader, wants, only_living
        self._names = None if names is None else frozenset(names)
        self._every_ns = every_ns
        self.next_look_ns = 0
        self.trouble = ""
        self._inodes: dict[str, int] = {}  # of the last look
        self._refused: dict[str, _Refusal] = {}
        self._newest: dict[str, Sample] = {}
        self._alive_until_ns: dict[str, int] = {}

    @property
    def unreadable(self) -> dict[str, str]:
        """Why each of the services that cannot be read cannot, by name."""
        return {name: refusal.why for name, refusal in self._refused.items() if refusal.why}

    def look(self, *, at_once: bool = False) -> bool:
        """Find services that came or went, if a look is due.

        Returns:
            False if no look was due, or all services are followed and every file is that of the look before.

        Raises:
            NamespaceError: the namespace cannot be read.
        """
        if not at_once and now_ns() < self.next_look_ns:
            return False
        self.next_look_ns = now_ns() + (LOOK_EVERY_NS if self._every_ns is None else self._every_ns)
        before, self._inodes = self._inodes, self.namespace.service_inodes()
        inodes = self._inodes
        if inodes == before and not self._others:
            return False
        self._refused = {name: refusal for name, refusal in self._refused.items() if name in inodes}
        self.trouble = ""
        if not self._only_living:
            for name in self.readers.keys() - inodes.keys():
                self.drop(name)
        for name in inodes.keys() - self.readers.keys():
            if self._names is None or name in self._names:
                self._attach(name, inodes[name])
        self.readers = dict(sorted(self.readers.items()))
        self._others = tuple(sorted(inodes.keys() - self.readers.keys()))
        return True

    def keep_up(self, name: str) -> ReaderT | None:
        """Go over to the newest generation of a service, whatever its structure.

        Returns:
            Its reader; None if the service is not followed any more, because it went, cannot be read (see
            ``unreadable``), or is not wanted.
        """
        reader = self.readers.get(name)
        if reader is None:
            return None
        try:
            reader.refresh()
            if reader.structure_changed:
                reader.reattach()
                if not self._wants(reader):
                    self.drop(name)
                    return None
        except ServiceNotFound:
            self.drop(name)
            return None
        except (BadServiceFile, NamespaceError) as error:
            self.drop(name)
            self._refused[name] = _Refusal(0, 0, str(error))
            return None
        return reader

    def newest(self, name: str, *, newer_than: Sample | None = None) -> Any:
        """Return the newest sample of a service; never wait.

        Returns:
            None if there is no newer one, the service has just restarted, or is not followed any more.
        """
        reader = self.readers.get(name)
        if reader is None or newer_than is None or reader.newest_position in (None, newer_than.position):
            reader = self.keep_up(name)  # which looks at the file
        newest = None if reader is None else reader.newest_position
        if reader is None or newest is None or (newer_than is not None and newest == newer_than.position):
            return None
        try:
            return reader.read(newer_than=newer_than, timeout_s=0.0)
        except (Overrun, ServiceTimeout, StructureChanged):
            return None

    def newest_of_living(self, name: str) -> Any:
        """Return the newest sample of a service, the same object while there is no newer one; never wait.

        Returns:
            None if it is not followed, has published nothing since it began, or its writer is dead (killed: 0.1 s ago).
        """
        sample, reader = self._newest.get(name), self.readers.get(name)
        is_due = reader is None or reader.moved_on or now_ns() >= self._alive_until_ns.get(name, 0)
        if not (sample is None or reader is None or is_due or reader.newest_position != sample.position):
            return sample
        newer = self.newest(name, newer_than=sample)
        if newer is not None:
            self._newest[name] = newer
        sample, reader = self._newest.get(name), self.readers.get(name)
        if sample is None or reader is None or not reader.alive or reader.newest_position is None:
            return None
        self._alive_until_ns[name] = now_ns() + _ALIVE_FOR_NS
        return sample if sample.generation == reader.newest_position[0] else None

    def wake_words(self) -> list[tuple[futex.Word, int]]:
        """Return what :func:`skinware.memory.futex.sleep_on` takes; call it before looking for what is new."""
        return [wake_word_of(reader) for reader in self.readers.values()]

    def drop(self, name: str) -> None:
        """Close the reader of a service; the next look may find the service again."""
        self.readers.pop(name).close()
        self._others = (*self._others, name)

    def close(self) -> None:
        """Close all readers. Idempotent."""
        for name in list(self.readers):
            self.drop(name)

    def _attach(self, name: str, inode: int) -> None:
        refused = self._refused.get(name)
        if refused is not None and refused.inode == inode and now_ns() < refused.until_ns:
            return
        if self._only_living and segments.living_inode(self.namespace, name) is None:
            return
        self._refused.pop(name, None)
        try:
            reader = self._reader(name, namespace=self.namespace)
        except ServiceNotFound:
            return
        except NamespaceError as error:  # the next attempt may go well
            self.trouble = str(error)
            self._refused[name] = _Refusal(inode, 0, self.trouble)
            return
        except (BadServiceFile, ConfigurationError) as error:
            self._refused[name] = _Refusal(inode, now_ns() + _REFUSED_FOR_NS, str(error))
            return
        if not self._wants(reader):
            self._refused[name] = _Refusal(inode, _NEVER_NS)
            reader.close()
        elif self._only_living and not (reader.alive and reader.newest_position):
            reader.close()  # another generation came in between
        else:
            self.readers[name] = reader

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
