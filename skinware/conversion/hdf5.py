"""HDF5: one file of compressed arrays in groups, written and read a few rows at a time."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from skinware.conversion._packages import h5py
from skinware.conversion.description import described, heads_of
from skinware.conversion.stored import StoredArrays, StoredSource
from skinware.conversion.tables import (
    ArrayFormat,
    Output,
    Source,
    Table,
    cannot_hold,
    outputs,
    sensor_table,
)
from skinware.errors import BadRecording

_DESCRIPTION = "recording"
_CHUNK_BYTES = 256 << 10
"""Of an array: what a program reads at least."""


class _File:
    """A file in which HDF5 writes, and which never fails for it: the library does not survive a full disk.

    Args:
        path: of the file.

    Attributes:
        failure: the first error; nothing is written after it.
    """

    def __init__(self, path: Path) -> None:
        self._file = path.open("x+b", buffering=0)
        self._path = path
        self.failure: OSError | None = None

    def write(self, data: Any) -> int:
        rest = memoryview(data).cast("B")
        size = len(rest)
        try:
            while rest and self.failure is None:
                rest = rest[self._file.write(rest) :]
        except OSError as error:
            self.failure = OSError(error.errno, error.strerror, str(self._path))
        return size

    def readinto(self, buffer: Any) -> int:
        into = memoryview(buffer).cast("B")
        into[:] = bytes(len(into))
        self._file.readinto(into)
        return len(into)

    def read(self, size: int) -> bytes:
        data = bytearray(size)
        self.readinto(data)
        return bytes(data)

    def truncate(self, size: int) -> None:
        try:
            self._file.truncate(size)
        except OSError as error:
            self.failure = self.failure or OSError(error.errno, error.strerror, str(self._path))

    def seek(self, offset: int, whence: int = 0) -> int:
        return self._file.seek(offset, whence)

    def tell(self) -> int:
        return self._file.tell()

    def flush(self) -> None:
        """Nothing waits."""

    def check(self) -> None:
        if self.failure is not None:
            raise self.failure

    def close(self) -> None:
        self._file.close()


def write_hdf5(source: Source, path: Path) -> None:
    """Write a source.

    Raises:
        ConfigurationError: HDF5 cannot hold the names of its arrays.
        MissingExtra: h5py is not installed.
        OSError: it cannot be written.
    """
    package = h5py()
    with contextlib.closing(_File(path)) as stream:
        with package.File(stream, "w") as file:
            units = [_write_table(file.create_group(table.name), table, stream) for table in source.tables]
            file.create_dataset(_DESCRIPTION, data=np.frombuffer(described(source, units).to_json(), np.uint8))
        stream.check()


def _write_table(group: Any, table: Table, stream: _File) -> dict[str, str]:
    made = outputs(table)
    _check_names(table, made)
    datasets = {output.name: _dataset(group, output) for output in made}
    needed = tuple(dict.fromkeys(name for output in made for name in output.needs))
    for block in table.blocks(needed):
        for output in made:
            rows, dataset = output.of(block), datasets[output.name]
            end = len(dataset) + len(rows)
            dataset.resize(end, axis=0)
            dataset[end - len(rows) :] = rows
        stream.check()
    for name, array in sensor_table(table).items():
        texts = array.dtype.kind == "U"
        group.create_dataset(f"sensors/{name}", data=np.char.encode(array, "utf-8") if texts else array)
    group.create_dataset("generations", data=heads_of(table), compression="gzip")
    return {output.name: output.unit for output in made if output.unit}


def _check_names(table: Table, made: Sequence[Output]) -> None:
    """Refuse names that are paths in HDF5."""
    for output in made:
        _, _, name = output.name.partition("/")
        if "/" in name or name == ".":
            raise cannot_hold("HDF5", table, f"a column {name!r}")


def _dataset(group: Any, output: Output) -> Any:
    each = output.format
    rows = max(1, min(1024, _CHUNK_BYTES // each.row_bytes))
    dataset = group.create_dataset(
        output.name,
        shape=(0, *each.shape),
        maxshape=(None, *each.shape),
        dtype=each.dtype,
        chunks=(rows, *each.shape),
        compression="gzip",
        compression_opts=1,
        shuffle=True,
    )
    if output.unit:
        dataset.attrs["unit"] = output.unit
    return dataset


class Hdf5Source(StoredSource):
    """An HDF5 file as a source; see :class:`skinware.conversion.stored.StoredSource`.

    Raises:
        MissingExtra: h5py is not installed; besides what is said there.
    """

    def __init__(self, path: Path, start_s: float, end_s: float | None) -> None:
        package = h5py()
        try:
            self._file = package.File(path, "r")
        except OSError as error:
            if error.errno is not None:
                raise
            raise BadRecording(f"{path}: not an HDF5 file, or cut off") from None
        super().__init__(path, start_s, end_s)

    def close(self) -> None:
        self._file.close()

    def _description(self) -> bytes:
        return self._array(_DESCRIPTION).tobytes()

    def _heads(self, table: str) -> npt.NDArray[Any]:
        return self._array(f"{table}/generations")

    def _arrays(self, table: str) -> StoredArrays:
        return _Arrays(self._file, table, self.path)

    def _array(self, name: str) -> npt.NDArray[Any]:
        try:
            return np.asarray(self._file[name])
        except (KeyError, OSError, RuntimeError, ValueError, TypeError):
            raise BadRecording(f"{self.path}: not arrays of a recording (no {name!r}, or damaged)") from None


class _Arrays:
    """The arrays of one table in the file."""

    def __init__(self, file: Any, table: str, path: Path) -> None:
        self._file, self._table, self._path = file, table, path

    def rows_of(self, name: str, each: ArrayFormat) -> int | None:
        """See :class:`skinware.conversion.stored.StoredArrays`."""
        try:
            dataset = self._file[f"{self._table}/{name}"]
            return dataset.shape[0] if (dataset.shape[1:], dataset.dtype) == each else None
        except (KeyError, AttributeError, IndexError, RuntimeError, OSError, TypeError):
            return None

    def pieces(self, formats: Mapping[str, ArrayFormat], rows: int) -> Iterator[Mapping[str, npt.NDArray[Any]]]:
        datasets = {name: self._file[f"{self._table}/{name}"] for name in formats}
        total = min(dataset.shape[0] for dataset in datasets.values())
        for first in range(0, total, rows):
            try:
                piece = {name: dataset[first : first + rows] for name, dataset in datasets.items()}
            except (OSError, RuntimeError, ValueError) as error:
                raise BadRecording(f"{self._path}: damaged ({error})") from None
            yield piece
