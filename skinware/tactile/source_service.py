"""Share what the services of contacts, motion and health have in common: a source, a writer and a reader.

A service describes itself by its *source*, which stands in its static columns and determines all others. A reader
refuses a service of another form.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, TypedDict, Unpack, cast

import numpy as np
import numpy.typing as npt

from skinware._columns import texts
from skinware.errors import BadServiceFile
from skinware.memory import segments
from skinware.memory.namespace import Namespace
from skinware.memory.ring import Sample, SampleT
from skinware.service import Column, ServiceReader, ServiceWriter
from skinware.tactile.arrays import Arrays, Columns


class ServiceOptions(TypedDict, total=False):
    """Options of every writer, as of :class:`skinware.service.ServiceWriter`."""

    namespace: Namespace | str | None
    slots: int | None
    rate_hz: float | None
    group: str | None


_STATIC = {  # static column and dtype of each attribute of a source
    "driver": ("driver", "S64"),
    "type_name": ("type_name", "S32"),
    "unit": ("type_unit", "S16"),
    "frames": ("frame_name", "S64"),
    "regions": ("region_name", "S"),
    "uid": ("sensor_uid", "<u8"),
    "type_id": ("sensor_type", "<u4"),
}
_LISTS = ("frames", "regions")


@dataclass(frozen=True, eq=False)
class Source:
    """The values that a service is computed from; each kind of service has some of these attributes.

    Attributes:
        driver: name of the driver of the values.
        type_name: sensor type of the values.
        unit: unit of values and loads.
        frames: names of the coordinate frames.
        regions: names of the regions.
        uid: (n,) uint64, of the n sensors, in the order of the values.
        type_id: (n,) uint32, of their types.
    """

    driver: str
    type_name: str = ""
    unit: str = ""
    frames: tuple[str, ...] = ()
    regions: tuple[str, ...] = ()
    uid: npt.NDArray[np.uint64] = field(default_factory=lambda: np.zeros(0, np.uint64))
    type_id: npt.NDArray[np.uint32] = field(default_factory=lambda: np.zeros(0, np.uint32))


@dataclass(frozen=True)
class ServiceForm:
    """The form of one kind of service: its usual name, the attributes that its source has, and its columns by that."""

    kind: str
    attributes: tuple[str, ...]
    columns_of: Callable[[Source], Columns]

    def read(self, static: Mapping[str, npt.NDArray[Any]]) -> Source:
        """Return the source in static columns; raises LookupError, ValueError or TypeError at another form."""
        found: dict[str, Any] = {}
        for name in self.attributes:
            column, dtype = _STATIC[name]
            if dtype.startswith("S"):
                names = tuple(texts(static[column]))
                found[name] = names if name in _LISTS else names[0]
            else:
                found[name] = static[column].astype(dtype)
        source = Source(**found)
        if "type_id" in found and source.uid.shape != source.type_id.shape:
            raise ValueError(f"{len(source.uid)} uids of {len(source.type_id)} types")
        return source

    def columns(self, source: Source) -> tuple[dict[str, Column], Arrays]:
        """Return the columns of a sample, and the static columns."""
        columns, static = {}, {}
        for name, (dtype, shape, unit, text) in self.columns_of(source).items():
            columns[name] = Column(np.dtype(dtype), shape, source.unit if unit is None else unit, text)
        for name in self.attributes:
            (column, dtype), value = _STATIC[name], getattr(source, name)
            if dtype.startswith("S"):
                value = [each.encode() for each in (value if name in _LISTS else [value])]
            static[column] = np.array(value, dtype)
        return columns, static


class SourceWriter(ServiceWriter):
    """Publishes a service of one kind, whose form is ``form``; ``source`` is its present source."""

    form: ClassVar[ServiceForm]

    def __init__(self, source: Source, name: str, **options: Unpack[ServiceOptions]) -> None:
        kind, of_type = self.form.kind, f", {source.type_name}" if source.type_name else ""
        description = f"{kind} of {source.driver or 'a skin'}{of_type}"
        super().__init__(name, *self.form.columns(source), kind=kind, description=description, **options)
        self.source = source

    def _go_on(self, source: Source) -> None:
        self.restructure(*self.form.columns(source))
        self.source = source


class SourceSample(Sample):
    """A sample of a service that has a source."""

    __slots__ = ()

    @property
    def source(self) -> Source:
        """The source of the service."""
        return cast(Source, self.context)


class SourceReader(ServiceReader[SampleT]):
    """Reads a service of one kind: a :class:`skinware.service.ServiceReader`, by default of the kind's usual name.

    Raises:
        BadServiceFile: the service is of another kind, or its columns are others.
    """

    form: ClassVar[ServiceForm]

    def __init__(
        self,
        name: str | None = None,
        *,
        namespace: Namespace | str | None = None,
        timeout_s: float | None = 0.0,
        announce: bool = True,
    ) -> None:
        super().__init__(name or self.form.kind, namespace=namespace, timeout_s=timeout_s, announce=announce)

    @property
    def source(self) -> Source:
        """The source of the service."""
        return cast(Source, self._ring.context)

    def _describe(self, attached: segments.Segment) -> Source:
        if bytes(attached.header["kind"]) != self.form.kind.encode():
            raise BadServiceFile(f"service {self.name!r} is not of kind {self.form.kind!r}")
        found = attached.schema.columns
        try:
            source = self.form.read(attached.static_columns())
            for name, column in self.form.columns(source)[0].items():
                if found[name].dtype != column.dtype or found[name].shape != column.shape:
                    raise ValueError(f"column {name!r} is not {column.shape} of {column.dtype}")
        except (LookupError, ValueError, TypeError, AttributeError) as error:
            raise BadServiceFile(f"{attached.path}: {error}; not attached") from None
        return source
