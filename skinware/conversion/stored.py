"""Tables that stand in a file as whole arrays: what reading them has in common, whatever the file is."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from skinware.conversion.tables import TIME, ArrayFormat, Block, Span, Table
from skinware.errors import BadRecording
from skinware.recording.generation import Generation

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
