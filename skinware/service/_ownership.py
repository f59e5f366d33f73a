"""Own a service's name: its lock, whatever a killed owner left, its generations, its files, and its state."""

from __future__ import annotations

import contextlib
import inspect
import logging
import os
import re
import secrets
import struct
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy.typing as npt

from skinware.errors import BadServiceFile, Closed, NameInUse, NamespaceError, ServiceNotFound
from skinware.memory import file_layout, segments
from skinware.memory.announcement import sweep
from skinware.memory.locks import Descriptor, Process, has_ended, this_process, try_lock
from skinware.memory.namespace import Namespace, check_name
from skinware.memory.ring_writer import RingWriter
from skinware.memory.schema import Column, Schema
from skinware.realtime import NS_PER_S, now_ns
from skinware.service._server import RequestServer

log = logging.getLogger("skinware.service")

_FILE_CHECK_NS = NS_PER_S
_COUNT = struct.Struct("<Q")
_MOST_FRAMES = 1 << 62
"""A greater count is of a forged or damaged file: 146,000 years at 1 MHz."""
_HOLDER = struct.Struct("<QQQ")
"""In the file of a name's lock, behind the count: the :class:`Process` that took it last."""
_ORPHAN_S = 2.0
"""How long a child that was forked just before its parent was killed may take to close the lock that it inherited."""

Columns = Mapping[str, Column | tuple[npt.DTypeLike, int | tuple[int, ...]]]
"""Every array of a sample, by name: dtype and length, dtype and shape, or a :class:`Column`."""


