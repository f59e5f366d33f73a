"""The ring in shared memory: its words and slots, and the samples that readers take from it.

One writer fills the slots and never waits; readers cannot disturb it. ``skinware.h`` and ``native/ring.h`` have the
protocol, docs/reference/shared-memory.md explains it.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import numpy.typing as npt

from skinware.memory import file_layout
from skinware.memory.futex import fence
from skinware.memory.segments import Segment
from skinware.realtime import now_ns

COPY_ATTEMPTS = 64
"""How often a reader tries again while the writer overwrites what it copies."""
LATEST = file_layout.LATEST_OFFSET // 8
MISSED_PERIODS = file_layout.MISSED_PERIODS_OFFSET // 8
AHEAD = file_layout.AHEAD_OFFSET // 8
WAKE_WORD = file_layout.WAKE_WORD_OFFSET // 4
STATE = file_layout.STATE_OFFSET // 4
SEQUENCE, ACQUIRED, PUBLISHED, FLAGS = range(4)  # 8-byte words of a slot's header
_HEADER_WORDS = file_layout.SLOT.itemsize // 8


class FrameSource(Protocol):
    """The generation of a sample: one that is read live, or one that was recorded.

    Attributes:
        columns: (shape, dtype, offset in the slot) of every column, by name.
        period_ns: the writer's nominal period, 0 if it has none.
    """

    context: object
    columns: dict[str, tuple[tuple[int, ...], np.dtype[Any], int]]
    generation: int
    period_ns: int


class Sample:
    """One published sample: a private copy, or (from ``view``) the ring's own memory.

    Copies that were made in one look share a piece of memory, which lives as long as any of them or of their arrays.

    Attributes:
        generation: which incarnation of the service it belongs to.
        period_ns: the writer's nominal period, 0 if it has none.
        stale: the writer was dead when the sample was taken: this is its last word.
        context: what the reader knows of the service (for a driver: its structure).
    """

    __slots__ = ("_columns", "_data", "_header", "_in_ring", "_start", "context", "generation", "period_ns", "stale")

    def __init__(
        self,
        source: FrameSource,
        data: bytearray | memoryview,
        start: int = 0,
        in_ring: memoryview | None = None,
        header: memoryview | None = None,
    ) -> None:
        self._data = data
        self._start = start
        self._in_ring = in_ring
        self._header: Sequence[int]
        if in_ring is not None:
            self._header = in_ring.tolist()
        else:
            self._header = memoryview(data)[start:].cast("Q") if header is None else header
        self._columns = source.columns
        self.context: object = source.context
        self.generation: int = source.generation
        self.period_ns: int = source.period_ns
        self.stale: bool = False

    @property
    def sequence(self) -> int:
        """1, 2, 3 ... within the generation."""
        return self._header[SEQUENCE]

    @property
    def acquired_ns(self) -> int:
        """Newest time stamp of the data in it, CLOCK_MONOTONIC ns."""
        return self._header[ACQUIRED]

    @property
    def published_ns(self) -> int:
        """When the writer handed it out, CLOCK_MONOTONIC ns."""
        return self._header[PUBLISHED]

    @property
    def flags(self) -> int:
        """Bits for the service's own use."""
        return self._header[FLAGS]

    @property
    def position(self) -> tuple[int, int]:
        """Generation and sequence, as ``newer_than`` takes them."""
        return self.generation, self.sequence

    @property
    def age_ns(self) -> int:
        """How old the newest data in it is now, ns."""
        return now_ns() - self.acquired_ns

    @property
    def valid(self) -> bool:
        """Whether the writer has left the memory alone so far; always True for a copy."""
        if self._in_ring is None:
            return True
        fence()
        return bool(self._in_ring[SEQUENCE] == self.sequence)

    @property
    def slot(self) -> memoryview:
        """Its bytes as they stand in the ring: the slot's header and its columns."""
        return memoryview(self._data)[self._start :]

    def column(self, name: str) -> npt.NDArray[Any]:
        """One column of the sample, a view of its memory.

        Raises:
            KeyError: no column of that name.
        """
        try:
            shape, dtype, offset = self._columns[name]
        except KeyError:
            raise KeyError(f"no column {name!r}; there are {', '.join(self._columns)}") from None
        return np.ndarray(shape, dtype, self._data, self._start + offset)

    def __repr__(self) -> str:
        age_ms = self.age_ns / 1e6
        return f"<{type(self).__name__} {self.sequence} of generation {self.generation}, {age_ms:.1f} ms old>"


if TYPE_CHECKING:
    from typing_extensions import TypeVar

    SampleT = TypeVar("SampleT", bound=Sample, default=Sample)  # so that a reader of plain samples needs no annotation
else:
    from typing import TypeVar

    SampleT = TypeVar("SampleT", bound=Sample)


class RingWords(ctypes.Structure):
    """``skinware__ring`` of skinware.h, with which the structures of readers and writers begin."""

    _fields_ = [
        ("map", ctypes.c_void_p),
        ("slot_offset", ctypes.c_uint64),
        ("slot_stride", ctypes.c_uint64),
        ("slot_count", ctypes.c_uint64),
    ]

    @classmethod
    def of(cls, segment: Segment) -> RingWords:
        layout = segment.layout
        return cls(segment.data.ctypes.data, layout.slot_offset, layout.slot_stride, layout.slot_count)


def slots_of(segment: Segment) -> list[memoryview]:
    """Return the bytes of every slot, its header and its columns, in place."""
    layout = segment.layout
    starts = range(layout.slot_offset, layout.slot_offset + layout.slot_count * layout.slot_stride, layout.slot_stride)
    return [segment.data.data[start : start + layout.slot_stride] for start in starts]


def slot_headers_of(segment: Segment) -> list[memoryview]:
    """Return the 8-byte words of every slot's header, in place."""
    return [slot.cast("Q")[:_HEADER_WORDS] for slot in slots_of(segment)]
