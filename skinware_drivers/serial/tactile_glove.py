"""The tactile glove of Bielefeld University (TactileGlove, iObject), as its first firmware speaks on a serial line.

Wire format: the maker's firmware and host (ubi-agni/TactileGlove 59a0ef6, 2025-04-25, ``firmware/PIC18`` and
``linux/libio/SerialInput.cpp``). 115200 baud. One packet of five bytes for each taxel: ``3C + taxel``, 01, high byte,
low byte, 00. The value has twelve bits, the lower four bits of the high byte first; the upper four are the channel of
the converter. The maker's host shows 4095 - value: pressure lowers the value.

A packet has no checksum and no counter, and the glove takes no command. A packet counts if its first, second and last
byte are right, and a packet follows: one that lost bytes could otherwise pass with the beginning of the next.
"""

from __future__ import annotations

from typing import Annotated

import numpy as np
from msgspec import Meta

from skinware.sensor_types import PRESSURE
from skinware_drivers import Bits, Frame, Layout, Module, Options, Packed, Patch, Values, taxels
from skinware_drivers.serial import Field, Packet, SerialAdapter

_FIRST = 0x3C
_MOST = 64


class TactileGloveOptions(Options, frozen=True):
    taxels: Annotated[int, Meta(description="number of taxels, counted from 0", ge=1, le=_MOST)] = _MOST
    period_ms: Annotated[int, Meta(description="nominal time between two packets of a taxel, ms", ge=1)] = 30


class TactileGloveDriver(SerialAdapter[TactileGloveOptions]):
    """One glove on a serial line; uid = taxel. Each taxel has packets of its own: it is a module, and stale alone.

    Values are those of the wire (0 is the greatest pressure); ``physical`` is 4095 - value, as the maker shows it.
    """

    types = (PRESSURE.measured(unit="counts", scale=-1, offset=4095, minimum=0, maximum=4095),)
    dtype = np.uint16
    framing = Packet(
        sync=(range(_FIRST, _FIRST + _MOST), 0x01),
        length=5,
        trailer=b"\0",
        identifier=Field(0),
        header=2,
        confirmed="each",
    )
    layout = Layout((Frame("taxel", (), (2,), Values(0, Packed(12, skip=4), 1), module=Bits(0, 8)),))

    def __init__(self, options: TactileGloveOptions) -> None:
        super().__init__(options)
        modules = [Module(taxels(1, first_uid=i), key=_FIRST + i, kind="taxel") for i in range(options.taxels)]
        self.patches = (Patch("glove", modules),)
