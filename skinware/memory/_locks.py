"""Open-file-description locks: who lives. They end with their process, whatever kills it."""

from __future__ import annotations

import fcntl
import os
import struct
import weakref
from errno import EACCES, EAGAIN
from typing import ClassVar

_FLOCK = struct.Struct("hhqqi4x")  # struct flock: l_type, l_whence, l_start, l_len, l_pid (0 for OFD locks)


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
    reply = fcntl.fcntl(fd, fcntl.F_OFD_GETLK, _FLOCK.pack(fcntl.F_RDLCK, os.SEEK_SET, 0, 0, 0))
    lock_type: int = _FLOCK.unpack(reply[: _FLOCK.size])[0]
    return lock_type == fcntl.F_WRLCK


class Descriptor:
    """An open file descriptor that a forked child gives up, so that the child cannot keep a lock alive.

    A lock belongs to the open file description, which fork() shares: without this, the child of a killed
    driver would make the driver look alive for as long as the child lives.
    """

    _all: ClassVar[weakref.WeakSet[Descriptor]] = weakref.WeakSet()

    def __init__(self, fd: int) -> None:
        self._fd = fd
        Descriptor._all.add(self)

    @property
    def fd(self) -> int:
        """The descriptor, or -1 once closed (by ``close`` or because this process was forked)."""
        return self._fd

    def close(self) -> None:
        """Close it, which also lets go of its lock. Idempotent."""
        fd, self._fd = self._fd, -1
        if fd >= 0:
            os.close(fd)

    def __del__(self) -> None:
        self.close()

    @classmethod
    def close_all_in_child(cls) -> None:
        """Run by fork() in the child."""
        for descriptor in list(cls._all):
            descriptor.close()


os.register_at_fork(after_in_child=Descriptor.close_all_in_child)
