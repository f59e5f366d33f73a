"""The bytes of a service's file: header, column table, static columns, ring of slots.

Version 1.0, little-endian. The same major number means that a reader of this version can read the file. All of it
is public: docs/reference/shared-memory.md specifies it byte by byte, and what a later version may change.

=========  ====================================================================================
offset     what
=========  ====================================================================================
0          header (:data:`HEADER`, 512 bytes): written once, before the file becomes visible
512        control words (:data:`CONTROL`, 64 bytes): what the writer changes while it runs
576        statistics of the writer (:data:`STATISTICS`, 576 bytes), for people
1152       column table (:data:`COLUMN`, 64 bytes each)
...        static columns (the structure), each on a 64-byte boundary
slots      ``slot_count`` slots of ``slot_stride`` bytes: slot header (:data:`SLOT`), then columns
=========  ====================================================================================
"""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from skinware.errors import BadServiceFile, ConfigurationError, PlatformError

if sys.byteorder != "little":
    raise PlatformError("shared memory is little-endian; this machine is not supported")

MAGIC = b"SKINRING"
VERSION = (1, 0)
ALIGNMENT = 64
MIN_SLOTS, MAX_SLOTS, DEFAULT_SLOTS = 2, 64, 8
_KEPT_NS = 1_000_000_000
_KEPT_BYTES = 16 << 20
MAX_COLUMNS = 256
MAX_FILE_SIZE = 1 << 32
KIND_BYTES = 16


def _packed(itemsize: int, *fields: tuple[str, str, int]) -> np.dtype[np.void]:
    names, formats, offsets = zip(*fields, strict=True)
    return np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": itemsize})


HEADER = _packed(
    512,
    ("magic", "S8", 0),
    ("version_major", "<u4", 8),
    ("version_minor", "<u4", 12),
    ("file_size", "<u8", 16),
    ("generation", "<u8", 24),
    ("created_ns", "<i8", 32),
    ("column_count", "<u4", 40),
    ("slot_count", "<u4", 44),
    ("slot_offset", "<u8", 48),
    ("slot_stride", "<u8", 56),
    ("writer_pid", "<u8", 64),
    ("writer_start_ticks", "<u8", 72),
    ("pid_namespace", "<u8", 80),
    ("period_ns", "<i8", 88),
    ("kind", f"S{KIND_BYTES}", 96),
    ("name", "S48", 112),
    ("digest", "V32", 160),
    ("published_before", "<u8", 192),
)
"""``period_ns`` is the writer's nominal period, 0 if it has none; ``kind`` says what the columns mean;
``published_before`` how many samples the generations before this one published."""

CONTROL_OFFSET = 512
LATEST_OFFSET = CONTROL_OFFSET
WAKE_WORD_OFFSET = CONTROL_OFFSET + 8
STATE_OFFSET = CONTROL_OFFSET + 12
MISSED_PERIODS_OFFSET = CONTROL_OFFSET + 16
AHEAD_OFFSET = CONTROL_OFFSET + 24
CONTROL = _packed(
    64,
    ("latest", "<u8", 0),
    ("wake_word", "<u4", 8),
    ("state", "<u4", 12),
    ("missed_periods", "<u8", 16),
    ("ahead", "<u8", 24),
)
"""``latest``: newest sequence, 0 before the first. ``wake_word``: the futex. ``state``: see the constants. ``ahead``:
stamps that lay more than 0.2 s in the future."""

STATE_PAUSED = 1
"""The writer publishes nothing until it resumes."""
STATE_SUPERSEDED = 2
"""A newer generation of the service exists under the same name."""
STATE_CLOSED = 4
"""The writer closed it in good order."""

STATISTICS_OFFSET = CONTROL_OFFSET + CONTROL.itemsize
HISTOGRAM_BUCKETS = 32
STATISTICS = np.dtype(
    [
        ("timed", "<u8"),
        ("wall_best_ns", "<u8"),
        ("wall_worst_ns", "<u8"),
        ("wall_total_ns", "<u8"),
        ("cpu_best_ns", "<u8"),
        ("cpu_worst_ns", "<u8"),
        ("cpu_total_ns", "<u8"),
        ("before_boot", "<u8"),
        ("age", "<u8", (HISTOGRAM_BUCKETS,)),
        ("lateness", "<u8", (HISTOGRAM_BUCKETS,)),
    ]
)
"""Wall: time from ``begin`` to ``commit``; CPU: from publication to publication; how many stamps lay before boot; how
old the data was when published; how late periods began. Bucket k of a histogram counts values of 2**(k-1) to
2**k - 1 ns, the last one all above. Not covered by the slot protocol: a reader may see some of these words a sample
ahead of others."""

