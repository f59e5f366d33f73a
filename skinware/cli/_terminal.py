"""Print to stdout, stderr and terminals, also without waiting for a reader that stopped."""

from __future__ import annotations

import contextlib
import errno
import io
import json
import logging
import os
import re
import secrets
import select
import shutil
import stat
import sys
import threading
import time
import weakref
from collections import deque
from collections.abc import Iterator
from typing import Any, TextIO

import click
import msgspec

from skinware.text import plural, printable

_MOST_WAITING = 1 << 20
"""Bytes that may wait to be read; later text is left out."""
_SLICE = select.PIPE_BUF
_LOOKS_FOR_KEYS = 4
_AT_THE_END_S = 1.0
"""Time that the end of a command waits for a reader."""


class PatientStream(io.TextIOBase):
    """Accept text at once, and write it when the reader takes it; too much text is left out, and counted."""

    def __init__(self, stream: TextIO) -> None:
        self._own_fd: int | None = None  # first: Python also closes a stream that could not be made
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
        """Accept text, and write as much as possible now; BrokenPipeError if the reader is gone."""
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
        """Write as much as possible now; BrokenPipeError if the reader is gone."""
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
        """Write the text that waits, while the reader takes it."""
        until_s = time.monotonic() + _AT_THE_END_S
        with contextlib.suppress(OSError):
            self.flush()
            while self._waiting and (left_s := until_s - time.monotonic()) > 0:
                self._until_writable(left_s)
                self.flush()
        self._give_back()

    def close(self) -> None:
        """Discard the text that waits: Python closes unused streams, and prints errors of it where they may block."""
        self._waiting.clear()
        self._give_back()
        super().close()

    def _give_back(self) -> None:
        fd, self._own_fd = self._own_fd, None
        if fd is not None:
            os.close(fd)

    def _write(self, data: bytes) -> int:
        """Return how much was written; the terminal may be closed, and then SIGHUP ends the command in good order."""
        try:
            if self._own_fd is not None:
                return os.write(self._own_fd, data)
            return os.write(self._fd, data[:_SLICE]) if self._until_writable(0) else 0
        except BlockingIOError:
            return 0
        except OSError as error:
            if error.errno != errno.EIO:
                raise
            return len(data)

    def _until_writable(self, timeout_s: float) -> bool:
        poll = select.poll()
        poll.register(self._fd if self._own_fd is None else self._own_fd, select.POLLOUT)
        return bool(poll.poll(timeout_s * 1000))


def _reopened(fd: int) -> int | None:
    """Open the same pipe or terminal again, without waits in writes; None if it cannot be opened again."""
    kind = os.fstat(fd).st_mode
    if not (stat.S_ISFIFO(kind) or stat.S_ISCHR(kind)):
        return None
    try:
        return os.open(f"/proc/self/fd/{fd}", os.O_WRONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC)
    except OSError:
        return None


@contextlib.contextmanager
def patient_output() -> Iterator[None]:
    """Let ``sys.stdout`` and ``sys.stderr`` never wait in this block; at its end, report lines that were left out."""
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
                    err.write(f"{plural(out.left_out, 'line')} of output left out: no program read them\n")
            out.end()
        if err is not None:
            err.end()


def _patient(stream: TextIO) -> PatientStream | None:
    """Return a patient stream for a stream with a file; None for others (those of tests)."""
    try:
        stream.flush()
        return PatientStream(stream)
    except (OSError, ValueError) as error:
        if isinstance(error, OSError) and error.errno == errno.EPIPE:
            raise
        return None


_OWN = str(secrets.randbelow(9 * 10**14) + 10**14)
_SGR = re.compile(r"\x1b\[([0-9;]*)m")
_OWN_SGR = re.compile(rf"(\x1b\[{_OWN};[0-9;]*m)")
_KEPT = "\n\t"


