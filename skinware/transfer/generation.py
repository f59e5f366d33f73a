"""Generations of services and their frames, read from bytes instead of a ring."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from skinware import driver_service
from skinware._columns import Index
from skinware.driver_snapshot import DriverSnapshot
from skinware.errors import BadRecording, BadServiceFile, StructureError
from skinware.limits import LIMITS
from skinware.memory import segments
from skinware.memory.ring import Sample
from skinware.memory.schema import STATIC_NAME, Schema
from skinware.snapshot import Snapshot
from skinware.structure import OF_GROUPS, Structure
from skinware.transfer.codec import CodedColumn, Run

_SHORTEST_NS = 10_000
"""The shortest period of a writer; see :func:`skinware.realtime.period_ns`."""
PER_SENSOR = ("values", "status")
"""Columns of a driver with one number for each sensor."""


class Generation:
    """A generation of a service, read from the service's file; recorded frames have it as their source.

    Args:
        head: the bytes of the file up to its slots.

    Attributes:
        kind: of the service: ``driver``, ``data``.
        context: the structure of a driver; None for other services.
        period_ns: the writer's nominal period, 0 if it has none.
        slot_count, slot_stride: number of slots, and bytes of each.
        columns: (shape, dtype, offset in the slot) of every column, by name.

    Raises:
        BadRecording: the head cannot be read, or asks for more than :data:`skinware.limits.LIMITS` allow.
    """

    def __init__(self, head: bytes, name: str) -> None:
        self.head, self.name = head, name
        if len(head) > LIMITS.head_size:
            raise BadRecording(f"service {name!r}: tables of {len(head)} bytes; at most {LIMITS.head_size} are read")
        try:
            self._segment = segments.recorded(head, f"service {name!r}")
            header, layout = self._segment.header, self._segment.layout
            self.kind: str = bytes(header["kind"]).decode()
            self.is_driver: bool = self.kind == driver_service.KIND
            self.context: object = driver_service.structure_of(self._segment) if self.is_driver else None
        except BadServiceFile as error:
            raise BadRecording(str(error).removesuffix("; not attached")) from None
        self.generation: int = self._segment.generation
        self.period_ns: int = int(header["period_ns"])
        self.published_before: int = self._segment.published_before
        self.slot_count: int = layout.slot_count
        self.slot_stride: int = layout.slot_stride
        if self.slot_stride > LIMITS.slot_size:
            raise BadRecording(
                f"service {name!r}: frames of {self.slot_stride} bytes; at most {LIMITS.slot_size} are read"
            )
        if self.period_ns and not _SHORTEST_NS <= self.period_ns <= LIMITS.time_ns:
            raise BadRecording(f"service {name!r}: a period of {self.period_ns} ns, which no writer has")
        self.coded: tuple[CodedColumn, ...] = tuple(CodedColumn.of(column) for column in layout.slot)
        self.columns: dict[str, tuple[tuple[int, ...], np.dtype[Any], int]] = self._segment.slot_formats()

    @property
    def structure(self) -> Structure | None:
        """The structure of a driver; None for other services."""
        return self.context if isinstance(self.context, Structure) else None

    @property
    def ring_size(self) -> int:
        """Bytes of all slots."""
        return self.slot_count * self.slot_stride

    @property
    def digest(self) -> bytes:
        """Equal for generations with equal columns and tables."""
        return bytes(self._segment.header["digest"])

    @property
    def schema(self) -> Schema:
        """dtype, shape, unit and description of every column of a frame."""
        return self._segment.schema

    def static(self) -> dict[str, npt.NDArray[Any]]:
        return self._segment.static_columns()

    def only(self, positions: Index) -> Generation:
        """Return the same generation of a driver with some of its sensors; refuse other services."""
        if self.structure is None:
            raise StructureError(f"service {self.name!r} is not a driver: it has no sensors")
        structure = self.structure.only(positions)
        columns = dict(self.schema.columns)
        for name in PER_SENSOR:
            columns[name] = replace(columns[name], shape=(structure.n_sensors,))
        return Generation(self.head_with(structure, Schema(columns, self.schema.description)), self.name)

    def head_with(self, structure: Structure, schema: Schema) -> bytes:
        """Return the head of the same generation with other tables and columns."""
        static = {name: table for name, table in self.static().items() if name not in (STATIC_NAME, *OF_GROUPS)}
        return segments.head_like(self._segment, schema, {**static, **structure.to_columns()})


def disguised(head: bytes, name: str, disguise: Callable[[str], str]) -> bytes:
    """Return the head of a driver's generation with other names of its buses; that of another service as it is."""
    generation = Generation(head, name)
    structure = generation.structure
    if structure is None:
        return head
    other = structure.replace(buses=[disguise(bus) for bus in structure.buses])
    return generation.head_with(other, generation.schema)


class RecordedSample(Sample):
    """A recorded frame of a service. Its age is the age that it had when it was published."""

    __slots__ = ()

    @property
    def age_ns(self) -> int:
        """Age of the newest data in it at its publication, ns."""
        return self.published_ns - self.acquired_ns


class RecordedDriverSnapshot(RecordedSample, DriverSnapshot):
    """A recorded frame of a driver."""

    __slots__ = ()

    def fresh(
        self, type_name: str, *, max_age_s: float | None = None, at_ns: int | None = None
    ) -> npt.NDArray[np.bool_]:
        """Return the same as for a live frame, by default at the moment of its publication."""
        return super().fresh(type_name, max_age_s=max_age_s, at_ns=self.published_ns if at_ns is None else at_ns)


@dataclass(frozen=True, eq=False)
class RecordedSnapshot(Snapshot):
    """The newest frame of every driver at one moment of a recording.

    Attributes:
        at_ns: publication of the newest of them, CLOCK_MONOTONIC of the machine that recorded.
        time_s: the same, s since the recording began.
    """

    at_ns: int
    time_s: float

    def fresh(
        self, type_name: str, *, max_age_s: float | None = None, at_ns: int | None = None
    ) -> npt.NDArray[np.bool_]:
        """Return the same as for a live snapshot, by default at its moment."""
        return super().fresh(type_name, max_age_s=max_age_s, at_ns=self.at_ns if at_ns is None else at_ns)


def frames_of(generation: Generation, run: Run) -> Iterator[RecordedSample]:
    """Yield the frames of a run; they share one piece of memory."""
    for slot in run.decode_slots(generation.slot_stride):
        yield frame_of(generation, slot)


def frame_of(generation: Generation, slot: npt.NDArray[np.uint8]) -> RecordedSample:
    """Return the frame in a slot, (stride,) bytes of the ring."""
    return (RecordedDriverSnapshot if generation.is_driver else RecordedSample)(generation, memoryview(slot.data))
