"""What went over the wires in a recording, as files of programs that know buses."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple, Protocol

from skinware.conversion.converting import Converted, begun_beside, new_target
from skinware.conversion.selection import Selection
from skinware.errors import ConfigurationError
from skinware.recording import Recording
from skinware.recording.wire import Chosen, Exported, export_candump, export_pcapng


class _Export(Protocol):
    def __call__(self, recording: Recording, path: Path, chosen: Chosen) -> Exported: ...


class WireFormat(NamedTuple):
    """A format that can be written: the suffix of its files, and what writes them."""

    suffix: str
    export: _Export


WIRE_FORMATS = {"candump": WireFormat(".log", export_candump), "pcapng": WireFormat(".pcapng", export_pcapng)}


def convert_wires(
    path: Path,
    target: Path | None,
    format_name: str,
    selection: Selection | None = None,
    *,
    start_s: float = 0.0,
    end_s: float | None = None,
    is_stopped: Callable[[], bool] = lambda: False,
) -> Converted:
    """Write what went over the wires of drivers.

    Args:
        path: a recording that ``skin-record --wire`` made; it is only read.
        target: as for :func:`skinware.conversion.convert`.
        format_name: one of :data:`WIRE_FORMATS`.
        selection: which drivers; None: all.
        start_s: as for :func:`skinware.conversion.convert`.
        end_s: likewise.
        is_stopped: likewise.

    Raises:
        BadRecording: the file is no recording, or one of a newer version, or one without wires.
        ConfigurationError: no wire of a driver was recorded, or only some sensors are selected: a wire has none.
        OSError: it cannot be read, or the new one cannot be written.
    """
    form, selection = WIRE_FORMATS[format_name], selection or Selection()
    if selection.sensors:
        raise ConfigurationError(f"{format_name} has what went over the wires: frames, not sensors, can be selected")
    target = new_target(path, target, form.suffix)
    with contextlib.closing(Recording(path)) as recording, begun_beside(target) as begun:
        exported = form.export(recording, begun, Chosen(selection.services, start_s, end_s, is_stopped))
        return Converted(target, exported.counts, [*recording.problems, *exported.notes])
