"""Write NPZ and HDF5 files: whole arrays, a few rows at a time."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from skinware.conversion.tables import Output, Table, TableSource, cannot_hold, outputs, package, sensor_table

FORMAT, VERSION = "skinware-arrays", 1


def description(source: TableSource, units: Sequence[dict[str, str]]) -> bytes:
    tables = [
        {"name": table.name, "service": table.service, "units": of}
        for table, of in zip(source.tables, units, strict=True)
    ]
    head = {"format": FORMAT, "version": VERSION, "start_ns": source.start_ns, "tables": tables}
    return msgspec.json.encode({**head, "events": source.events, "clock": source.clock})


_DESCRIPTION = "recording"


def write_npz(source: TableSource, path: Path) -> None:
    """Write a source, in one pass for each array, which must be whole before the next one begins."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        units = []
        for table in source.tables:
            rows = sum(len(block["frames/time_ns"]) for block in table.blocks(["frames/time_ns"]))
            made = outputs(table)
            for output in made:
                _write_streamed(archive, table, output, rows)
            for name, array in sensor_table(table).items():
                with archive.open(f"{table.name}/sensors/{name}.npy", "w") as file:
                    np.lib.format.write_array(file, array, allow_pickle=False)
            units.append({output.name: output.unit for output in made if output.unit})
        with archive.open(f"{_DESCRIPTION}.npy", "w") as file:
            text = description(source, units).decode()
            np.lib.format.write_array(file, np.array(text), allow_pickle=False)


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


_CHUNK_BYTES = 256 << 10
"""Bytes of an array that HDF5 reads at once."""


class _GuardedFile(io.FileIO):
    """A file for HDF5 that keeps errors to itself, because the library does not survive a full disk.

    Attributes:
        failure: the first error; nothing is written after it.
    """

    failure: OSError | None = None

    def write(self, data: Any) -> int:
        rest = memoryview(data).cast("B")
        size = len(rest)
        try:
            while rest and self.failure is None:
                rest = rest[super().write(rest) :]
        except OSError as error:
            self.failure = OSError(error.errno, error.strerror, self.name)
        return size

    def readinto(self, buffer: Any) -> int:
        """Read, and fill up with zeros beyond the end."""
        into = memoryview(buffer).cast("B")
        into[:] = bytes(len(into))
        super().readinto(into)
        return len(into)

    def truncate(self, size: int | None = None) -> int:
        try:
            return super().truncate(size)
        except OSError as error:
            self.failure = self.failure or OSError(error.errno, error.strerror, self.name)
            return 0

    def check(self) -> None:
        if self.failure is not None:
            raise self.failure


def write_hdf5(source: TableSource, path: Path) -> None:
    hdf5 = package("h5py", "HDF5")
    with _GuardedFile(str(path), "x+") as stream:
        with hdf5.File(stream, "w") as file:
            units = [_write_table(file.create_group(table.name), table, stream) for table in source.tables]
            file.create_dataset(_DESCRIPTION, data=np.frombuffer(description(source, units), np.uint8))
        stream.check()


def _write_table(group: Any, table: Table, stream: _GuardedFile) -> dict[str, str]:
    made = outputs(table)
    for output in made:
        _, _, name = output.name.partition("/")
        if "/" in name or name == ".":  # a path in HDF5
            raise cannot_hold("HDF5", table, f"a column {name!r}")
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
    return {output.name: output.unit for output in made if output.unit}


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