COLUMN_OFFSET = STATISTICS_OFFSET + STATISTICS.itemsize
COLUMN = _packed(
    64,
    ("name", "S24", 0),
    ("dtype", "S8", 24),
    ("count", "<u8", 32),
    ("offset", "<u8", 40),
    ("in_slot", "<u4", 48),
)
"""``offset`` counts from the start of the file for static columns, of the slot for the others."""

SLOT = _packed(
    64,
    ("sequence", "<u8", 0),
    ("acquired_ns", "<i8", 8),
    ("published_ns", "<i8", 16),
    ("flags", "<u8", 24),
)
"""``sequence`` is 0 while the slot is being filled."""


@dataclass(frozen=True, slots=True)
class ColumnPlace:
    """One named array: in every slot, or once per file."""

    name: str
    dtype: np.dtype[Any]
    count: int
    offset: int = 0


@dataclass(frozen=True)
class FileLayout:
    """Where everything lies in one file.

    Attributes:
        static: columns that are written once; ``offset`` from the start of the file.
        slot: columns of each slot; ``offset`` from the start of the slot.
        slot_count: slots in the ring.
        slot_offset: first slot, bytes from the start of the file.
        slot_stride: bytes from slot to slot.
        file_size: bytes.
    """

    static: tuple[ColumnPlace, ...]
    slot: tuple[ColumnPlace, ...]
    slot_count: int
    slot_offset: int
    slot_stride: int
    file_size: int

    def digest(self, static: Mapping[str, npt.NDArray[Any]]) -> bytes:
        """32 bytes that are equal for services whose columns and static contents are equal."""
        state = hashlib.blake2b(digest_size=32)
        for column in (*self.static, *self.slot):
            state.update(f"{column.name} {column.dtype.str} {column.count}\n".encode())
        for column in self.static:
            state.update(np.ascontiguousarray(static[column.name]).tobytes())
        return state.digest()


