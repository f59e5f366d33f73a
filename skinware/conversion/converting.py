"""Write a recording in another format, under a name that appears when the file is complete."""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from skinware.conversion.arrays import write_hdf5, write_npz
from skinware.conversion.mcap_files import ros2_without, viewers_without, write_foxglove, write_recording, write_ros2
from skinware.conversion.rows import csv_without, write_csv, write_parquet
from skinware.conversion.tables import RecordedSource, Selection, TableSource
from skinware.errors import ConfigurationError
from skinware.recording import Recording
from skinware.recording.wire import Chosen, Exported, export_candump, export_pcapng

if TYPE_CHECKING:
    from skinware.conversion.foreign import ImportedSource


class Format(NamedTuple):
    """A format of files or folders.

    Attributes:
        write: writes a source to a path that does not exist; it may raise ConfigurationError, MissingExtra or OSError.
        without: returns a line for each thing of a source that the format cannot hold.
    """

    suffix: str
    write: Callable[[TableSource, Path], None]
    without: Callable[[TableSource], list[str]] = lambda _: []


FORMATS = {
    "csv": Format("-csv", write_csv, csv_without),
    "npz": Format(".npz", write_npz),
    "parquet": Format("-parquet", write_parquet),
    "hdf5": Format(".h5", write_hdf5),
    "mcap": Format(".mcap", write_recording),
    "foxglove": Format(".foxglove.mcap", write_foxglove, viewers_without),
    "ros2": Format("-ros2", write_ros2, ros2_without),
}


@dataclass
class Converted:
    """The result of a conversion.

    Attributes:
        path: of the new file or folder.
        frames: samples in it, by table.
        notes: a line for each fault of the old file, and for each thing that the new one lacks.
        episodes: number of episodes of a learning set; None for other formats.
    """

    path: Path
    frames: Counter[str] = field(default_factory=Counter)
    notes: list[str] = field(default_factory=list)
    episodes: int | None = None


def convert(
    path: Path,
    target: Path | None,
    format_name: str,
    selection: Selection | None = None,
    *,
    start_s: float = 0.0,
    end_s: float | None = None,
    is_stopped: Callable[[], bool] = lambda: False,
) -> Converted:
    """Write a recording in another format.

    Args:
        path: a recording; it is only read.
        target: the new file or folder, which must not exist; None: beside the recording, with the format's suffix.
        format_name: one of :data:`FORMATS`; or of :data:`WIRE_FORMATS`, for a recording of ``skin-record --wire``.
        selection: the services and sensors to convert, of wires only the drivers; None: all.
        start_s: begin at this time, s since the recording began.
        end_s: end before this time; None: at the end of the recording.
        is_stopped: called now and then; True ends the conversion with :class:`KeyboardInterrupt` and leaves no file.

    Raises:
        BadRecording: the file is not a recording, needs a newer version, or has no undamaged sample.
        ConfigurationError: the recording lacks what is selected.
        MissingExtra: a package of the extra ``convert`` is not installed.
        OSError: the recording cannot be read, or the target cannot be written.
    """
    if format_name in WIRE_FORMATS:
        drivers = () if selection is None else selection.services
        if selection is not None and selection.sensors:
            raise ConfigurationError(f"{format_name} holds frames of wires: select drivers, not sensors")
        return _converted_wires(path, target, WIRE_FORMATS[format_name], Chosen(drivers, start_s, end_s, is_stopped))
    form = FORMATS[format_name]
    target = new_target(path, target, form.suffix)
    with contextlib.closing(RecordedSource(path, start_s, end_s, selection, is_stopped)) as source:
        return _written(source, target, form, "no sample of the selection was recorded in that time")


def convert_foreign(
    path: Path,
    target: Path | None,
    format_name: str,
    map_path: Path,
    *,
    report: Callable[[float], object] = lambda _: None,
    is_stopped: Callable[[], bool] = lambda: False,
) -> Converted:
    """Write data of another program as a recording, or in another format.

    Args:
        path: of the data, see :func:`skinware.conversion.foreign.open_source`; they are only read.
        target, format_name, is_stopped: as for :func:`convert`.
        map_path: the map from columns to taxels.
        report: called now and then with the part that is done, 0 to 1.

    Raises:
        ConfigurationError: the data are nothing that is known, or damaged, or the map does not fit them.
        MissingExtra: a package of the extra ``convert`` is not installed.
        OSError: the data cannot be read, or the target cannot be written.
    """
    from skinware.conversion.foreign import ImportedSource, open_source

    form = FORMATS[format_name]
    target = new_target(path, target, form.suffix)
    with contextlib.closing(open_source(path)) as columns:
        return _written(ImportedSource(columns, map_path, report, is_stopped), target, form, "no row in it")


def _written(source: RecordedSource | ImportedSource, target: Path, form: Format, why_empty: str) -> Converted:
    with begun_beside(target) as begun:
        form.write(source, begun)
        if not source.frames.total():
            raise ConfigurationError(f"{source.path}: {why_empty}")
    notes = [f"{target}: {note}" for note in form.without(source)]
    return Converted(target, source.frames, [*source.problems, *notes])


def new_target(path: Path, target: Path | None, suffix: str) -> Path:
    """Return the target, or, if that is None, a name beside the file.

    Raises:
        FileExistsError: it exists.
    """
    target = target or path.with_name(path.stem + suffix)
    if target.exists():
        raise FileExistsError(errno.EEXIST, "exists already: give another name, or remove it", str(target))
    return target


@contextlib.contextmanager
def begun_beside(target: Path) -> Iterator[Path]:
    """Yield a path to write to, which is renamed to the target at the end, or removed if an error occurs."""
    begun = target.with_name(f".{target.name}.{os.getpid()}.part")
    try:
        yield begun
        os.rename(begun, target)
    except BaseException:
        if begun.is_dir():
            shutil.rmtree(begun, ignore_errors=True)
        else:
            begun.unlink(missing_ok=True)
        raise


class WireFormat(NamedTuple):
    suffix: str
    export: Callable[[Recording, Path, Chosen], Exported]


WIRE_FORMATS = {"candump": WireFormat(".log", export_candump), "pcapng": WireFormat(".pcapng", export_pcapng)}


def _converted_wires(path: Path, target: Path | None, form: WireFormat, chosen: Chosen) -> Converted:
    target = new_target(path, target, form.suffix)
    with contextlib.closing(Recording(path)) as recording, begun_beside(target) as begun:
        exported = form.export(recording, begun, chosen)
        return Converted(target, exported.counts, [*recording.problems, *exported.notes])
