"""Define what a source of foreign data is: tables of named columns, read a few rows at a time."""

from __future__ import annotations

import contextlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt

from skinware.errors import ConfigurationError, SkinwareError

Rows = dict[str, npt.NDArray[Any]]
"""m rows of columns, (m, ...) by name: numbers; times that a file has as such are int64 ns, dates since 1970."""
DUMP = "data.log"
"""The file of YARP's datadumper, whose folder has the name."""
BLOCK_BYTES = 4 << 20
"""Size of the rows that a source reads together."""


class ColumnSource(ABC):
    """A file, or a folder of files, of another program.

    Attributes:
        tables: columns by the name of their table: the shape of a row, () for one number. All columns of a table have
            equally many rows. The only table of a file has an empty name.
        left_out: by name, why something in it is no column of numbers; a column of texts can be read all the same.
        times: columns of times as such, whose unit is ns.
        frames: by table, the name of the coordinate frame of its positions, where the source has one.
        share: part of the last pass over a table that is done, 0 to 1.
        marks: times of episodes, s on the axis of the data, and their names.
        problems: what the passes so far have missed.
    """

    tables: Mapping[str, Mapping[str, tuple[int, ...]]]
    left_out: Mapping[str, str]
    times: Collection[str] = ()
    frames: Mapping[str, str] = MappingProxyType({})
    marks: Sequence[tuple[float, str]] = ()
    share: float = 0.0

    @property
    def problems(self) -> Sequence[str]:
        return ()

    def __init__(self, path: Path) -> None:
        self.path = path

    @abstractmethod
    def blocks(self, table: str, names: Collection[str]) -> Iterator[Rows]:
        """Yield rows of some columns, a few at a time; each call begins again with the first.

        Raises:
            ConfigurationError: they are damaged; the message says where, and what to do.
            OSError: they cannot be read.
        """

    def close(self) -> None:  # noqa: B027, not all keep files open
        """Close the files. Idempotent."""


@contextlib.contextmanager
def blamed(say: Callable[[str], str]) -> Iterator[None]:
    """Raise what parsers of others raise as ConfigurationError, with what ``say`` makes of the reason."""
    try:
        yield
    except SkinwareError:
        raise
    except Exception as error:
        if isinstance(error, OSError) and error.filename:
            raise
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ConfigurationError(say(reason)) from None


def whole(source: ColumnSource, table: str, names: Sequence[str], most: int | None = None) -> Rows:
    """Return columns, (n, ...), or as many of their first rows as there are in ``most`` numbers of one of them."""
    parts: dict[str, list[npt.NDArray[Any]]] = {name: [] for name in names}
    count = 0
    for rows in source.blocks(table, names):
        for name, found in parts.items():
            found.append(rows[name])
        count += max(each.size for each in rows.values())
        if most is not None and count >= most:
            break
    shapes = source.tables[table]
    return {name: np.concatenate(found or [np.zeros((0, *shapes.get(name, ())))]) for name, found in parts.items()}


def first_rows(source: ColumnSource, table: str) -> Rows:
    return next(source.blocks(table, source.tables[table]), {name: np.zeros(0) for name in source.tables[table]})
