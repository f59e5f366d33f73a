"""What other threads want done, in the one that runs."""

from __future__ import annotations

import contextlib
import os
import threading
from collections import deque
from collections.abc import Callable


class Turns:
    """Jobs that wait for their turn.

    Attributes:
        fd: can be read from while there are any.
    """

    def __init__(self) -> None:
        self._jobs: deque[Callable[[], None]] = deque()
        self._lock = threading.RLock()  # signal handlers come in between
        self.fd: int = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK)

    def soon(self, job: Callable[[], None]) -> None:
        """Have it done; from any thread."""
        self._jobs.append(job)
        self.ring()

    def ring(self) -> None:
        """Wake who waits; from any thread, and from a signal handler."""
        with self._lock:
            if self.fd >= 0:
                os.eventfd_write(self.fd, 1)

    def take(self) -> None:
        """Do what waits."""
        with contextlib.suppress(BlockingIOError):
            os.eventfd_read(self.fd)
        for _ in range(len(self._jobs)):
            self._jobs.popleft()()

    def close(self) -> None:
        """End it."""
        with self._lock:
            fd, self.fd = self.fd, -1
            os.close(fd)


__all__ = ["Turns"]
