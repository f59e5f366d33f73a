"""Output of commands whose work must go on: who stops reading it (Ctrl-S, a full pipe) does not hold them up."""

from __future__ import annotations

import contextlib
import errno
import io
import os
import select
import stat
import sys
import threading
import time
from collections import deque
from collections.abc import Iterator
from typing import TextIO

_MOST_WAITING = 1 << 20
"""Bytes that wait to be read; what comes after them is left out."""
_SLICE = select.PIPE_BUF
_AT_THE_END_S = 1.0
"""How long the end of a command waits for who reads."""


class PatientStream(io.TextIOBase):
    """Takes text at once, and writes it when it is read.

    Args:
        stream: where it goes.

    Attributes:
        left_out: writes that were left out because too much waited.
    """

    def __init__(self, stream: TextIO) -> None:
        self._own_fd: int | None = None  # first: Python also closes one that could not be made
        self._waiting: deque[bytes] = deque()
        self._size = 0
        self._lock = threading.RLock()
        self.left_out: int = 0
        self._stream = stream
        self._fd = stream.fileno()
        self._own_fd = _reopened(self._fd)

    @property
    def encoding(self) -> str:  # type: ignore[override]
        return self._stream.encoding

    @property
    def errors(self) -> str | None:  # type: ignore[override]
        return self._stream.errors

    def fileno(self) -> int:
        return self._fd

    def isatty(self) -> bool:
        return self._stream.isatty()

    def writable(self) -> bool:
        return True

    def write(self, text: str) -> int:
        """Take text, and write what can be written now.

        Raises:
            BrokenPipeError: nobody will read it any more.
        """
        data = text.encode(self.encoding, self.errors or "strict")
        with self._lock:
            if self._size + len(data) > _MOST_WAITING:
                self.left_out += 1
            elif data:
                self._waiting.append(data)
                self._size += len(data)
            self.flush()
        return len(text)

    def flush(self) -> None:
        """Write what can be written now.

        Raises:
            BrokenPipeError: nobody will read it any more.
        """
        with self._lock:
            while self._waiting:
                data = self._waiting[0]
                written = self._write(data)
                self._size -= written
                if written < len(data):
                    self._waiting[0] = data[written:]
                else:
                    self._waiting.popleft()
                if not written:
                    return

    def end(self) -> None:
        """Write what waits, for as long as somebody reads it."""
        until_s = time.monotonic() + _AT_THE_END_S
        with contextlib.suppress(OSError):
            self.flush()
            while self._waiting and (left_s := until_s - time.monotonic()) > 0:
                self._until_writable(left_s)
                self.flush()
        self._give_back()

    def close(self) -> None:
        """What still waits is lost: Python closes what nobody has any more, and tells errors to who may not read."""
        self._waiting.clear()
        self._give_back()
        super().close()

    def _give_back(self) -> None:
        fd, self._own_fd = self._own_fd, None
        if fd is not None:
            os.close(fd)

    def _write(self, data: bytes) -> int:
        """How much could be written without a wait."""
        if self._own_fd is not None:
            try:
                return os.write(self._own_fd, data)
            except BlockingIOError:
                return 0
        return os.write(self._fd, data[:_SLICE]) if self._until_writable(0) else 0

    def _until_writable(self, timeout_s: float) -> bool:
        poll = select.poll()
        poll.register(self._fd if self._own_fd is None else self._own_fd, select.POLLOUT)
        return bool(poll.poll(timeout_s * 1000))


def _reopened(fd: int) -> int | None:
    """The same pipe or terminal, opened once more: writes need not wait there. None: it cannot be opened again."""
    kind = os.fstat(fd).st_mode
    if not (stat.S_ISFIFO(kind) or stat.S_ISCHR(kind)):
        return None
    try:
        return os.open(f"/proc/self/fd/{fd}", os.O_WRONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC)
    except OSError:
        return None


@contextlib.contextmanager
def patient_output() -> Iterator[None]:
    """``sys.stdout`` and ``sys.stderr`` never wait in this block. At its end, one line tells what was left out."""
    before = sys.stdout, sys.stderr
    streams = [_patient(stream) for stream in before]
    sys.stdout, sys.stderr = (stream or old for stream, old in zip(streams, before, strict=True))
    try:
        yield
    finally:
        sys.stdout, sys.stderr = before
        out, err = streams
        if out is not None:
            if err is not None and out.left_out:
                with contextlib.suppress(OSError):
                    err.write(f"{out.left_out} lines of output were left out: nobody read them\n")
            out.end()
        if err is not None:
            err.end()


def _patient(stream: TextIO | None) -> PatientStream | None:
    """Of a stream that has a file; None of others (those of tests)."""
    if stream is None:
        return None
    try:
        stream.flush()
        return PatientStream(stream)
    except (OSError, ValueError) as error:
        if isinstance(error, OSError) and error.errno == errno.EPIPE:
            raise
        return None
