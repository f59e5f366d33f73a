"""One generation of a service as a file: created whole, made visible by rename, never truncated."""

from __future__ import annotations

import mmap
import os
import secrets
import stat
import time
from collections.abc import Mapping
from dataclasses import dataclass
from errno import EMFILE, ENFILE, ENOMEM
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from skinware.errors import BadServiceFile, ConfigurationError, NamespaceError, ServiceNotFound
from skinware.memory import file_layout, futex
from skinware.memory.file_layout import FileLayout
from skinware.memory.futex import fence
from skinware.memory.locks import Descriptor, Process, ProcessWatch, has_ended, is_locked, this_process, try_lock
from skinware.memory.namespace import Namespace
from skinware.memory.schema import STATIC_NAME, Schema, from_file
from skinware.text import nearest_name

OPEN_FLAGS = os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK  # a FIFO in our place must not block us
_HEAD_LEAST = file_layout.COLUMN_OFFSET
_HEAD_BYTES = file_layout.COLUMN_OFFSET + file_layout.COLUMN.itemsize * file_layout.MAX_COLUMNS


@dataclass
class Segment:
    """A mapped generation. Arrays keep the map alive; it is never unmapped under them.

    Attributes:
        header: header row (:data:`file_layout.HEADER`).
        data: (file_size,) uint8, the whole map; read-only for readers.
        descriptor: the open file: the writer's holds the lock, the reader's queries it.
        maker: answers a reader whether the process that made it has ended.
        inode: (device, inode), another for each generation of a name.
        schema: what the columns of the slots look like to users.
    """

    path: str
    header: np.void
    layout: FileLayout
    data: npt.NDArray[np.uint8]
    descriptor: Descriptor
    inode: tuple[int, int]
    schema: Schema
    maker: ProcessWatch

    @property
    def generation(self) -> int:
        return int(self.header["generation"])

    @property
    def published_before(self) -> int:
        return int(self.header["published_before"])

    @property
    def published(self) -> int:
        return self.published_before + int(self.view(file_layout.LATEST_OFFSET, np.dtype("<u8"), 1)[0])

    @property
    def head(self) -> bytes:
        """The file up to its slots: header, control words, statistics, column table and static columns."""
        return self.data[: self.layout.slot_offset].tobytes()

    def slot_formats(self) -> dict[str, tuple[tuple[int, ...], np.dtype[Any], int]]:
        columns = self.schema.columns
        return {c.name: (columns[c.name].shape, columns[c.name].dtype, c.offset) for c in self.layout.slot}

    def static_columns(self) -> dict[str, npt.NDArray[Any]]:
        tables = self.schema.tables
        return {c.name: self.view(c.offset, tables.get(c.name, c.dtype), c.count) for c in self.layout.static}

    def view(self, offset: int, dtype: np.dtype[Any], count: int) -> npt.NDArray[Any]:
        return self.data[offset : offset + dtype.itemsize * count].view(dtype)

    def writer_lives(self) -> bool:
        """Return whether the lock of this generation is held, and the process that made it has not ended.

        Both are needed: a child that C forked keeps the lock of a dead parent, and a pid says nothing in another pid
        namespace.
        """
        return self.descriptor.is_locked() and not self.maker.has_ended()

    def close(self) -> None:
        """Close its descriptors, and let go of its lock; the map stays as long as its arrays. Idempotent."""
        self.descriptor.close()
        self.maker.close()

    def mark(self, state: int) -> None:
        """Set bits of the state word and wake everybody who waits (needs a writable map)."""
        control = self.view(file_layout.CONTROL_OFFSET, file_layout.CONTROL, 1)
        control["state"] |= state
        fence()
        control["wake_word"] += np.uint32(1)
        futex.Word(self.data, file_layout.WAKE_WORD_OFFSET).wake_all()


def create(
    namespace: Namespace,
    name: str,
    schema: Schema,
    static: Mapping[str, npt.NDArray[Any]],
    *,
    slots: int | None,
    kind: str,
    period_ns: int,
    published_before: int,
) -> Segment:
    """Make a new generation, which stays invisible until it is published. The caller owns the name."""
    if STATIC_NAME in static:
        raise ConfigurationError(f"the table name {STATIC_NAME!r} is taken: give yours another name")
    if len(kind.encode()) > file_layout.KIND_BYTES:
        raise ConfigurationError(f"kind {kind!r}: at most {file_layout.KIND_BYTES} bytes")
    static = {**static, **schema.for_file(static)}
    layout = file_layout.plan(static, schema.for_layout(), slots, period_ns)
    temporary = namespace.path / f".{name}.{secrets.token_hex(4)}.tmp"
    header = _header(name, layout, layout.digest(static), kind, period_ns, published_before)
    try:
        fd = os.open(temporary, OPEN_FLAGS | os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o600)
        descriptor = Descriptor(fd)
        try:
            if not try_lock(fd):
                raise NamespaceError(f"somebody locked {temporary} as it was made")
            os.posix_fallocate(fd, 0, layout.file_size)
            data = _map(temporary, layout.file_size)
            _write_head(data, header, layout, static)
            os.fchmod(fd, 0o640)
        except BaseException:
            os.unlink(temporary)
            descriptor.close()
            raise
    except OSError as error:
        where = namespace.ring_path(name)
        raise NamespaceError(f"cannot make {where} ({layout.file_size} bytes): {error.strerror}") from None
    return Segment(str(temporary), header[0], layout, data, descriptor, inode_of(fd), schema, ProcessWatch(None))


