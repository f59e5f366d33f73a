"""Which process made a file, and whether it still runs.

A lock alone does not say so: a child that C code forked, past Python's hooks, keeps the lock of its parent.
"""

from __future__ import annotations

import contextlib
import os
import select
from typing import NamedTuple

from skinware.memory.locks import Descriptor

UNKNOWN, ENDED = -1, -2
"""What stands in the place of a descriptor of a process, in C too: nothing can be known of it, or it has ended."""


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

    Args:
        process: which; None: none, of which nothing can be known.
    """

    def __init__(self, process: Process | None) -> None:
        super().__init__(UNKNOWN)
        self._has_ended = False
        if process is None or process.pid_namespace != _pid_namespace() or not _proc_is_ours():
            return
        try:
            self._fd = os.pidfd_open(process.pid)
        except ProcessLookupError:
            self._has_ended = True
        except (OSError, OverflowError):
            return
        else:
            self._poll = select.poll()
            self._poll.register(self._fd, select.POLLIN)
            start_ticks = _start_ticks(process.pid)
            if start_ticks and process.start_ticks and start_ticks != process.start_ticks:  # another has its number now
                self.close()
                self._has_ended = True

    def has_ended(self) -> bool:
        """Return whether the process is known to have ended; False where that cannot be known, or once closed."""
        if self._fd >= 0:
            return bool(self._poll.poll(0))
        return self._has_ended

    @property
    def fd_for_c(self) -> int:
        return ENDED if self._has_ended else self._fd


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
    """Whether ``/proc`` has the pids of this process' namespace: ``unshare --pid`` alone leaves that of its parent."""
    try:
        return os.readlink("/proc/self") == str(os.getpid())
    except OSError:
        return False


def _start_ticks(process: int | str) -> int:
    """Return when a process started, in clock ticks since boot; 0: that cannot be read (hidepid, no descriptor)."""
    with contextlib.suppress(OSError), open(f"/proc/{process}/stat", encoding="ascii", errors="replace") as file:
        return int(file.read().rpartition(")")[2].split()[19])
    return 0
