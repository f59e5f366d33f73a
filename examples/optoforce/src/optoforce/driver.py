"""OptoForce's optical force sensors on their USB converter: one sensor of three axes, or four.

Wire format: github.com/shadow-robot/optoforce and github.com/alknemeyer/optoforce, checked against no device. 1 Mbaud.
All numbers have their high byte first. A packet is AA 07 08 and a byte that names the model (0A: one sensor, 1C: four),
a counter of samples (two bytes), a status word, x, y and z of each sensor as int16, and the sum of all bytes before it
as uint16. The host sets the converter up, at any time, with AA 00 32 03, the period in ms (1, 3, 10, 33 or 100;
0: silence), a number for the filter, FF to take the present forces as zero (00: not), and the sum.

Bits of the status word: 15 to 13: the converter has an error; 12 to 10: a sensor has one; 9, 8 and 7: too much force
in x, y and z.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Literal

import msgspec
import numpy as np
from skinware import Status
from skinware.sensor_types import PRESSURE, SHEAR_X, SHEAR_Y
from skinware_drivers import (
    Flag,
    Frame,
    Identifier,
    Layout,
    Link,
    Module,
    Options,
    Patch,
    SequenceNumber,
    Values,
    operation,
    taxels,
)
from skinware_drivers.serial import Field, LengthTable, Packet, SerialAdapter, Sum

SUM = Sum(width=16, order="big")
DATA = Packet(
    sync=(0xAA, 0x07, 0x08, (0x0A, 0x1C)),
    length=LengthTable(offset=3, total={0x0A: 16, 0x1C: 34}),
    identifier=Field(offset=3),
    checksum=SUM,
)
SETTINGS = Packet(sync=(0xAA, 0x00, 0x32, 0x03), length=9, checksum=SUM)

MODELS = {"one": (0x0A, 1), "four": (0x1C, 4)}
FILTERS = {"none": 0, "500": 1, "150": 2, "50": 3, "15": 4, "5": 5, "1.5": 6}
SILENCE_MS = 0


class OptoforceOptions(Options, frozen=True):
    """Options of the driver."""

    model: Annotated[Literal["one", "four"], msgspec.Meta(description="sensors on the converter")] = "one"
    period_ms: Annotated[Literal[1, 3, 10, 33, 100], msgspec.Meta(description="time between two samples, ms")] = 10
    filter_hz: Annotated[
        Literal["none", "500", "150", "50", "15", "5", "1.5"], msgspec.Meta(description="cut-off of the filter, Hz")
    ] = "15"


class OptoforceDriver(SerialAdapter[OptoforceOptions]):
    """One converter on each line. A sensor is a taxel of three axes; its uid is its number. Values are raw counts."""

    framing = DATA
    commands = SETTINGS
    baudrate = 1_000_000
    types = tuple(t.measured(unit="counts", minimum=-32768, maximum=32767) for t in (SHEAR_X, SHEAR_Y, PRESSURE))
    dtype = np.int16

    def __init__(self, options: OptoforceOptions) -> None:
        super().__init__(options)
        identifier, sensors = MODELS[options.model]
        self.patches = (Patch("optoforce", [Module(taxels(sensors, "shear_x", "shear_y", "pressure"))]),)
        axes = Values(offset=4, dtype=">i2", count=3 * sensors)
        too_much = [(channel, 9 - channel % 3) for channel in range(3 * sensors)]
        flags = [
            Flag(Status.SUSPECT, offset=2, dtype=">u2", mask=0xFC00),
            Flag(Status.OUT_OF_RANGE, offset=2, dtype=">u2", each=too_much),
        ]
        counter = SequenceNumber(offset=0, dtype=">u2")
        self.layout = Layout(
            [Frame("sample", [Identifier(identifier)], [4 + 6 * sensors], axes, flags=flags, sequence=counter)]
        )

    async def start(self, link: Link) -> None:
        """Set it up; it then sends. Also called when it has fallen silent: it may have been unplugged."""
        await self._set_up(link, self.options.period_ms)

    async def stop(self, link: Link) -> None:
        """Make it silent."""
        await self._set_up(link, SILENCE_MS)

    @operation()
    async def tare(self, link: Link, patches: Sequence[Patch]) -> None:
        """Take the present forces as zero."""
        await self._set_up(link, self.options.period_ms, zero=True)

    async def _set_up(self, link: Link, period_ms: int, *, zero: bool = False) -> None:
        await link.send(0, bytes([period_ms, FILTERS[self.options.filter_hz], 0xFF if zero else 0]))