def aligned(offset: int, to: int = ALIGNMENT) -> int:
    return -(-offset // to) * to


def plan(
    static: Mapping[str, npt.NDArray[Any]],
    slot: Mapping[str, tuple[npt.DTypeLike, int]],
    slot_count: int | None = None,
    period_ns: int = 0,
) -> FileLayout:
    """Lay out a new file.

    Args:
        slot: (dtype, count) of the columns of a slot.
        slot_count: 2 to 64; None: as many as the period asks for.
        period_ns: the writer's nominal period. Slots then hold a second, but take at most 16 MiB; there are at least 8.
            0: it has none, and there are 8.
    """
    if slot_count is not None and not MIN_SLOTS <= slot_count <= MAX_SLOTS:
        raise ConfigurationError(f"slots={slot_count}: give {MIN_SLOTS} to {MAX_SLOTS}")
    if len(static) + len(slot) > MAX_COLUMNS:
        raise ConfigurationError(f"{len(static) + len(slot)} columns: at most {MAX_COLUMNS}")
    end = COLUMN_OFFSET + COLUMN.itemsize * (len(static) + len(slot))
    static_columns = []
    for name, array in static.items():
        if array.ndim != 1:
            raise ConfigurationError(f"table {name!r} has shape {array.shape}: give arrays of one dimension")
        offset = aligned(end)
        static_columns.append(_checked(ColumnPlace(name, array.dtype, len(array), offset)))
        end = offset + array.nbytes
    slot_columns = []
    slot_end = SLOT.itemsize
    for name, (dtype, count) in slot.items():
        column = _checked(ColumnPlace(name, np.dtype(dtype), count, aligned(slot_end)))
        slot_columns.append(column)
        slot_end = column.offset + column.dtype.itemsize * count
    slot_offset, slot_stride = aligned(end, 4096), aligned(slot_end)
    if slot_count is None:
        of_period = -(-_KEPT_NS // period_ns) if period_ns > 0 else DEFAULT_SLOTS
        slot_count = max(DEFAULT_SLOTS, min(MAX_SLOTS, of_period, _KEPT_BYTES // slot_stride))
    file_size = aligned(slot_offset + slot_stride * slot_count, 4096)
    if file_size > MAX_FILE_SIZE:
        raise ConfigurationError(f"the service would need {file_size} bytes of shared memory; the limit is 4 GiB")
    return FileLayout(tuple(static_columns), tuple(slot_columns), slot_count, slot_offset, slot_stride, file_size)


def _checked(column: ColumnPlace) -> ColumnPlace:
    name, code = column.name, column.dtype.str
    named = 0 < len(name) <= 24 and name.isascii() and name.isprintable()
    if not named or len(code) > 8 or column.dtype.kind not in "uifSV" or code[0] == ">":
        raise ConfigurationError(
            f"column {name!r} of {column.dtype}: give a name of 1 to 24 printable ASCII characters and little-endian"
            " integers, floats, fixed-length bytes or structures of them"
        )
    return column


def column_table(layout: FileLayout) -> npt.NDArray[np.void]:
    rows: Sequence[tuple[ColumnPlace, int]] = [(c, 0) for c in layout.static] + [(c, 1) for c in layout.slot]
    table = np.zeros(len(rows), COLUMN)
    for row, (column, in_slot) in zip(table, rows, strict=True):
        row["name"], row["dtype"] = column.name.encode(), column.dtype.str.encode()
        row["count"], row["offset"], row["in_slot"] = column.count, column.offset, in_slot
    return table


def parse(head: bytes, path: str, file_size: int) -> tuple[np.void, FileLayout]:
    """Check and read the header and the column table of a file that somebody else wrote.

    Args:
        head: at least the header and the column table: the first bytes of the file.

    Returns:
        The header row, and a layout in which every column lies inside the file.
    """

    def refuse(why: str) -> BadServiceFile:
        return BadServiceFile(f"{path}: {why}; not attached")

    if len(head) < COLUMN_OFFSET:
        raise refuse(f"only {file_size} bytes, shorter than a header")
    header = np.frombuffer(head, HEADER, 1)[0]
    if bytes(header["magic"]) != MAGIC:
        raise refuse("not a Skinware service file (wrong magic)")
    major, minor = int(header["version_major"]), int(header["version_minor"])
    if major != VERSION[0]:
        raise refuse(f"layout version {major}.{minor}, this program reads {VERSION[0]}.x")
    if int(header["file_size"]) != file_size or file_size > MAX_FILE_SIZE or file_size % 4096:
        raise refuse(f"truncated or absurd: the header says {header['file_size']} bytes, the file has {file_size}")
    try:
        bytes(header["kind"]).decode("ascii")
    except UnicodeDecodeError:
        raise refuse("a kind that is no text") from None
    slot_count = int(header["slot_count"])
    slot_offset, stride = int(header["slot_offset"]), int(header["slot_stride"])
    n_columns = int(header["column_count"])
    table_end = COLUMN_OFFSET + COLUMN.itemsize * n_columns
    if n_columns > MAX_COLUMNS or table_end > len(head):
        raise refuse(f"{n_columns} columns do not fit")
    if not MIN_SLOTS <= slot_count <= MAX_SLOTS or stride < SLOT.itemsize or stride % ALIGNMENT or slot_offset % 4096:
        raise refuse(f"{slot_count} slots of {stride} bytes at {slot_offset} make no ring")
    if slot_offset < table_end or slot_offset + slot_count * stride > file_size:
        raise refuse("the ring lies outside the file")
    static: list[ColumnPlace] = []
    slot: list[ColumnPlace] = []
    for row in np.frombuffer(head, COLUMN, n_columns, COLUMN_OFFSET):
        try:
            name, code = bytes(row["name"]).decode("ascii"), bytes(row["dtype"]).decode("ascii")
            dtype = np.dtype(code)
            if dtype.str != code:  # numpy reads more than we write: structures, arrays, objects, aliases
                raise ValueError(f"dtype {code!r}")
            column = _checked(ColumnPlace(name, dtype, int(row["count"]), int(row["offset"])))
        except (UnicodeDecodeError, TypeError, ValueError, SyntaxError) as error:
            raise refuse(f"a column that cannot be read ({error})") from None
        in_slot = bool(row["in_slot"])
        first, last = (SLOT.itemsize, stride) if in_slot else (table_end, slot_offset)
        if column.offset < first or column.offset % ALIGNMENT or column.count > file_size:
            raise refuse(f"column {name!r} begins at a wrong place")
        if column.offset + column.count * dtype.itemsize > last:
            raise refuse(f"column {name!r} lies outside its {'slot' if in_slot else 'table'}")
        (slot if in_slot else static).append(column)
    return header, FileLayout(tuple(static), tuple(slot), slot_count, slot_offset, stride, file_size)
