"""Read arrays of numpy, tables of Parquet, and LeRobot's datasets."""

from __future__ import annotations

import contextlib
import io
import json
import zipfile
from collections.abc import Collection, Iterator
from contextlib import ExitStack
from itertools import islice, product
from math import prod
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from skinware.conversion.foreign.source import BLOCK_BYTES, ColumnSource, Rows, blamed
from skinware.conversion.tables import package, pyarrow
from skinware.errors import ConfigurationError

_BATCH_ROWS = 4096
_HEADER_BYTES = 1 << 16
_AS_NEEDED: dict[str, Any] = {"pre_buffer": False, "buffer_size": 1 << 18}
"""Read Parquet a part of a column at a time, not whole groups of rows."""
_MOST_NUMBERS = 1 << 20
"""In a row of an array."""
_TEXTS = ("string", "large_string")
_EPISODE_GAP_S = 1.0
"""Time between the last row of an episode and the first of the next."""
TIME = "time_s"
"""The column that a dataset has besides its own: the episodes one after the other."""


class _Array(NamedTuple):
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    in_columns: bool


class NpzSource(ColumnSource):
    """An NPZ file. Arrays of equally many rows are a table: ``""``, or ``N rows`` where a file has several."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        with blamed(
            lambda reason: f"{path}: not an NPZ file, or damaged ({reason}); a spreadsheet can be saved as CSV"
        ):
            self._zip = zipfile.ZipFile(path)
            self._arrays = {name.removesuffix(".npy"): self._head(name) for name in self._zip.namelist()}
        found = {
            name: each
            for name, each in self._arrays.items()
            if each.dtype.kind in "iufbmM" and each.shape and all(each.shape) and prod(each.shape[1:]) <= _MOST_NUMBERS
        }
        self.times = {name for name, each in found.items() if each.dtype.kind in "mM"}
        self.left_out = {
            name: f"{each.dtype} of shape {each.shape}" for name, each in self._arrays.items() if name not in found
        }
        lengths = dict.fromkeys(each.shape[0] for each in found.values())
        self._table_of = {length: f"{length} rows" if len(lengths) > 1 else "" for length in lengths}
        self.tables = {
            table: {name: each.shape[1:] for name, each in found.items() if each.shape[0] == length}
            for length, table in self._table_of.items()
        }

    def blocks(self, table: str, names: Collection[str]) -> Iterator[Rows]:  # noqa: ARG002, the names are enough
        arrays = {name: self._arrays[name] for name in names}
        length = next((each.shape[0] for each in arrays.values()), 0)
        for name, each in arrays.items():
            if each.dtype.hasobject or each.shape[:1] != (length,):
                raise ConfigurationError(f"{self.path}: {name} is not numbers or texts of {length} rows: leave it out")
        count = max(
            1, BLOCK_BYTES // max(1, sum(prod(each.shape[1:]) * each.dtype.itemsize for each in arrays.values()))
        )
        with ExitStack() as stack:
            with blamed(lambda reason: f"{self.path}: damaged ({reason}): save it again"):
                streams = {name: self._open(name, stack) for name in arrays}
            for first in range(0, length, count):
                until = min(first + count, length)
                self.share = until / length
                yield {name: self._read(name, streams[name], first, until) for name in arrays}

    def close(self) -> None:
        self._zip.close()

    def _head(self, name: str) -> _Array:
        with self._zip.open(name) as stream:
            return _header(stream)

    def _open(self, name: str, stack: ExitStack) -> IO[bytes] | npt.NDArray[Any]:
        stream = stack.enter_context(self._zip.open(name + ".npy"))
        if self._arrays[name].in_columns:  # rows are all over the file
            whole: npt.NDArray[Any] = np.lib.format.read_array(stream, allow_pickle=False)
            return whole
        _header(stream)
        return stream

    def _read(self, name: str, stream: IO[bytes] | npt.NDArray[Any], first: int, until: int) -> npt.NDArray[Any]:
        if isinstance(stream, np.ndarray):
            return stream[first:until]
        shape, dtype, _ = self._arrays[name]
        size = (until - first) * prod(shape[1:]) * dtype.itemsize
        with blamed(lambda reason: f"{self.path}: {name} is damaged after row {first} ({reason}): save it again"):
            data = stream.read(size)
        if len(data) != size:
            raise ConfigurationError(f"{self.path}: {name} ends too early, after row {first}: save it again")
        return _plain(np.frombuffer(data, dtype).reshape(-1, *shape[1:]))


def _header(stream: IO[bytes]) -> _Array:
    begin = io.BytesIO(stream.read(_HEADER_BYTES))
    version = np.lib.format.read_magic(begin)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, in_columns, dtype = read(begin)
    stream.seek(begin.tell())
    return _Array(tuple(map(int, shape)), dtype, in_columns and len(shape) > 1)


def _plain(rows: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return times as int64, ns, dates since 1970, the least number for none; other numbers as they are."""
    if rows.dtype.kind not in "mM":
        return rows
    times = rows.astype(f"{rows.dtype.kind}8[ns]")  # which wraps
    return np.where(times.astype(rows.dtype) == rows, times.astype(np.int64), np.iinfo(np.int64).min)