def _write_head(
    data: npt.NDArray[np.uint8],
    header: npt.NDArray[np.void],
    layout: FileLayout,
    static: Mapping[str, npt.NDArray[Any]],
) -> None:
    """Write what is before the slots, but for what changes while a writer runs."""
    table = file_layout.column_table(layout)
    data[: header.nbytes] = header.view(np.uint8)
    data[file_layout.COLUMN_OFFSET : file_layout.COLUMN_OFFSET + table.nbytes] = table.view(np.uint8)
    for column in layout.static:
        contents = np.ascontiguousarray(static[column.name]).view(np.uint8)
        data[column.offset : column.offset + contents.nbytes] = contents


def publish(segment: Segment, namespace: Namespace, name: str) -> None:
    """Put a generation that was created in the place of the one before, or raise and change nothing."""
    final = namespace.ring_path(name)
    try:
        os.rename(segment.path, final)
    except OSError as error:
        raise NamespaceError(f"cannot make {final}: {error.strerror}") from None
    segment.path = str(final)


def _map(path: Path, size: int) -> npt.NDArray[np.uint8]:
    """Return a writable map through an open file of its own.

    ``mmap`` keeps a duplicate of its descriptor; of the locked one, that would hold the lock for as long as any
    array lives, and in forked children too.
    """
    fd = os.open(path, OPEN_FLAGS | os.O_RDWR)
    try:
        return np.frombuffer(mmap.mmap(fd, size), np.uint8)
    finally:
        os.close(fd)


def attach(namespace: Namespace, name: str, *, writable: bool = False) -> Segment:
    """Map the present generation of a service after checking everything that is mapped."""
    if not namespace.exists():
        raise ServiceNotFound(_not_found(namespace, name))
    owner = namespace.check()
    path = namespace.ring_path(name)
    try:
        fd = os.open(path, OPEN_FLAGS | (os.O_RDWR if writable else os.O_RDONLY))
    except FileNotFoundError:
        raise ServiceNotFound(_not_found(namespace, name)) from None
    except OSError as error:
        raise _cannot(path, "opened", error) from None
    descriptor = Descriptor(fd)
    try:
        info = os.fstat(fd)
        if not stat.S_ISREG(info.st_mode):
            raise BadServiceFile(f"{path}: not a regular file; not attached")
        if info.st_uid != owner:
            raise BadServiceFile(f"{path}: owned by uid {info.st_uid}, its namespace by uid {owner}; not attached")
        header, layout = file_layout.parse(os.pread(fd, _HEAD_BYTES, 0), str(path), info.st_size)
        protection = mmap.PROT_READ | (mmap.PROT_WRITE if writable else 0)
        try:
            data = np.frombuffer(mmap.mmap(fd, info.st_size, prot=protection), np.uint8)
        except OSError as error:
            raise _cannot(path, "mapped", error) from None
        segment = Segment(
            str(path), header, layout, data, descriptor, inode_of(fd), Schema(), ProcessWatch(_maker(header))
        )
        segment.schema = from_file(layout, segment.static_columns(), str(path))
    except BaseException:
        descriptor.close()
        raise
    return segment


def _cannot(path: Path, what: str, error: OSError) -> BadServiceFile | NamespaceError:
    """Return the error for a file that cannot be opened or mapped: its own fault, or a limit of this program."""
    if error.errno in (EMFILE, ENFILE):
        return NamespaceError(f"{path} cannot be {what}: no more file descriptors (raise the limit, ulimit -n)")
    if error.errno == ENOMEM:
        return NamespaceError(f"{path} cannot be {what}: no memory or address space left (ulimit -v)")
    return BadServiceFile(f"{path}: cannot be {what} ({error.strerror}); not attached")