class Ownership:
    """Holds a name from its construction to ``close``, and publishes one generation after the other under it."""

    _ring: RingWriter

    def __init__(
        self,
        name: str,
        namespace: Namespace | str | None,
        *,
        schema: Schema,
        static: Mapping[str, npt.NDArray[Any]],
        kind: str,
        slots: int | None,
        period_ns: int,
        group: str | None,
        operations: Mapping[str, Callable[..., object]],
        published_before: int | None,
    ) -> None:
        self.name: str = check_name(name, "service")
        self.namespace: Namespace = Namespace.of(namespace)
        self._kind, self._slots, self._group = kind, slots, group
        self._operations = dict(operations)
        self._paused = False
        self._changing = threading.RLock()  # pausing and a new generation exclude each other
        self._server: RequestServer | None = None
        self._next_file_check_ns = 0
        self._file_trouble = ""
        self.namespace.create(group)
        self._name_lock = take_name(self.namespace, name)
        try:
            sweep(self.namespace)
            try:
                previous = segments.attach(self.namespace, name, writable=True)  # a dead writer left it
            except (ServiceNotFound, BadServiceFile):
                previous = None
            if published_before is None:
                published_before = _published_so_far(self._name_lock, previous)
            self._begin_generation(schema, static, period_ns, previous, published_before)
        except BaseException:
            self._name_lock.close()
            raise

    @property
    def generation(self) -> int:
        return self._ring.segment.generation

    @property
    def sequence(self) -> int:
        """Sequence of the newest sample, 0 before the first."""
        return self._ring.sequence

    @property
    def slots(self) -> int:
        return self._ring.segment.layout.slot_count

    @property
    def position(self) -> tuple[int, int]:
        return self.generation, self.sequence

    @property
    def ring_address(self) -> int:
        """Address of the ring's ``skinware_ring_writer``, for C code that publishes through it."""
        return self._ring.native_address

    def column_offsets(self) -> dict[str, int]:
        """Return where each column begins, bytes from the beginning of a slot."""
        return {name: offset for name, (_, _, offset) in self._ring.segment.slot_formats().items()}

    @property
    def paused(self) -> bool:
        return self._paused

    def pause(self) -> None:
        """Publish nothing until ``resume``; readers and requesters notice it. From any thread.

        Raises:
            Closed: this writer was closed, or belongs to the process before a fork.
        """
        self._set_paused(True)

    def resume(self) -> None:
        """Go on after ``pause``. From any thread.

        Raises:
            Closed: this writer was closed, or belongs to the process before a fork.
        """
        self._set_paused(False)

    def request_server(self) -> RequestServer:
        """Return the socket that requests come by, for event loops: readable when ``requests`` has something to say.

        Raises:
            Closed: this writer was closed, or belongs to the process before a fork.
            NamespaceError: the socket cannot be made.
        """
        self._require_open()
        if self._server is None:
            described = {name: inspect.getdoc(function) or "" for name, function in self._operations.items()}
            first_lines = {name: text.partition("\n")[0] for name, text in described.items()}
            self._server = RequestServer(self.namespace, self.name, first_lines)
            self._server.paused = self._paused
            if self._period_ns:
                self._server.fit_into(self._period_ns)
        return self._server

    def keep_files(self) -> None:
        """Make files again that somebody removed; looks once a second, however often it is called.

        ``begin``, ``requests`` and the loops call it. A loop of your own that does neither for seconds must.

        Raises:
            NameInUse: somebody removed the lock of the name, and another writer has it now; this one is closed then.
        """
        if now_ns() < self._next_file_check_ns or self.closed:
            return
        self._next_file_check_ns = now_ns() + _FILE_CHECK_NS
        try:
            self._make_removed_files()
        except NamespaceError as error:
            if str(error) != self._file_trouble:
                log.warning("%s; readers cannot find %r until it can be made", str(error), self.name)
            self._file_trouble = str(error)
        else:
            self._file_trouble = ""

    @property
    def closed(self) -> bool:
        """Whether ``close`` was called, or this is the child of a fork."""
        return self._name_lock.fd < 0

    def close(self) -> None:
        """Withdraw the service and give the name back. Idempotent; in the child of a fork it does nothing."""
        if self.closed:
            return
        with self._changing:
            segment = self._ring.segment
            _note_published(self._name_lock, segment.published)
            path = self.namespace.ring_path(self.name)
            if segments.current_inode(path) == segment.inode:
                path.unlink()
            self._ring.set_state(file_layout.STATE_CLOSED)
            segment.close()
            if self._server is not None:
                self._server.close()  # now: who finds no socket finds no living writer either
            self._name_lock.close()

    def desert(self) -> None:
        """Give the name back and leave the files as they are, as the kernel does for a writer that is killed."""
        if self.closed:
            return
        with self._changing:
            self._ring.segment.close()
            if self._server is not None:
                self._server.abandon()
            self._name_lock.close()

    def _begin_generation(
        self,
        schema: Schema,
        static: Mapping[str, npt.NDArray[Any]],
        period_ns: int,
        previous: segments.Segment | None,
        published_before: int,
    ) -> None:
        """All that can fail comes before the file takes its place; until then the generation before goes on."""
        with self._changing:
            segment = segments.create(
                self.namespace,
                self.name,
                schema,
                static,
                slots=self._slots,
                kind=self._kind,
                period_ns=period_ns,
                published_before=published_before,
            )
            try:
                ring = RingWriter(segment)
                ring.set_state(file_layout.STATE_PAUSED, self._paused)
                segments.publish(segment, self.namespace, self.name)
            except BaseException:
                with contextlib.suppress(FileNotFoundError):
                    os.unlink(segment.path)
                segment.close()
                raise
            self._ring, self._static = ring, dict(static)
            self._next_file_check_ns = now_ns() + _FILE_CHECK_NS
            if previous is not None:
                previous.mark(file_layout.STATE_SUPERSEDED)  # its readers wake up and find the new file
                previous.close()

    @property
    def _period_ns(self) -> int:
        return int(self._ring.segment.header["period_ns"])

    def _succeed(
        self, schema: Schema, static: Mapping[str, npt.NDArray[Any]], rate_hz: float | None = None, skip: int = 0
    ) -> None:
        self._require_open()
        own = self._ring.segment
        period_ns = self._period_ns if rate_hz is None else round(NS_PER_S / rate_hz)
        self._begin_generation(schema, static, period_ns, own, own.published + skip)

    def _set_paused(self, paused: bool) -> None:
        self._require_open()
        with self._changing:
            self._paused = paused
            self._ring.set_state(file_layout.STATE_PAUSED, paused)
        if self._server is not None:
            self._server.paused = paused

    def _require_open(self) -> None:
        if self.closed:
            raise Closed(f"the writer of {self.name!r} was closed, or belongs to the process before a fork")

    def _make_removed_files(self) -> None:
        if os.fstat(self._name_lock.fd).st_nlink == 0:
            self.namespace.create(self._group)
            try:
                taken = take_name(self.namespace, self.name)
            except NameInUse:
                self.close()
                raise
            self._name_lock.close()
            self._name_lock = taken
        if os.fstat(self._ring.segment.descriptor.fd).st_nlink == 0:
            self._succeed(self._ring.segment.schema, self._static)
        if self._server is not None:
            self._server.keep()


