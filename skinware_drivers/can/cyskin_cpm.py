"""CPM finger with CySkin technology on CAN: sixteen taxels in four frames.

Wire format: can2wifi2ros ``arduino_can2wifi/arduino_can2wifi.ino`` (github.com/wngfra/can2wifi2ros, Apache-2.0).
1 Mbit/s. Identifiers 0x405, 0x407, 0x409, 0x40B in this order, eight bytes each: four little-endian uint16. The i-th
value of a set belongs to taxel ``ORDER[i]``, as in the other programs of that author; one of his calibration scripts
reads the table the other way round. The finger sends by itself: no program of that author sends a command.

The frames carry no number and no checksum, so one lost frame loses its set, and sets are separated by time alone.
"""

from __future__ import annotations

from typing import Annotated

import numpy as np
from msgspec import Meta

from skinware.sensor_types import PRESSURE
from skinware_drivers import Cycle, Frame, Identifier, Layout, Module, Options, Patch, Values, taxels
from skinware_drivers.can import CanAdapter

ORDER = (11, 15, 14, 12, 9, 13, 8, 10, 6, 7, 4, 5, 2, 0, 3, 1)
IDENTIFIERS = (0x405, 0x407, 0x409, 0x40B)
QUARTERS = tuple(
    Frame(f"{identifier:03X}", (Identifier(identifier),), (8,), Values(0, "<u2", 4, to=ORDER[4 * i : 4 * i + 4]))
    for i, identifier in enumerate(IDENTIFIERS)
)


class CyskinCpmOptions(Options, frozen=True):
    period_ms: Annotated[int, Meta(description="nominal time between two sets, ms", ge=1)] = 20


class CyskinCpmDriver(CanAdapter[CyskinCpmOptions]):
    """One finger on each bus; uid = taxel. Values are raw counts, without a baseline."""

    types = (PRESSURE.measured(unit="counts", minimum=0, maximum=0xFFFF),)
    dtype = np.uint16
    patches = (Patch("finger", [Module(taxels(16), kind="fingertip")]),)

    def __init__(self, options: CyskinCpmOptions) -> None:
        super().__init__(options)
        names = tuple(frame.name for frame in QUARTERS)
        self.layout = Layout(QUARTERS, Cycle(names, within="patch", maximum_age_s=self.period_s / 2))