def recorded(head: bytes, name: str) -> Segment:
    """Return a generation of which only the head is there (:attr:`Segment.head`): all but its slots and its writer."""
    size = int(np.frombuffer(head, file_layout.HEADER, 1)["file_size"][0]) if len(head) >= _HEAD_LEAST else len(head)
    header, layout = file_layout.parse(head, name, size)
    if layout.slot_offset != len(head):
        raise BadServiceFile(f"{name}: a head of {len(head)} bytes, not of {layout.slot_offset}")
    data = np.frombuffer(head, np.uint8)
    segment = Segment(name, header, layout, data, Descriptor(-1), (0, 0), Schema(), ProcessWatch(None))
    segment.schema = from_file(layout, segment.static_columns(), name)
    return segment


def head_like(segment: Segment, schema: Schema, static: Mapping[str, npt.NDArray[Any]]) -> bytes:
    """Return the head of the same generation with other columns and tables, as :func:`recorded` reads it."""
    static = {**static, **schema.for_file(static)}
    layout = file_layout.plan(static, schema.for_layout(), segment.layout.slot_count)
    header = np.array([segment.header], file_layout.HEADER)
    header["file_size"], header["column_count"] = layout.file_size, len(layout.static) + len(layout.slot)
    header["slot_offset"], header["slot_stride"] = layout.slot_offset, layout.slot_stride
    header["digest"] = np.frombuffer(layout.digest(static), "V32")
    data = np.zeros(layout.slot_offset, np.uint8)
    changing = slice(file_layout.CONTROL_OFFSET, file_layout.COLUMN_OFFSET)
    data[changing] = segment.data[changing]
    _write_head(data, header, layout, static)
    return data.tobytes()


def head_of(name: str, schema: Schema, static: Mapping[str, npt.NDArray[Any]], *, kind: str, period_ns: int) -> bytes:
    """Return the head of a generation that no writer made, as :func:`recorded` reads it.

    Raises:
        ConfigurationError: the format cannot hold these columns and tables.
    """
    static = {**static, **schema.for_file(static)}
    layout = file_layout.plan(static, schema.for_layout(), None, period_ns)
    data = np.zeros(layout.slot_offset, np.uint8)
    _write_head(data, _header(name, layout, layout.digest(static), kind, period_ns, 0), layout, static)
    return data.tobytes()


def current_inode(path: str | os.PathLike[str]) -> tuple[int, int] | None:
    """(device, inode) of the present file of a service, which has that path; None if there is none."""
    try:
        info = os.lstat(path)
    except OSError:
        return None
    return info.st_dev, info.st_ino


def inode_of(fd: int) -> tuple[int, int]:
    info = os.fstat(fd)
    return info.st_dev, info.st_ino


def _maker(header: np.void) -> Process:
    return Process(int(header["writer_pid"]), int(header["writer_start_ticks"]), int(header["pid_namespace"]))


def living_inode(namespace: Namespace, name: str) -> tuple[int, int] | None:
    """(device, inode) of a service's present file if its writer lives and has published; maps and checks nothing."""
    try:
        fd = os.open(namespace.ring_path(name), OPEN_FLAGS | os.O_RDONLY)
    except OSError:
        return None
    try:
        head = os.pread(fd, file_layout.LATEST_OFFSET + 8, 0)
        if not any(head[file_layout.LATEST_OFFSET :]) or not is_locked(fd):
            return None
        return None if has_ended(_maker(np.frombuffer(head, file_layout.HEADER, 1)[0])) else inode_of(fd)
    except OSError:
        return None
    finally:
        os.close(fd)


def _not_found(namespace: Namespace, name: str) -> str:
    start = "skin-calm" if namespace.name.endswith("calm") else "a driver (skin-driver --bus ...)"
    there_are = nearest_name(name, others) if (others := namespace.services()) else f", nor another; start {start}"
    return f"no service {name!r} in namespace {namespace.name!r}{there_are}"


def _header(
    name: str, layout: FileLayout, digest: bytes, kind: str, period_ns: int, published_before: int
) -> npt.NDArray[np.void]:
    header = np.zeros(1, file_layout.HEADER)
    header["magic"] = file_layout.MAGIC
    header["version_major"], header["version_minor"] = file_layout.VERSION
    header["file_size"] = layout.file_size
    header["generation"] = header["created_ns"] = time.monotonic_ns()
    header["column_count"] = len(layout.static) + len(layout.slot)
    header["slot_count"], header["slot_offset"] = layout.slot_count, layout.slot_offset
    header["slot_stride"] = layout.slot_stride
    header["writer_pid"], header["writer_start_ticks"], header["pid_namespace"] = this_process()
    header["period_ns"] = period_ns
    header["kind"], header["name"] = kind.encode(), name.encode()
    header["digest"] = np.frombuffer(digest, "V32")
    header["published_before"] = published_before
    return header
