"""Readers of the services that tell something of a driver's sensors: contacts, motion and health."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar, Generic, TypeVar, cast

import numpy as np
import numpy.typing as npt

from skinware.errors import BadServiceFile
from skinware.memory import segments
from skinware.memory.namespace import Namespace
from skinware.memory.ring import SampleT
from skinware.service import ServiceReader

SourceT = TypeVar("SourceT")


class SourceReader(ServiceReader[SampleT], Generic[SourceT, SampleT]):
    """Reads a service of one kind, whose static columns say what it is of.

    Args:
        name: of the service; default: that of its kind.
        namespace, timeout_s, announce: as for :class:`skinware.service.ServiceReader`, which also lists the errors.

    Attributes:
        kind: of the service.

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
    def _source_of(static: Mapping[str, npt.NDArray[Any]]) -> SourceT:
        """What the static columns say."""

    @staticmethod
    @abstractmethod
    def _layout_of(source: SourceT) -> Mapping[str, tuple[str, tuple[int, ...]]]:
        """The dtype and shape of every column of a frame."""
