"""Open-file-description locks: who lives. They end with their process, whatever kills it."""

from __future__ import annotations

import contextlib
import fcntl
import os
import struct
import weakref
from errno import EACCES, EAGAIN
from typing import ClassVar

_FLOCK = struct.Struct("hhqqi4x")  # struct flock: l_type, l_whence, l_start, l_len, l_pid (0 for OFD locks)
_TO_READ = _FLOCK.pack(fcntl.F_RDLCK, os.SEEK_SET, 0, 0, 0)


def try_lock(fd: int) -> bool:
    """Take the exclusive lock on a whole file (open for writing); False if another description holds it."""
    try:
        fcntl.fcntl(fd, fcntl.F_OFD_SETLK, _FLOCK.pack(fcntl.F_WRLCK, os.SEEK_SET, 0, 0, 0))
    except OSError as error:
        if error.errno in (EACCES, EAGAIN):
            return False
        raise
    return True


def is_locked(fd: int) -> bool:
    """Whether somebody else holds the exclusive lock; takes no lock itself, a read-only descriptor will do."""
    reply = fcntl.fcntl(fd, fcntl.F_OFD_GETLK, _TO_READ)
    lock_type: int = _FLOCK.unpack(reply[: _FLOCK.size])[0]
    return lock_type == fcntl.F_WRLCK


class ForkGuard:
    """Base of what a forked child must give up, lest it keeps alive what died with its parent.

    Locks and connections belong to the open file description, which fork() shares: without this, the child of a
    killed driver would make the driver look alive for as long as the child lives. A subclass calls ``__init__`` when it
    is complete, so that ``abandon`` finds what it needs.
    """

    _all: ClassVar[weakref.WeakSet[ForkGuard]] = weakref.WeakSet()

    def __init__(self) -> None:
        ForkGuard._all.add(self)

    def abandon(self) -> None:
        """Close what this process inherited; nothing that others can see may change. Run by fork() in the child."""
        raise NotImplementedError

    @classmethod
    def abandon_all(cls) -> None:
        """Run by fork() in the child: all of them, whatever goes wrong with one."""
        with contextlib.ExitStack() as stack:
            for guarded in list(cls._all):
                stack.callback(guarded.abandon)


os.register_at_fork(after_in_child=ForkGuard.abandon_all)


class Descriptor(ForkGuard):
    """An open file descriptor that a forked child gives up."""

    def __init__(self, fd: int) -> None:
        self._fd = fd
        super().__init__()

    @property
    def fd(self) -> int:
        """The descriptor, or -1 once closed (by ``close`` or because this process was forked)."""
        return self._fd

    def close(self) -> None:
        """Close it, which also lets go of its lock. Idempotent."""
        fd, self._fd = self._fd, -1
        if fd >= 0:
            os.close(fd)

    def abandon(self) -> None:
        """See :class:`ForkGuard`."""
        self.close()

    def __del__(self) -> None:
        self.close()
