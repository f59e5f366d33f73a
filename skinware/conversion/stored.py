"""Tables that stand in a file as whole arrays: what reading them has in common, whatever the file is."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from skinware.conversion.description import description_of, generations_of
from skinware.conversion.tables import TIME, ArrayFormat, Block, Span, Table
from skinware.errors import BadRecording
from skinware.transfer.generation import Generation

_PIECE_BYTES = 4 << 20


class StoredArrays(Protocol):
    """The arrays of one table in a file."""

    def rows_of(self, name: str, each: ArrayFormat) -> int | None:
        """How many rows an array has; None: there is none whose rows are such."""

    def pieces(self, formats: Mapping[str, ArrayFormat], rows: int) -> Iterator[Mapping[str, npt.NDArray[Any]]]:
        """Some arrays, whose rows are such, so many rows at a time.

        Raises:
            BadRecording: they are damaged.
            OSError: they cannot be read.
        """


class StoredTable(Table):
    """A table of a file of arrays.

    Args:
        name, service, generations: as for :class:`Table`.
        arrays: of it.
        span: what part of its time.
        where: for messages.

    Raises:
        BadRecording: the arrays are not those of the service.
    """

    def __init__(
        self,
        name: str,
        service: str,
        generations: Sequence[Generation],
        arrays: StoredArrays,
        span: Span,
        where: str,
    ) -> None:
        super().__init__(name, service, generations)
        self._arrays, self._span = arrays, span
        rows = {name: arrays.rows_of(name, each) for name, each in self.arrays.items()}
        for array, count in rows.items():
            if count is None:
                shape, dtype = self.arrays[array]
                raise BadRecording(f"{where}: {name} has no {array} with rows of {dtype} {shape}")
        if len(set(rows.values())) > 1:
            raise BadRecording(f"{where}: arrays of {name} have different lengths")
        self._known = np.array(sorted(generation.generation for generation in self.generations), np.uint64)
        self._where = where

    def blocks(self, names: Collection[str]) -> Iterator[Block]:
        """See :class:`Table`."""
        wanted = {name: self.arrays[name] for name in dict.fromkeys([TIME, "frames/generation", *names])}
        rows = max(1, _PIECE_BYTES // sum(each.row_bytes for each in wanted.values()))
        for piece in self._arrays.pieces(wanted, rows):
            if not np.isin(piece["frames/generation"], self._known).all():
                raise BadRecording(f"{self._where}: frames of {self.name} are of a generation that is not told")
            block = self._span.rows_of(dict(piece))
            if len(block[TIME]):
                yield block


class StoredSource(ABC):
    """A file of arrays as a source; a subclass opens it first, and knows where what stands in it.

    Args:
        path: of the file.
        start_s, end_s: what part of its time, s since the recording began; None: to its end.

    Raises:
        BadRecording: it is none that this package wrote, or of a newer version.
        OSError: it cannot be read.
    """

    def __init__(self, path: Path, start_s: float, end_s: float | None) -> None:
        self.path = path
        where = str(path)
        try:
            description = description_of(self._description(), where)
            self.start_ns: int = description.start_ns
            self.events, self.clock = description.events, description.clock
            span = Span.of(self.start_ns, start_s, end_s)
            self.tables: Sequence[Table] = [
                StoredTable(
                    told.name,
                    told.service,
                    generations_of(self._heads(told.name), told.service, where),
                    self._arrays(told.name),
                    span,
                    where,
                )
                for told in description.tables
            ]
        except BaseException:
            self.close()
            raise

    @property
    def problems(self) -> list[str]:
        """See :class:`skinware.conversion.tables.Source`: what is made of arrays is whole, or refused."""
        return []

    @abstractmethod
    def close(self) -> None:
        """Likewise."""

    @abstractmethod
    def _description(self) -> bytes:
        """JSON, for :func:`description_of`."""

    @abstractmethod
    def _heads(self, table: str) -> npt.NDArray[Any]:
        """The generations of a table, for :func:`generations_of`."""

    @abstractmethod
    def _arrays(self, table: str) -> StoredArrays:
        """The arrays of a table."""
