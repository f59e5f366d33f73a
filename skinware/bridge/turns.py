"""Jobs of other threads, done in the one that runs."""

from __future__ import annotations

import contextlib
import os
import threading
from collections import deque
from collections.abc import Callable

_MOST = 4096
_MOST_BYTES = 1 << 27


class Turns:
    """Jobs that wait for their turn.

    Attributes:
        fd: can be read from while there are any.
        left_out: jobs that were left out because too many waited.
    """

    def __init__(self) -> None:
        self._jobs: deque[tuple[int, Callable[[], object]]] = deque()
        self._size = 0  # of what waits
        self._lock = threading.RLock()  # signal handlers come in between
        self.left_out: int = 0
        self.fd: int = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK)

    def soon(self, job: Callable[[], object], size: int = 0) -> None:
        """Have it done; from any thread.

        Args:
            job: what is to be done.
            size: of the message that it keeps until then, bytes. With too many of them it is left out.
        """
        with self._lock:
            if len(self._jobs) >= _MOST or self._size + size > _MOST_BYTES:
                self.left_out += 1
                return
            self._size += size
            self._jobs.append((size, job))
        self.ring()

    def ring(self) -> None:
        """Wake the one that waits; from any thread, and from a signal handler."""
        with self._lock:
            if self.fd >= 0:
                os.eventfd_write(self.fd, 1)

    def take(self) -> None:
        with contextlib.suppress(BlockingIOError):
            os.eventfd_read(self.fd)
        for _ in range(len(self._jobs)):
            with self._lock:
                size, job = self._jobs.popleft()
                self._size -= size
            job()

    def close(self) -> None:
        with self._lock:
            fd, self.fd = self.fd, -1
            os.close(fd)
