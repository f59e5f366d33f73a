"""Record all published samples in an MCAP file, and read it.

::

    import skinware.recording

    with skinware.recording.open("walk.mcap") as recording:
        torso = recording["torso"].read()
        pressure = torso.physical("pressure")  # (frames, sensors) float32, at torso.time_s
        for snapshot in recording.snapshots():  # like those of skinware.Skin
            ...
"""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

from skinware.errors import MissingExtra

if find_spec("mcap") is None or find_spec("zstandard") is None:
    raise MissingExtra.of("recordings", "skinware[record]")

from skinware.recording.reading import Recording
from skinware.recording.tracks import Series, Track
from skinware.recording.wire import WirePiece, WireTrack
from skinware.transfer.generation import RecordedDriverSnapshot, RecordedSample, RecordedSnapshot
from skinware.wire import WireItem

__all__ = [
    "RecordedDriverSnapshot",
    "RecordedSample",
    "RecordedSnapshot",
    "Recording",
    "Series",
    "Track",
    "WireItem",
    "WirePiece",
    "WireTrack",
    "open",
]


def open(path: str | Path) -> Recording:  # noqa: A001, as of gzip and others
    """Open a recording.

    Args:
        path: of the file.

    Raises:
        BadRecording: it is not a recording, or needs a newer version.
        OSError: it cannot be read.
    """
    return Recording(path)
