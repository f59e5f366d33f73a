"""NPZ: numpy's own file of arrays, written and read a few rows at a time."""

from __future__ import annotations

import math
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from skinware.conversion.description import described, heads_of
from skinware.conversion.stored import StoredArrays, StoredSource
from skinware.conversion.tables import ArrayFormat, Output, Source, Table, outputs, sensor_table
from skinware.errors import BadRecording

_DESCRIPTION = "recording"
_BAD = (zipfile.BadZipFile, zlib.error, ValueError, EOFError, NotImplementedError, SyntaxError)


def write_npz(source: Source, path: Path) -> None:
    """Write a source. Each array is a pass over it: it must be whole before the next one begins.

    Raises:
        OSError: it cannot be written.
    """
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        units = []
        for table in source.tables:
            rows = sum(len(block["frames/time_ns"]) for block in table.blocks(["frames/time_ns"]))
            made = outputs(table)
            for output in made:
                _write_streamed(archive, table, output, rows)
            for name, array in {**_sensors(table), "generations": heads_of(table)}.items():
                with archive.open(f"{table.name}/{name}.npy", "w") as file:
                    np.lib.format.write_array(file, array, allow_pickle=False)
            units.append({output.name: output.unit for output in made if output.unit})
        with archive.open(f"{_DESCRIPTION}.npy", "w") as file:
            text = described(source, units).to_json().decode()
            np.lib.format.write_array(file, np.array(text), allow_pickle=False)


def _sensors(table: Table) -> dict[str, npt.NDArray[Any]]:
    return {f"sensors/{name}": array for name, array in sensor_table(table).items()}


def _write_streamed(archive: zipfile.ZipFile, table: Table, output: Output, rows: int) -> None:
    header = {
        "descr": np.lib.format.dtype_to_descr(output.format.dtype),
        "fortran_order": False,
        "shape": (rows, *output.format.shape),
    }
    with archive.open(f"{table.name}/{output.name}.npy", "w", force_zip64=True) as file:
        np.lib.format.write_array_header_2_0(file, header)
        for block in table.blocks(output.needs):
            file.write(np.ascontiguousarray(output.of(block)).tobytes())


class NpzSource(StoredSource):
    """An NPZ file as a source; see :class:`skinware.conversion.stored.StoredSource`."""

    def __init__(self, path: Path, start_s: float, end_s: float | None) -> None:
        try:
            self._archive = zipfile.ZipFile(path)
        except _BAD as error:
            raise BadRecording(f"{path}: not an NPZ file, or cut off ({error})") from None
        super().__init__(path, start_s, end_s)

    def close(self) -> None:
        self._archive.close()

    def _description(self) -> bytes:
        return str(self._whole(_DESCRIPTION)[()]).encode()

    def _heads(self, table: str) -> npt.NDArray[Any]:
        return self._whole(f"{table}/generations")

    def _arrays(self, table: str) -> StoredArrays:
        return _Arrays(self._archive, table, self.path)

    def _whole(self, name: str) -> npt.NDArray[Any]:
        try:
            with self._archive.open(f"{name}.npy") as file:
                array: npt.NDArray[Any] = np.lib.format.read_array(file, allow_pickle=False)
                return array
        except KeyError:
            raise BadRecording(f"{self.path}: not arrays of a recording (no {name!r})") from None
        except _BAD as error:
            raise BadRecording(f"{self.path}: {name} cannot be read ({error})") from None


class _Arrays:
    """The arrays of one table in the file."""

    def __init__(self, archive: zipfile.ZipFile, table: str, path: Path) -> None:
        self._archive, self._table, self._path = archive, table, path

    def rows_of(self, name: str, each: ArrayFormat) -> int | None:
        """See :class:`skinware.conversion.stored.StoredArrays`."""
        try:
            file, shape, dtype = self._begun(name)
        except KeyError:
            return None
        file.close()
        return shape[0] if ArrayFormat(shape[1:], dtype) == each else None

    def pieces(self, formats: Mapping[str, ArrayFormat], rows: int) -> Iterator[Mapping[str, npt.NDArray[Any]]]:
        begun = {name: self._begun(name) for name in formats}
        try:
            total = min(shape[0] for _, shape, _ in begun.values())
            for first in range(0, total, rows):
                count = min(rows, total - first)
                yield {
                    name: self._next(file, (count, *shape[1:]), dtype) for name, (file, shape, dtype) in begun.items()
                }
        finally:
            for file, _, _ in begun.values():
                file.close()

    def _begun(self, name: str) -> tuple[IO[bytes], tuple[int, ...], np.dtype[Any]]:
        member = self._archive.getinfo(f"{self._table}/{name}.npy")
        file: IO[bytes] | None = None
        try:
            file = self._archive.open(member)
            version = np.lib.format.read_magic(file)
            read = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}[version]
            shape, in_columns, dtype = read(file)
            if in_columns or not shape or dtype.hasobject:
                raise ValueError("not rows of numbers")
        except (*_BAD, KeyError) as error:
            if file is not None:
                file.close()
            raise BadRecording(f"{self._path}: {self._table}/{name} cannot be read ({error})") from None
        return file, shape, dtype

    def _next(self, file: IO[bytes], shape: tuple[int, ...], dtype: np.dtype[Any]) -> npt.NDArray[Any]:
        size = dtype.itemsize * math.prod(shape)
        try:
            data = file.read(size)
        except _BAD as error:
            raise BadRecording(f"{self._path}: damaged ({error})") from None
        if len(data) != size:
            raise BadRecording(f"{self._path}: damaged (an array ends too early)")
        return np.frombuffer(data, dtype).reshape(shape)
