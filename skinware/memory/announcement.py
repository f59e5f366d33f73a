"""Readers make themselves known: a locked file each, which only its reader writes, and which is not mapped.

A file is the CRC-32 of what follows (8 hex digits), a space, one JSON object, spaces up to 2048 bytes. A file
whose lock is not held belongs to a dead reader; a program that looks and has the right removes it.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import zlib
from collections.abc import Iterator
from pathlib import Path

import msgspec

from skinware.memory.locks import Descriptor, is_locked, try_lock
from skinware.memory.namespace import Namespace
from skinware.memory.statistics import Histogram, Spread

MOST_ANNOUNCEMENTS = 1000
"""A look ends after so many that it cannot remove: those of living readers, and junk of others."""
_MOST_FILES = 10_000
"""A look removes fewer than these of dead readers."""
_SIZE = 2048
_READ_ATTEMPTS = 5


class ReaderRecord(msgspec.Struct):
    """The figures that a reader publishes.

    Attributes:
        pid: its process (as seen in its own pid namespace).
        kind: how it reads: ``asap``, ``in order``, ``periodic 30 Hz``, ``on demand``.
        missed: samples that were published since its first one and that it did not take.
        overruns: how often the writer was too fast for a copy.
        missed_periods: periods that passed unused (periodic readers).
        rate_hz: samples per second lately.
        age_ms: how old the newest data of a recent sample was when it was taken.
        wall: what its loop does with a sample, from having it to coming back.
        cpu: from one wait to the next, on a processor.
        age: how old the newest data was when a sample was taken.
        lateness: how late its periods began (periodic readers).
    """

    service: str
    pid: int
    program: str
    kind: str
    frames: int = 0
    missed: int = 0
    overruns: int = 0
    missed_periods: int = 0
    rate_hz: float = 0.0
    age_ms: float = 0.0
    wall: Spread = msgspec.field(default_factory=Spread)
    cpu: Spread = msgspec.field(default_factory=Spread)
    age: Histogram = msgspec.field(default_factory=Histogram)
    lateness: Histogram = msgspec.field(default_factory=Histogram)


class Announcement:
    """This reader's own file. A namespace that cannot be written is no obstacle to reading.

    The file is locked before it has a name: whoever sees it, sees it locked, or its reader is dead.
    """

    def __init__(self, namespace: Namespace, service: str) -> None:
        self._folder = namespace.readers_path
        self._path = self._folder / f"{service}.{os.getpid()}.{secrets.token_hex(4)}"
        self._descriptor: Descriptor | None = None
        self._make()

    def keep(self) -> None:
        """Make the file again if there was no place for it yet, or somebody removed it."""
        if self._descriptor is None or (self._descriptor.fd >= 0 and os.fstat(self._descriptor.fd).st_nlink == 0):
            self._make()

    def write(self, record: ReaderRecord) -> None:
        """Write the present figures, if there is a place for the file (``keep``)."""
        self.keep()
        if self._descriptor is None or self._descriptor.fd < 0:
            return
        text = msgspec.json.encode(record)[: _SIZE - 9].ljust(_SIZE - 9)
        with contextlib.suppress(OSError):  # /dev/shm is full
            os.pwrite(self._descriptor.fd, b"%08x " % zlib.crc32(text) + text, 0)

    def close(self) -> None:
        if self._descriptor is None or self._descriptor.fd < 0:
            return  # never made, closed, or a fork's: the file is the parent's
        with contextlib.suppress(OSError):
            self._path.unlink()
        self._descriptor.close()

    def __del__(self) -> None:
        self.close()  # a reader that is dropped leaves nothing

    def _make(self) -> None:
        with contextlib.suppress(OSError):
            descriptor = Descriptor(os.open(self._folder, os.O_TMPFILE | os.O_RDWR | os.O_CLOEXEC, 0o640))
            os.fchmod(descriptor.fd, 0o640)  # whatever the umask: the namespace's owner reads it
            try_lock(descriptor.fd)
            # a source folder, though not needed, makes this a linkat(2) that follows /proc's link to the open file
            os.link(f"/proc/self/fd/{descriptor.fd}", self._path, src_dir_fd=descriptor.fd, follow_symlinks=True)
            self._descriptor = descriptor


def living_readers(namespace: Namespace) -> Iterator[ReaderRecord]:
    """Yield the records of living readers, in order of service and pid; see :func:`sweep`."""
    for fd in _living(namespace):
        record = None
        with contextlib.suppress(OSError):  # whatever it is, a reader made no such file
            record = _read(fd)
        if record is not None:
            yield record


def is_wished(namespace: Namespace, what: str) -> bool:
    """Return whether a living program announces ``what`` in the place of a service's name: a wish to writers."""
    for path in namespace.reader_files(_MOST_FILES):
        if path.name.startswith(f"{what}."):
            with contextlib.suppress(OSError):
                fd = _open(path)
                try:
                    if is_locked(fd):
                        return True
                finally:
                    os.close(fd)
    return False


def sweep(namespace: Namespace) -> None:
    """Remove what dead readers left, as far as this user may, and not more than a look may take."""
    for _ in _living(namespace):
        pass


def _living(namespace: Namespace) -> Iterator[int]:
    """Open announcements of readers that are alive; those of dead ones are removed."""
    left = MOST_ANNOUNCEMENTS
    for path in namespace.reader_files(_MOST_FILES):
        if not left:
            break
        left -= 1
        with contextlib.suppress(OSError):
            fd = _open(path)
            try:
                if is_locked(fd):
                    yield fd
                else:
                    path.unlink()
                    left += 1
            finally:
                os.close(fd)


def _open(path: Path) -> int:
    """Return a descriptor of a file that anybody may have put there, and that need be none."""
    return os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)


def _read(fd: int) -> ReaderRecord | None:
    for _ in range(_READ_ATTEMPTS):  # its owner may be writing this very moment
        data = os.pread(fd, _SIZE, 0)
        if data[:8] == b"%08x" % zlib.crc32(data[9:]):
            try:
                record = msgspec.json.decode(data[9:], type=ReaderRecord)
            except (msgspec.MsgspecError, ValueError, RecursionError):
                return None
            for name in ("service", "program", "kind"):  # texts of others, for terminals
                text: str = getattr(record, name)
                if not text.isprintable():
                    setattr(record, name, ascii(text)[1:-1])
            return record
    return None
