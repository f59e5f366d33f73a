"""Share what the services of contacts, motion and health have in common: a source, a writer and a reader.

A service describes itself by its *source*, which stands in its static columns and determines all others. A reader
refuses a service of another form.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, ClassVar, Generic, Self, TypedDict, TypeVar, Unpack, cast

import numpy as np
import numpy.typing as npt

from skinware._columns import texts
from skinware.errors import BadServiceFile
from skinware.memory import segments
from skinware.memory.namespace import Namespace
from skinware.memory.ring import Sample, SampleT
from skinware.service import Column, ServiceReader, ServiceWriter

SourceT = TypeVar("SourceT", bound="Source")


class ServiceOptions(TypedDict, total=False):
    """Options of :class:`skinware.service.ServiceWriter` that every writer takes."""

    namespace: Namespace | str | None
    slots: int | None
    rate_hz: float | None
    group: str | None


_STATIC = {
    "driver": ("driver", "S64"),
    "type_name": ("type_name", "S32"),
    "unit": ("type_unit", "S16"),
    "frames": ("frame_name", "S64"),
    "regions": ("region_name", "S"),
    "uid": ("sensor_uid", "<u8"),
    "type_id": ("sensor_type", "<u4"),
}
"""Static column and dtype of each attribute that a source may have."""
_LISTS = ("frames", "regions")


class Source(ABC):
    """The description of a service: a dataclass, with these attributes among others.

    Attributes:
        about: unit of each column of a sample, None for that of the values; and its meaning.
        driver: name of the driver of the values.
        unit: unit of the values.
    """

    about: ClassVar[Mapping[str, tuple[str | None, str]]]
    driver: str
    unit: str

    @classmethod
    def read(cls, static: Mapping[str, npt.NDArray[Any]]) -> Self:
        """Read it from static columns; raises LookupError, ValueError or TypeError if they are of another form."""
        found: dict[str, Any] = {}
        for field in fields(cast(Any, cls)):
            column, dtype = _STATIC[field.name]
            if dtype.startswith("S"):
                names = tuple(texts(static[column]))
                found[field.name] = names if field.name in _LISTS else names[0]
            else:
                found[field.name] = static[column].astype(dtype)
        return cls(**found)

    def static(self) -> dict[str, npt.NDArray[Any]]:
        """Return the static columns."""
        columns = {}
        for field in fields(cast(Any, self)):
            (column, dtype), value = _STATIC[field.name], getattr(self, field.name)
            if dtype.startswith("S"):
                value = [name.encode() for name in (value if field.name in _LISTS else [value])]
            columns[column] = np.array(value, dtype)
        return columns

    @abstractmethod
    def forms(self) -> Mapping[str, tuple[str, tuple[int, ...]]]:
        """Return dtype and shape of each column of a sample."""

    def columns(self) -> dict[str, Column]:
        """Return the columns of a sample."""
        columns = {}
        for name, (dtype, shape) in self.forms().items():
            unit, text = self.about[name]
            columns[name] = Column(np.dtype(dtype), shape, self.unit if unit is None else unit, text)
        return columns


@dataclass(frozen=True)
class ValueSource(Source):
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


class SourceWriter(Generic[SourceT]):
    """Publishes a service of one kind.

    Attributes:
        kind: kind of the service.
        source: the present source of the service.
    """

    kind: ClassVar[str]

    def __init__(self, source: SourceT, name: str, description: str, **options: Unpack[ServiceOptions]) -> None:
        self.source: SourceT = source
        self._service = ServiceWriter(
            name, source.columns(), source.static(), kind=self.kind, description=description, **options
        )

    @property
    def name(self) -> str:
        """Name of the service."""
        return self._service.name

    def _restructure(self, source: SourceT) -> None:
        self._service.restructure(source.columns(), source.static())
        self.source = source

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
    """Reads a service of one kind.

    Args:
        name: of the service; default: that of its kind.
        namespace, timeout_s, announce: as for :class:`skinware.service.ServiceReader`, which also lists the errors.

    Attributes:
        kind: kind of the service.
        source_class: class of its source.

    Raises:
        BadServiceFile: the service is of another kind, or its columns are others.
    """

    kind: ClassVar[str]
    source_class: ClassVar[type[Source]]

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

    def _describe(self, attached: segments.Segment) -> Source:
        if bytes(attached.header["kind"]) != self.kind.encode():
            raise BadServiceFile(f"service {self.name!r} is not of kind {self.kind!r}")
        found = attached.schema.columns
        try:
            source = self.source_class.read(attached.static_columns())
            for name, column in source.columns().items():
                if found[name].dtype != column.dtype or found[name].shape != column.shape:
                    raise ValueError(f"column {name!r} is not {column.shape} of {column.dtype}")
        except (LookupError, ValueError, TypeError, AttributeError) as error:
            raise BadServiceFile(f"{attached.path}: {error}; not attached") from None
        return source
