"""Keep one generation of a service and its recorded samples, as they stood in the service's file."""

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
"""Period of a service; see :func:`skinware.realtime.period_ns`."""
PER_SENSOR = ("values", "status")
"""Columns of a driver that have a number for each sensor."""


class Generation:
    """What the frames of a generation are made of; frames that were recorded carry it as their source.

    Args:
        head: the bytes of the service's file up to its slots.
        name: of the service.

    Attributes:
        head: the same bytes.
        name: of the service.
        coded: how the columns of its slots are coded.
        context: what its frames carry: the structure of a driver; None of other services.

    Raises:
        BadRecording: the head cannot be read, or asks for more than :data:`skinware.limits.LIMITS` allow.
    """

    def __init__(self, head: bytes, name: str) -> None:
        self.head, self.name = head, name
        if len(head) > LIMITS.head_size:
            raise BadRecording(f"service {name!r}: tables of {len(head)} bytes; at most {LIMITS.head_size} are read")
        try:
            self._segment = segments.recorded(head, f"service {name!r}")
            self.context: object = driver_service.structure_of(self._segment) if self.is_driver else None
        except BadServiceFile as error:
            raise BadRecording(str(error).removesuffix("; not attached")) from None
        if self.slot_stride > LIMITS.slot_size:
            raise BadRecording(
                f"service {name!r}: frames of {self.slot_stride} bytes; at most {LIMITS.slot_size} are read"
            )
        if self.period_ns and not _SHORTEST_NS <= self.period_ns <= LIMITS.time_ns:
            raise BadRecording(f"service {name!r}: a period of {self.period_ns} ns, which no writer has")
        self.coded: tuple[CodedColumn, ...] = tuple(CodedColumn.of(column) for column in self._segment.layout.slot)
        self._columns = self._segment.slot_formats()

    def only(self, positions: Index) -> Generation:
        """The same generation of a driver with some of its sensors.

        Args:
            positions: in a frame, of the sensors that stay.

        Raises:
            StructureError: there are none, or it is not a driver.
        """
        if not isinstance(self.context, Structure):
            raise StructureError(f"service {self.name!r} is not a driver: it has no sensors")
        structure = self.context.only(positions)
        columns = dict(self.schema.columns)
        for name in PER_SENSOR:
            columns[name] = replace(columns[name], shape=(structure.n_sensors,))
        return Generation(self.head_with(structure, Schema(columns, self.schema.description)), self.name)

    def head_with(self, structure: Structure, schema: Schema) -> bytes:
        """The head of the same generation of a driver with another structure.

        Args:
            structure: whose tables it has.
            schema: of its columns.
        """
        static = {name: table for name, table in self.static().items() if name not in (STATIC_NAME, *OF_GROUPS)}
        return segments.head_like(self._segment, schema, {**static, **structure.to_columns()})

    @property
    def generation(self) -> int:
        return self._segment.generation

    @property
    def kind(self) -> str:
        """What the service's columns mean: ``driver``, ``data``."""
        return bytes(self._segment.header["kind"]).decode()

    @property
    def is_driver(self) -> bool:
        return self.kind == driver_service.KIND

    @property
    def period_ns(self) -> int:
        """The writer's nominal period, 0 if it has none."""
        return int(self._segment.header["period_ns"])

    @property
    def digest(self) -> bytes:
        """Equal for generations whose columns and tables are equal."""
        return bytes(self._segment.header["digest"])

    @property
    def published_before(self) -> int:
        return self._segment.published_before

    @property
    def schema(self) -> Schema:
        """dtype, shape, unit and description of every column of a frame."""
        return self._segment.schema

    @property
    def slot_count(self) -> int:
        return self._segment.layout.slot_count

    @property
    def slot_stride(self) -> int:
        return self._segment.layout.slot_stride

    @property
    def ring_size(self) -> int:
        return self.slot_count * self.slot_stride

    @property
    def columns(self) -> dict[str, tuple[tuple[int, ...], np.dtype[Any], int]]:
        """(shape, dtype, offset in the slot) of every column, by name."""
        return self._columns

    def static(self) -> dict[str, npt.NDArray[Any]]:
        return self._segment.static_columns()


def disguised(head: bytes, name: str, disguise: Callable[[str], str]) -> bytes:
    """The head of the same generation of a driver with other names of its buses; that of any other as it is.

    Args:
        head: the bytes of the service's file up to its slots.
        name: of the service.
        disguise: gives the other names.

    Raises:
        BadRecording: the head cannot be read.
    """
    generation = Generation(head, name)
    if not isinstance(generation.context, Structure):
        return head
    structure = generation.context.replace(buses=[disguise(bus) for bus in generation.context.buses])
    return generation.head_with(structure, generation.schema)


class RecordedSample(Sample):
    """A recorded frame of a service. Its age is the one that it had when it was published."""

    __slots__ = ()

    @property
    def age_ns(self) -> int:
        """How old the newest data in it was when it was published, ns."""
        return self.published_ns - self.acquired_ns


class RecordedDriverSnapshot(RecordedSample, DriverSnapshot):
    """A recorded frame of a driver."""

    __slots__ = ()

    def fresh(
        self, type_name: str, *, max_age_s: float | None = None, at_ns: int | None = None
    ) -> npt.NDArray[np.bool_]:
        """As of a live frame, at the moment at which it was published."""
        return super().fresh(type_name, max_age_s=max_age_s, at_ns=self.published_ns if at_ns is None else at_ns)


@dataclass(frozen=True, eq=False)
class RecordedSnapshot(Snapshot):
    """The newest frame of every driver at one moment of a recording.

    Attributes:
        at_ns: the moment: when the newest of them was published, CLOCK_MONOTONIC of the machine that recorded.
        time_s: the same, s since the recording began.
    """

    at_ns: int
    time_s: float

    def fresh(
        self, type_name: str, *, max_age_s: float | None = None, at_ns: int | None = None
    ) -> npt.NDArray[np.bool_]:
        """As of a live snapshot, at its moment."""
        return super().fresh(type_name, max_age_s=max_age_s, at_ns=self.at_ns if at_ns is None else at_ns)


def frames_of(generation: Generation, run: Run) -> Iterator[RecordedSample]:
    """The frames of a run; they share one piece of memory."""
    for slot in run.decode_slots(generation.slot_stride):
        yield frame_of(generation, slot)


def frame_of(generation: Generation, slot: npt.NDArray[np.uint8]) -> RecordedSample:
    """The frame that stands in (stride,) bytes, as it was in the ring."""
    return (RecordedDriverSnapshot if generation.is_driver else RecordedSample)(generation, memoryview(slot.data))