class ParquetSource(ColumnSource):
    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._arrow = pyarrow()
        self._paths = [path] if path.is_file() else sorted(path.rglob("*.parquet"))
        if not self._paths:
            raise ConfigurationError(f"{path}: no Parquet file in it: fetch the whole dataset")
        self._rows = 0
        for each in self._paths:
            with self._opened(each) as file:
                self._rows += file.metadata.num_rows
        with self._opened(self._paths[0]) as file:
            with blamed(lambda reason: f"{path}: damaged ({reason}): write it again"):
                kinds = {field.name: str(field.type) for field in file.schema_arrow}
                row_bytes = max((row.nbytes for row in islice(file.iter_batches(1), 1)), default=0)
                self._batch_rows = max(1, min(_BATCH_ROWS, BLOCK_BYTES // max(1, row_bytes)))
                batches = list(islice(file.iter_batches(self._batch_rows), 1))
        self.times = {name for name, kind in kinds.items() if kind.startswith(("timestamp", "date", "duration"))}
        shapes: dict[str, tuple[int, ...]] = {}
        for batch, name in product(batches, kinds):
            with contextlib.suppress(ConfigurationError, KeyError):  # or two columns of one name
                found = self._array(self._paths[0], name, batch.column(name))
                if found.dtype.kind != "U" and prod(found.shape[1:]) <= _MOST_NUMBERS:
                    shapes[name] = found.shape[1:]
        self.tables = {"": shapes}
        self.left_out = {name: kind for name, kind in kinds.items() if name not in shapes}

    def blocks(self, table: str, names: Collection[str]) -> Iterator[Rows]:  # noqa: ARG002, it has one
        done = 0
        for path in self._paths:
            with self._opened(path) as file:
                with blamed(lambda reason: f"{path}: damaged after row {done} ({reason}): write it again"):  # noqa: B023
                    for batch in file.iter_batches(self._batch_rows, columns=list(names)):
                        done += len(batch)
                        self.share = done / self._rows
                        yield {name: self._array(path, name, batch.column(name)) for name in names}

    def _opened(self, path: Path) -> Any:
        with blamed(lambda reason: f"{path}: not Parquet, or damaged ({reason})"):
            return self._arrow.parquet.ParquetFile(path, page_checksum_verification=True, **_AS_NEEDED)

    def _array(self, path: Path, name: str, column: Any) -> npt.NDArray[Any]:
        shape = [len(column)]
        while hasattr(column.type, "value_field"):
            sizes = set(package("pyarrow.compute", "Parquet").list_value_length(column).to_pylist())
            if len(sizes) != 1 or None in sizes:
                raise ConfigurationError(f"{path}: {name} has rows of different lengths: leave it out")
            shape, column = [*shape, *sizes], column.flatten()
        found = column.to_numpy(zero_copy_only=False)
        if str(column.type) in _TEXTS and not column.null_count:
            found = found.astype(str)
        if found.dtype.kind not in "iufbmMU":
            raise ConfigurationError(f"{path}: {name} is not numbers: leave it out")
        return _plain(found.reshape(shape))


class DatasetSource(ParquetSource):
    """A dataset of LeRobot (v3.0). Its column ``time_s`` has the episodes one after the other."""

    def __init__(self, path: Path) -> None:
        try:
            info = json.loads((path / "meta" / "info.json").read_text(encoding="utf-8"))
            version = str(info["codebase_version"])
        except (ValueError, KeyError, TypeError):
            raise ConfigurationError(f"{path}/meta/info.json: damaged: it does not say codebase_version") from None
        if not version.startswith("v3"):
            raise ConfigurationError(f"{path}: a dataset of LeRobot {version}: convert it to v3.0 with LeRobot first")
        super().__init__(path / "data")
        self.path = path
        marks: list[tuple[float, str]] = []
        self._begins: dict[int, float] = {}
        end_s = -_EPISODE_GAP_S
        for rows in super().blocks("", ["episode_index", "timestamp"]):
            episodes, times = rows["episode_index"].ravel(), rows["timestamp"].ravel().astype(np.float64)
            for episode in dict.fromkeys(episodes.tolist()):
                if episode not in self._begins:
                    self._begins[episode] = end_s + _EPISODE_GAP_S
                    marks.append((self._begins[episode], f"episode {episode}"))
                end_s = self._begins[episode] + float(times[episodes == episode].max())
        self.marks, self.tables = marks, {"": {**self.tables[""], TIME: ()}}

    def blocks(self, table: str, names: Collection[str]) -> Iterator[Rows]:
        needed = {*names} - {TIME} | {"episode_index", "timestamp"}
        for rows in super().blocks(table, needed):
            begins = [self._begins[episode] for episode in rows["episode_index"].ravel().tolist()]
            yield rows | {TIME: np.array(begins) + rows["timestamp"].ravel()}
