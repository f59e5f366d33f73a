"""Share what the services of contacts, motion and health have in common: a table of columns, a writer and a reader.

Each of them describes itself in static columns: its *source*. A reader knows the form of every column from the source,
and refuses a service of another form.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Generic, Self, TypedDict, TypeVar, Unpack, cast

import numpy as np
import numpy.typing as npt

from skinware._columns import texts
from skinware.errors import BadServiceFile
from skinware.memory import segments
from skinware.memory.namespace import Namespace
from skinware.memory.ring import Sample, SampleT
from skinware.sensor_types import SensorType
from skinware.service import Column, ServiceReader, ServiceWriter

SourceT = TypeVar("SourceT")
Layout = Mapping[str, tuple[str, tuple[int, ...]]]
"""Dtype and shape of each column."""
Texts = Mapping[str, tuple[str, str]]
"""Unit and description of each column."""
Static = Mapping[str, npt.NDArray[Any]]


class ServiceOptions(TypedDict, total=False):
    """Options of :class:`skinware.service.ServiceWriter` that every writer takes."""

    namespace: Namespace | str | None
    slots: int | None
    rate_hz: float | None
    group: str | None


@dataclass(frozen=True)
class ValueSource:
    """The values that a service is computed from.

    Attributes:
        driver: name of the driver of the values.
        type_name: sensor type of the values.
        unit: unit of values and loads.
        frames: names of the coordinate frames.
    """

    driver: str
    type_name: str
    unit: str
    frames: tuple[str, ...]


def value_static(driver: str, sensor_type: SensorType, frames: tuple[str, ...]) -> dict[str, npt.NDArray[Any]]:
    """Return the static columns of a :class:`ValueSource`."""
    return {
        "frame_name": np.array([name.encode() for name in frames], "S64"),
        "driver": np.array([driver.encode()], "S64"),
        "type_name": np.array([sensor_type.name.encode()], "S32"),
        "type_unit": np.array([sensor_type.unit.encode()], "S16"),
    }


def value_source(static: Static) -> dict[str, Any]:
    """Return the arguments of a :class:`ValueSource`."""
    return {
        "driver": texts(static["driver"])[0],
        "type_name": texts(static["type_name"])[0],
        "unit": texts(static["type_unit"])[0],
        "frames": tuple(texts(static["frame_name"])),
    }


def columns_of(layout: Layout, described: Texts, **units: str) -> dict[str, Column]:
    """Return the columns of a service; ``units`` are those that depend on the values."""
    return {
        name: Column(np.dtype(dtype), shape, units.get(name, described[name][0]), described[name][1])
        for name, (dtype, shape) in layout.items()
    }


class SourceWriter:
    """Publishes a service of one kind.

    Attributes:
        kind: kind of the service, and its default name.
    """

    kind: ClassVar[str]

    def __init__(
        self,
        name: str | None,
        columns: Mapping[str, Column],
        static: Static,
        description: str,
        **options: Unpack[ServiceOptions],
    ) -> None:
        self._service = ServiceWriter(
            name or self.kind, columns, static, kind=self.kind, description=description, **options
        )

    @property
    def name(self) -> str:
        """Name of the service."""
        return self._service.name

    def close(self) -> None:
        """Withdraw the service. Idempotent."""
        self._service.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class SourceSample(Sample, Generic[SourceT]):
    """A sample of a service that has a source."""

    __slots__ = ()

    @property
    def source(self) -> SourceT:
        """The source of the service."""
        return cast(SourceT, self.context)


class SourceReader(ServiceReader[SampleT], Generic[SourceT, SampleT]):
    """Reads a service of one kind, whose static columns describe its source.

    Args:
        name: of the service; default: that of its kind.
        namespace, timeout_s, announce: as for :class:`skinware.service.ServiceReader`, which also lists the errors.

    Attributes:
        kind: kind of the service.

    Raises:
        BadServiceFile: the service is of another kind, or its columns are others.
    """

    kind: ClassVar[str]

    def __init__(
        self,
        name: str | None = None,
        *,
        namespace: Namespace | str | None = None,
        timeout_s: float | None = 0.0,
        announce: bool = True,
    ) -> None:
        super().__init__(name or self.kind, namespace=namespace, timeout_s=timeout_s, announce=announce)

    @property
    def source(self) -> SourceT:
        """The source of the service."""
        return cast(SourceT, self._ring.context)

    def _describe(self, attached: segments.Segment) -> SourceT:
        if bytes(attached.header["kind"]) != self.kind.encode():
            raise BadServiceFile(f"service {self.name!r} is none of {self.kind}")
        columns = attached.schema.columns
        try:
            source = self._source_of(attached.static_columns())
            for name, (dtype, shape) in self._layout_of(source).items():
                if columns[name].dtype != np.dtype(dtype) or columns[name].shape != shape:
                    raise ValueError(f"column {name!r} is not {shape} of {dtype}")
        except (LookupError, ValueError, TypeError, AttributeError) as error:
            raise BadServiceFile(f"{attached.path}: {error}; not attached") from None
        return source

    @staticmethod
    @abstractmethod
    def _source_of(static: Static) -> SourceT:
        """Read the source from the static columns."""

    @staticmethod
    @abstractmethod
    def _layout_of(source: SourceT) -> Layout:
        """Return the dtype and shape of every column."""
