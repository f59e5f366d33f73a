"""Make recordings of data that other programs wrote: CSV, NPZ, Parquet, LeRobot's datasets, bags of ROS, YARP's dumps.

A source (:mod:`.source`) has tables of named columns; a map (:mod:`.mapping`) says which of them are which taxels.
"""

from __future__ import annotations

from pathlib import Path

from skinware.conversion.foreign.guessing import guess
from skinware.conversion.foreign.importing import ImportedSource
from skinware.conversion.foreign.source import DUMP, ColumnSource
from skinware.errors import ConfigurationError

__all__ = ["ColumnSource", "ImportedSource", "guess", "open_source"]

_INSTEAD = {
    b"version https://git-lfs": "only a pointer to the data: fetch them with git lfs pull",
    b"\x1f\x8b": "packed by gzip: unpack it first",
    b"\x28\xb5\x2f\xfd": "packed by zstd: unpack it first",
    b"ARROW1": "Feather is not read: write it as Parquet",
    b"MATLAB ": "MAT-files are not read: export their arrays by writematrix, or with numpy.savez",
    b"\x89HDF": "HDF5 is not read: export its arrays with numpy.savez, or as CSV",
    b"\x93NUMPY": "one array without a name: save it with numpy.savez",
}
_BEGINNING = 64
"""Bytes that show the format, and which program wrote an MCAP file."""


def open_source(path: Path) -> ColumnSource:
    """Open foreign data; their first bytes, or the files of a folder, show their format.

    Raises:
        ConfigurationError: they are nothing that is known, or are damaged.
        MissingExtra: they need a package that is not installed.
        OSError: they cannot be read.
    """
    from skinware.conversion.foreign.bags import BagSource
    from skinware.conversion.foreign.files import DatasetSource, NpzSource, ParquetSource
    from skinware.conversion.foreign.texts import TextSource

    if path.is_dir():
        table = next(path.rglob("*.parquet"), None)
        if table is not None:
            _beginning(table)
        if (path / "meta" / "info.json").exists():
            return DatasetSource(path)
        if (path / "metadata.yaml").exists():
            return BagSource(path)
        if (path / DUMP).exists():
            return TextSource(path / DUMP)
        if table is not None:
            return ParquetSource(path)
        raise ConfigurationError(f"{path}: a folder without metadata.yaml, meta/info.json, data.log or Parquet files")
    begin = _beginning(path)
    if begin.startswith(b"\x89MCAP") and b"skinware" in begin:
        raise ConfigurationError(f"{path}: a recording already, which needs no map")
    if begin.startswith((b"#ROSBAG", b"\x89MCAP", b"SQLite format")):
        return BagSource(path)
    if begin.startswith(b"PK"):
        return NpzSource(path)
    return ParquetSource(path) if begin.startswith(b"PAR1") else TextSource(path)


def _beginning(path: Path) -> bytes:
    with path.open("rb") as file:
        begin = file.read(_BEGINNING)
    for magic, why in _INSTEAD.items():
        if begin.startswith(magic):
            raise ConfigurationError(f"{path}: {why}")
    return begin
