"""Own the name of a service: one lock at a time, whatever a killed owner left."""

from __future__ import annotations

import contextlib
import os
import re
import secrets
import struct
import time

from skinware.errors import NameInUse, NamespaceError
from skinware.memory.locks import Descriptor, Process, has_ended, this_process, try_lock
from skinware.memory.namespace import Namespace
from skinware.memory.segments import OPEN_FLAGS, Segment, current_inode, inode_of

_COUNT = struct.Struct("<Q")
_MOST_FRAMES = 1 << 62
"""A greater count is of a forged or damaged file: 146,000 years at 1 MHz."""
_HOLDER = struct.Struct("<QQQ")
"""In the file of a name's lock, behind the count: the :class:`Process` that took it last."""
_ORPHAN_S = 2.0
"""How long a child that was forked just before its parent was killed may take to close the lock that it inherited."""


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
            descriptor = Descriptor(os.open(path, OPEN_FLAGS | os.O_RDWR | os.O_CREAT, 0o600))
        except OSError as error:
            raise NamespaceError(f"cannot open the lock {path}: {error.strerror}") from None
        if try_lock(descriptor.fd):
            try:
                os.pwrite(descriptor.fd, _HOLDER.pack(*this_process()), _COUNT.size)
            except OSError as error:
                raise NamespaceError(f"cannot write the lock {path}: {error.strerror}") from None
            if current_inode(path) == inode_of(descriptor.fd):
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
    if current_inode(path) != inode_of(held.fd):
        return
    temporary = namespace.path / f".{name}.{secrets.token_hex(4)}.tmp"
    try:
        with open(os.open(temporary, OPEN_FLAGS | os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
            file.write(os.pread(held.fd, _COUNT.size, 0))
        os.rename(temporary, path)
    except OSError as error:
        with contextlib.suppress(OSError):
            os.unlink(temporary)
        raise NamespaceError(f"cannot replace the lock {path}: {error.strerror}") from None


def published_so_far(name_lock: Descriptor, last: Segment | None) -> int:
    """Return the number of samples that were published under a name before.

    A writer that is closed leaves the count in the file of the lock (:func:`note_published`), one that is killed in its
    ring. Absurd counts are not believed.
    """
    noted = os.pread(name_lock.fd, _COUNT.size, 0)
    count: int = _COUNT.unpack(noted)[0] if len(noted) == _COUNT.size else 0
    counts = (count, last.published if last is not None else 0)
    return max((count for count in counts if count <= _MOST_FRAMES), default=0)


def note_published(name_lock: Descriptor, count: int) -> None:
    """Leave word for the next owner of the name; see :func:`published_so_far`."""
    with contextlib.suppress(OSError):  # shared memory is full
        os.pwrite(name_lock.fd, _COUNT.pack(count), 0)
