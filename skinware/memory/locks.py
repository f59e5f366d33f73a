"""Decide whether the writer of a service is alive: its lock and its process."""

from __future__ import annotations

import contextlib
import fcntl
import os
import select
import struct
import threading
import weakref
from errno import EACCES, EAGAIN
from typing import ClassVar, NamedTuple

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
    """Return whether somebody else holds the exclusive lock; takes no lock itself, a read-only descriptor will do."""
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
        """Abandon all in a forked child, whatever goes wrong with one."""
        with contextlib.ExitStack() as stack:
            for guarded in list(cls._all):
                stack.callback(guarded.abandon)


os.register_at_fork(after_in_child=ForkGuard.abandon_all)


class Descriptor(ForkGuard):
    """An open file descriptor that a forked child gives up.

    Attributes:
        fd: the descriptor, or -1 once closed (by ``close`` or because this process was forked).
    """

    def __init__(self, fd: int) -> None:
        self.fd = fd
        self._in_use = threading.RLock()  # a number that is closed meanwhile may be another file's
        super().__init__()

    def is_locked(self) -> bool:
        """Return whether somebody else holds the exclusive lock on its file; False once closed."""
        with self._in_use:
            return self.fd >= 0 and is_locked(self.fd)

    def close(self) -> None:
        """Close it once no other thread asks, which also lets go of its lock. Idempotent."""
        with self._in_use:
            fd, self.fd = self.fd, -1
            if fd >= 0:
                os.close(fd)

    def abandon(self) -> None:
        """Close it in a forked child, in which a thread that asked is no more."""
        self._in_use = threading.RLock()
        self.close()

    __del__ = close


UNKNOWN, ENDED = -1, -2
"""Values in the place of a process' descriptor, in C too: nothing can be known of it, or it has ended."""


class Process(NamedTuple):
    """A process, for all time and for every pid namespace of this machine.

    Attributes:
        pid: its number in its own pid namespace.
        start_ticks: when it started, clock ticks since boot: field 22 of ``/proc/PID/stat``; 0: unknown.
        pid_namespace: inode of its ``/proc/self/ns/pid``.
    """

    pid: int
    start_ticks: int
    pid_namespace: int


def this_process() -> Process:
    return Process(os.getpid(), _start_ticks("self"), _pid_namespace())


class ProcessWatch(Descriptor):
    """Answers whether a process has ended, by a pidfd.

    Where nothing can be known (another pid namespace, a ``/proc`` of another one, a kernel before 5.3, no descriptor
    left), it has not ended: the lock alone decides.
    """

    def __init__(self, process: Process | None) -> None:
        super().__init__(UNKNOWN)
        self._has_ended = False
        if process is None or process.pid_namespace != _pid_namespace() or not _proc_is_ours():
            return
        try:
            self.fd = os.pidfd_open(process.pid)
        except ProcessLookupError:
            self._has_ended = True
        except (OSError, OverflowError):
            return
        else:
            start_ticks = _start_ticks(process.pid)
            if start_ticks and process.start_ticks and start_ticks != process.start_ticks:  # another has its number now
                self.close()
                self._has_ended = True

    def has_ended(self) -> bool:
        """Return whether the process is known to have ended; False where that cannot be known, or once closed."""
        with self._in_use:
            if self.fd >= 0:
                poll = select.poll()
                poll.register(self.fd, select.POLLIN)
                return bool(poll.poll(0))
        return self._has_ended

    @property
    def fd_for_c(self) -> int:
        return ENDED if self._has_ended else self.fd


def has_ended(process: Process) -> bool:
    """Return whether a process is known to have ended, asked once."""
    watch = ProcessWatch(process)
    try:
        return watch.has_ended()
    finally:
        watch.close()


def _pid_namespace() -> int:
    try:
        return os.stat("/proc/self/ns/pid").st_ino
    except OSError:
        return 0


def _proc_is_ours() -> bool:
    """Return whether ``/proc`` has the pids of this process' namespace; ``unshare --pid`` alone keeps the parent's."""
    try:
        return os.readlink("/proc/self") == str(os.getpid())
    except OSError:
        return False


def _start_ticks(process: int | str) -> int:
    """Return when a process started, in clock ticks since boot; 0: that cannot be read (hidepid, no descriptor)."""
    with contextlib.suppress(OSError), open(f"/proc/{process}/stat", encoding="ascii", errors="replace") as file:
        return int(file.read().rpartition(")")[2].split()[19])
    return 0
