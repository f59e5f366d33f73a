"""Write recordings as files of other programs: numpy, CSV, Parquet, HDF5, Foxglove, ROS 2.

A source (:mod:`skinware.conversion.tables`) reads a recording as arrays with a row for each sample, a few rows at a
time; each format writes these rows, in little memory.
"""

from __future__ import annotations

from skinware.conversion.converting import FORMATS, WIRE_FORMATS, Converted, convert, convert_foreign
from skinware.conversion.tables import Selection

__all__ = ["FORMATS", "WIRE_FORMATS", "Converted", "Selection", "convert", "convert_foreign"]
