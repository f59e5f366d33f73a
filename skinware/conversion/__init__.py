"""Recordings as files that others read, and back: numpy, CSV, Parquet, HDF5.

A source (:mod:`skinware.conversion.tables`) gives what was recorded as arrays with a row for each frame, a little at a
time; each format writes what a source gives. So whatever can be read can be written in every format, in little memory.
"""

from __future__ import annotations

from skinware.conversion.converting import FORMATS, WIRE_FORMATS, Converted, convert, convert_wires
from skinware.conversion.selection import Selection

__all__ = ["FORMATS", "WIRE_FORMATS", "Converted", "Selection", "convert", "convert_wires"]