def style(text: str, **how: Any) -> str:
    """Return a text with colours as of :func:`click.style`, for :func:`echo`."""
    return _SGR.sub(lambda found: f"\x1b[{_OWN};{found[1]}m", click.style(text, **how))


def shown(text: str) -> str:
    """Return a text for a terminal: with the colours of :func:`style`, without control characters of others."""
    parts = _OWN_SGR.split(text)
    parts[0::2] = [printable(part, _KEPT) for part in parts[0::2]]
    parts[1::2] = [part.replace(f"{_OWN};", "") for part in parts[1::2]]
    return "".join(parts)


def echo(text: str = "", *, nl: bool = True, err: bool = False) -> None:
    """Print a text, with colours only on a terminal."""
    click.echo(shown(text), nl=nl, err=err)


def overwrite(text: str, *, err: bool = False) -> None:
    """Replace the line on the terminal."""
    click.echo(f"\r{shown(text)}\x1b[K", nl=False, err=err, color=True)


def are_terminals(*streams: TextIO | None) -> bool:
    return all(stream is not None and stream.isatty() for stream in streams)


def has_keys() -> bool:
    """Return whether this program may read keys of a terminal: in its background, it would be stopped."""
    if sys.stdin is None or not sys.stdin.isatty():
        return False
    try:
        return os.tcgetpgrp(sys.stdin.fileno()) == os.getpgrp()
    except OSError:  # it is the terminal of no session, or of another
        return True


def enter_pressed() -> bool:
    """Return whether Enter was pressed at the terminal, and read the line."""
    if not has_keys() or not select.select([sys.stdin], [], [], 0)[0]:
        return False
    sys.stdin.readline()
    return True


def terminal_width() -> int | None:
    """Return the columns of the terminal on stdout; None without a terminal, where lines may have any length."""
    return shutil.get_terminal_size().columns if are_terminals(sys.stdout) else None


def redraw(lines: list[str]) -> None:
    """Replace the text on the terminal without flicker; lines that do not fit are cut."""
    height = shutil.get_terminal_size().lines - 1
    if len(lines) > height:
        lines = [*lines[: height - 1], f"... {len(lines) - height + 1} more lines; make the window higher"]
    if click.get_current_context().color is False:
        lines = [click.unstyle(line) for line in lines]
    text = "".join(f"{shown(line)}\x1b[K\n" for line in lines)
    click.echo(f"\x1b[H{text}\x1b[J", nl=False, color=True)


def print_json(data: object) -> None:
    """Print one object in one line at once. ``nan`` and ``inf`` become null."""
    click.echo(json_text(data))


def say(as_json: bool, data: object, text: str) -> None:
    if as_json:
        print_json(data)
    else:
        echo(text)


def json_text(data: object) -> str:
    """Return an object as JSON, in which characters that cannot be printed are escaped."""
    text = msgspec.json.encode(data).decode()
    if text.isprintable():
        return text
    return "".join(sign if sign.isprintable() else json.dumps(sign)[1:-1] for sign in text)


class Formatter(logging.Formatter):
    def format(self, record: logging.LogRecord) -> str:
        return shown(super().format(record))


class EndOfKeys(threading.Event):
    """Says whether the thread that reads keys shall end; while there are none, that thread sleeps in ``is_set``.

    Textual asks ten times a second, and after a key it may, for a while: an escape alone is a key, too.
    """

    def __init__(self, keys: int) -> None:
        super().__init__()
        self._bell, self._poll, self._looks = os.eventfd(0, os.EFD_NONBLOCK), select.poll(), 0
        weakref.finalize(self, os.close, self._bell)
        for descriptor in (keys, self._bell):
            self._poll.register(descriptor, select.POLLIN)

    def is_set(self) -> bool:
        if threading.current_thread() is not threading.main_thread() and not super().is_set():
            if not self._looks:
                self._poll.poll()
            self._looks = (self._looks or _LOOKS_FOR_KEYS) - 1
        return super().is_set()

    def set(self) -> None:
        super().set()
        os.eventfd_write(self._bell, 1)
