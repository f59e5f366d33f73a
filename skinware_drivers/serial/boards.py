"""Boards of open designs on serial lines, which send by themselves: AnySkin, a tactile glove, skintalk's patches.

AnySkin and ReSkin: magnetometers under a magnetic skin, on the serial port of a microcontroller.

Wire format: the maker's firmware, ``arduino/5X_binary_burst_stream`` (github.com/raunaqbhirangi/anyskin). 115200 baud
on USB. A message is, for each magnetometer, temperature, x, y and z as little-endian float32, and 0D 0A behind them
all: 82 bytes for five. The library that the firmware uses gives degrees Celsius and microtesla.

A message has no beginning, no checksum and no counter, and the board takes no command. 0D 0A can also occur within
values: after any error a message counts only if it ends with 0D 0A and the 82 bytes behind it do, too.

The tactile glove of Bielefeld University (TactileGlove, iObject), as its first firmware speaks on a serial line.

Wire format: the maker's firmware and host (ubi-agni/TactileGlove 59a0ef6, 2025-04-25, ``firmware/PIC18`` and
``linux/libio/SerialInput.cpp``). 115200 baud. One packet of five bytes for each taxel: ``3C + taxel``, 01, high byte,
low byte, 00. The value has twelve bits, the lower four bits of the high byte first; the upper four are the channel of
the converter. The maker's host shows 4095 - value: pressure lowers the value.

A packet has no checksum and no counter, and the glove takes no command. A packet counts if its first, second and last
byte are right, and a packet follows: one that lost bytes could otherwise pass with the beginning of the next.

Skin patches that are read with skintalk (Octocan): 24-bit cells, a record for each.

Wire format: ``skintalk.c`` and ``serialcfg.sh`` of skinvis (github.com/t173/skinvis). 2,000,000 baud. The byte '1'
starts all patches, '0' stops them; neither is answered. The firmware of OctoCan3 (``main.c`` of t173/octocan3, 38ef1cd
of 2024-01-26; one patch of 16 cells, 16 bits) has 115200 baud, starts with 'X', stops with 'S', finds an offset of its
converter for each cell with 'C', and answers each with a line of text.

A record has five bytes: 55, patch << 4 | cell, and the value as a big-endian signed number of 24 bits. Patches are
numbered from 1, cells from 0. skintalk.c shows one more for negative values (convert_24to32); this driver does not.

A record has no checksum and no counter. As in skintalk, it counts only if the next one's 55 comes right behind it, so
the last record before a pause waits for the next one. Only two bytes can be checked: noise can look like a record.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta

from skinware.errors import ConfigurationError
from skinware.sensor_types import MAGNETIC_FIELD_X, MAGNETIC_FIELD_Y, MAGNETIC_FIELD_Z, PRESSURE, TEMPERATURE
from skinware.status import Status
from skinware_drivers import (
    Bits,
    Frame,
    Layout,
    Link,
    Module,
    Options,
    Packed,
    Patch,
    Sentinel,
    Values,
    operation,
    taxels,
)
from skinware_drivers.serial import Field, Packet, SerialAdapter, Unframed


class AnySkinOptions(Options, frozen=True):
    mags: Annotated[int, Meta(description="magnetometers of the board", ge=1, le=64)] = 5
    period_ms: Annotated[int, Meta(description="nominal time between two messages, ms", ge=1)] = 10


class AnySkinDriver(SerialAdapter[AnySkinOptions]):
    """One board on a serial line: one module, as a message has all of it.

    The four sensors of a magnetometer share its number as their uid. Values are as the board sends them; those that are
    no number are ``SUSPECT``.
    """

    types = (
        TEMPERATURE,
        *(t.measured(scale=1e-6) for t in (MAGNETIC_FIELD_X, MAGNETIC_FIELD_Y, MAGNETIC_FIELD_Z)),
    )
    dtype = np.float32

    def __init__(self, options: AnySkinOptions) -> None:
        super().__init__(options)
        size = 16 * options.mags
        self.framing = Packet(length=size + 2, trailer=b"\r\n", confirmed=True)
        no_number = tuple(Sentinel(Status.SUSPECT, value) for value in (math.nan, math.inf, -math.inf))
        values = Values(offset=0, dtype="<f4", count=4 * options.mags)
        self.layout = Layout((Frame("message", (), (size,), values, flags=no_number),))
        channels = taxels(options.mags, *(t.name for t in self.types))
        self.patches = (Patch("anyskin", (Module(channels, kind="board"),)),)


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


_COMMANDS = {"octocan": (b"1", b"0", 2_000_000), "octocan3": (b"X", b"S", 115_200)}
"""Start, stop and baud rate, by firmware."""
_CALIBRATE = b"C"


class SkintalkOptions(Options, frozen=True):
    patches: Annotated[tuple[int, ...], Meta(description="numbers of the patches, 0-15")] = tuple(range(1, 9))
    cells: Annotated[int, Meta(description="cells of each patch", ge=1, le=16)] = 16
    firmware: Annotated[Literal["octocan", "octocan3"], Meta(description="its commands and baud rate")] = "octocan"
    period_ms: Annotated[int, Meta(description="nominal time between two records of a cell, ms", ge=1)] = 20

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.patches or len(set(self.patches)) < len(self.patches) or not set(self.patches) <= set(range(16)):
            raise ConfigurationError(f"patches {self.patches}: give different numbers of 0 to 15")


class SkintalkDriver(SerialAdapter[SkintalkOptions]):
    """All patches of a serial line; uid = patch << 4 | cell.

    Each cell has records of its own, so it is a module and becomes stale alone. Records of patches or cells that the
    options do not name are counted as unknown.
    """

    types = (PRESSURE.measured(unit="counts", minimum=-(1 << 23), maximum=(1 << 23) - 1),)
    dtype = np.int32
    framing = Packet(sync=b"\x55", length=5, identifier=Field(1), confirmed="each")
    commands = Unframed()

    def __init__(self, options: SkintalkOptions) -> None:
        super().__init__(options)
        self._start, self._stop, self.baudrate = _COMMANDS[options.firmware]
        values = Values(0, Packed(24, signed=True), 1)
        self.layout = Layout((Frame("record", (), (3,), values, patch=Bits(4, 4), module=Bits(0, 4)),))
        self.patches = tuple(
            Patch(
                f"patch {number}",
                [Module(taxels(1, first_uid=number << 4 | i), key=i, kind="cell") for i in range(options.cells)],
                key=number,
            )
            for number in options.patches
        )

    async def start(self, link: Link) -> None:
        await link.send(0, self._start)

    async def stop(self, link: Link) -> None:
        await link.send(0, self._stop)

    @operation()
    async def calibrate(self, link: Link, patches: Sequence[Patch]) -> None:  # noqa: ARG002
        """Have OctoCan3 find the offset of each cell, which it forgets without power; nothing may touch the skin."""
        if self.options.firmware != "octocan3":
            raise ValueError("only OctoCan3 has this command (option firmware)")
        await link.send(0, _CALIBRATE)