def take_name(namespace: Namespace, name: str) -> Descriptor:
    """Become the owner of a service's name, for as long as the returned descriptor is open.

    What the owner before left half made or cannot take back (it was killed) is removed, but for the ring: readers still
    want its last sample. A child of a killed owner may still have the lock: for a moment where Python forked it, which
    is waited for, and as long as it lives where C did; its lock's file is then replaced.

    Raises:
        NameInUse: a living process owns it.
        NamespaceError: the lock file cannot be used.
    """
    path = namespace.lock_path(name)
    deadline = time.monotonic() + _ORPHAN_S
    while True:
        try:
            descriptor = Descriptor(os.open(path, segments.OPEN_FLAGS | os.O_RDWR | os.O_CREAT, 0o600))
        except OSError as error:
            raise NamespaceError(f"cannot open the lock {path}: {error.strerror}") from None
        if try_lock(descriptor.fd):
            try:
                os.pwrite(descriptor.fd, _HOLDER.pack(*this_process()), _COUNT.size)
            except OSError as error:
                raise NamespaceError(f"cannot write the lock {path}: {error.strerror}") from None
            if segments.current_inode(path) == segments.inode_of(descriptor.fd):
                break  # otherwise it was removed or replaced meanwhile
        elif not _holder_has_ended(descriptor.fd):
            descriptor.close()
            raise NameInUse(
                f"a running driver or service is called {name!r} in namespace {namespace.name!r};"
                " stop it (skin-info shows its pid), or choose another name or namespace (SKINWARE_NAMESPACE)"
            )
        elif time.monotonic() > deadline:
            _replace_lock(namespace, name, descriptor)
        else:
            time.sleep(0.005)
        descriptor.close()
    leftover = re.compile(rf"\.{re.escape(name)}\.([0-9a-f]{{8}}\.tmp|sock)|{re.escape(name)}\.sock")
    try:
        for entry in os.listdir(namespace.path):
            if leftover.fullmatch(entry):
                os.unlink(namespace.path / entry)
    except OSError as error:
        descriptor.close()
        raise NamespaceError(f"cannot remove what a dead {name!r} left in {namespace.path}: {error.strerror}") from None
    return descriptor


def _holder_has_ended(fd: int) -> bool:
    """Return whether the process that took a lock has ended, so that a child of it holds the lock."""
    noted = os.pread(fd, _HOLDER.size, _COUNT.size)
    return len(noted) == _HOLDER.size and has_ended(Process(*_HOLDER.unpack(noted)))


def _replace_lock(namespace: Namespace, name: str, held: Descriptor) -> None:
    """Put a free lock in the place of one that a child of a dead owner holds; the count in it is kept.

    Where two programs do so at once, the owner notices within a second that its lock is gone, as after any removal
    (``Ownership.keep_files``).
    """
    path = namespace.lock_path(name)
    if segments.current_inode(path) != segments.inode_of(held.fd):
        return
    temporary = namespace.path / f".{name}.{secrets.token_hex(4)}.tmp"
    try:
        with open(os.open(temporary, segments.OPEN_FLAGS | os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
            file.write(os.pread(held.fd, _COUNT.size, 0))
        os.rename(temporary, path)
    except OSError as error:
        with contextlib.suppress(OSError):
            os.unlink(temporary)
        raise NamespaceError(f"cannot replace the lock {path}: {error.strerror}") from None


def _published_so_far(name_lock: Descriptor, last: segments.Segment | None) -> int:
    """Return the number of samples that were published under a name before.

    A writer that is closed leaves the count in the file of the lock, one that is killed in its ring. Absurd counts are
    not believed.
    """
    noted = os.pread(name_lock.fd, _COUNT.size, 0)
    count: int = _COUNT.unpack(noted)[0] if len(noted) == _COUNT.size else 0
    counts = (count, last.published if last is not None else 0)
    return max((count for count in counts if count <= _MOST_FRAMES), default=0)


def _note_published(name_lock: Descriptor, count: int) -> None:
    """Leave word for the next owner of the name."""
    with contextlib.suppress(OSError):  # shared memory is full
        os.pwrite(name_lock.fd, _COUNT.pack(count), 0)
