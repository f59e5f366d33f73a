"""Framings of real devices, and of every kind there is, for tests, fuzzing and benchmarks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from skinware_drivers.serial.checksums import (
    CRC8,
    CRC16_CCITT_FALSE,
    CRC16_MODBUS,
    CRC16_WEISS,
    CRC16_X25,
    CRC16_XMODEM,
    CRC32,
    CRC32C,
    LRC,
    SUM8,
    XOR,
    Sum,
)
from skinware_drivers.serial.delimited import COBS, HDLC, LINES, SLIP, Delimited
from skinware_drivers.serial.framing import Field, Framing
from skinware_drivers.serial.framings import Recurring, TextMatrix
from skinware_drivers.serial.packets import Length, LengthTable, Packet


@dataclass(frozen=True)
class Example:
    """A framing, and what its frames can carry.

    Attributes:
        framing: the framing.
        identifiers: some that its frames can have.
        sizes: lengths of bodies that its frames can have; default: all from the shortest to the longest.
    """

    framing: Framing
    identifiers: Sequence[int] = (0,)
    sizes: Sequence[int] | None = None

    def body_sizes(self) -> Sequence[int]:
        """Lengths that bodies can have."""
        if self.sizes is not None:
            return self.sizes
        least = 0
        if isinstance(self.framing, Delimited):
            least = self.framing.minimum_body
        elif isinstance(self.framing, Packet) and isinstance(self.framing.length, int):
            least = self.framing.maximum_body
        return range(least, self.framing.maximum_body + 1)


_AGNI = Packet(
    sync=b"\xf0\xc4", length=LengthTable(2, {0: 12, 1: 16, 2: 40, 0xFE: 5}), checksum=XOR, identifier=Field(2)
)

EXAMPLES: dict[str, Example] = {
    "weiss_wts": Example(
        Packet(
            sync=b"\xaa\xaa\xaa", length=Length(Field(4, 2), 8), maximum=300, checksum=CRC16_WEISS, identifier=Field(3)
        ),
        range(0, 256, 7),
    ),
    "schunk_dsa": Example(
        Packet(
            sync=b"\xaa\xaa\xaa",
            length=Length(Field(4, 2), 8),
            maximum=300,
            checksum=CRC16_WEISS,
            covers=(3, -2),
            bare_when_empty=True,
            identifier=Field(3),
        ),
        range(0, 256, 7),
    ),
    "wuji": Example(
        Packet(
            sync=(0xAA, (0x55, 0x56, 0x57)),
            length=Length(Field(2, 2), 0),
            maximum=3088,
            checksum=CRC16_CCITT_FALSE,
            covers=(2, -2),
            identifier=Field(1),
            header=4,
        ),
        (0x55, 0x56, 0x57),
    ),
    "paxini": Example(
        Packet(
            sync=b"\x55\xaa\x7b\x7b\x0e",
            length=Length(Field(9, 2), 16),
            maximum=400,
            checksum=LRC,
            covers=(4, -5),
            trailer=b"\x55\xaa\x7d\x7d",
            identifier=Field(6),
        ),
        range(0, 256, 7),
    ),
    "paxini_converter": Example(
        Packet(
            sync=(0xAA, 0x55, range(256), range(4), range(16), 0x00),
            length=Length(Field(2, 2), 5),
            maximum=200,
            checksum=LRC,
            identifier=Field(4, 4, mask=0x07_04_00_FF),
            header=8,
        ),
        (3, 0x0300_0003, 0x0400_0008, 0x0304_0001),
    ),
    "paxini_high_speed": Example(
        Packet(
            sync=(0xAA, (0x55, 0x56)),
            length=LengthTable(1, {0x55: Length(Field(6, 2), 9), 0x56: Length(Field(3, 2), 6)}),
            maximum=200,
            checksum=LRC,
            identifier=Field(1),
            header=8,
        ),
        (0x55, 0x56),
    ),
    "optoforce": Example(
        Packet(
            sync=(0xAA, 0x07, 0x08, (0x0A, 0x1C, 0x10)),
            length=Length(Field(3), 6),
            maximum=34,
            checksum=Sum(width=16, order="big"),
        ),
        (0,),
        sizes=(10, 16, 28),
    ),
    "robotiq": Example(
        Packet(
            sync=b"\x9a",
            length=Length(Field(3), 4),
            maximum=64,
            checksum=CRC8,
            checksum_at=1,
            identifier=Field(2, mask=0x0F),
        ),
        range(16),
    ),
    "agni": Example(_AGNI, (0,), (8,)),
    "agni_long": Example(_AGNI, (2,), (36,)),
    "tactile_glove": Example(
        Packet(sync=(range(0x3C, 0x7C), 0x01), length=5, trailer=b"\0", identifier=Field(0), header=2),
        range(0x3C, 0x7C),
    ),
    "octocan": Example(Packet(sync=b"\x55", length=5, confirmed=True, identifier=Field(1)), range(0, 256, 3)),
    "octocan_each": Example(Packet(sync=b"\x55", length=5, confirmed="each", identifier=Field(1)), range(0, 256, 3)),
    "glove_each": Example(
        Packet(
            sync=(range(0x3C, 0x7C), 0x01), length=5, trailer=b"\0", identifier=Field(0), header=2, confirmed="each"
        ),
        range(0x3C, 0x7C),
    ),
    "anyskin": Example(Packet(length=82, trailer=b"\r\n", confirmed=True)),
    "flexitac": Example(Packet(sync=b"\xaa\x55", length=258, confirmed="each")),
    "fixed_crc32": Example(Packet(sync=b"\xa5\x5a", length=40, checksum=CRC32)),
    "no_sync": Example(Packet(length=12, checksum=CRC16_MODBUS)),
    "big_endian": Example(
        Packet(
            sync=b"\x7e",
            length=Length(Field(1, 2, "big"), 8),
            maximum=5000,
            checksum=replace(CRC32C, order="big"),
            identifier=Field(3, mask=0x7F),
        ),
        range(128),
    ),
    "ability_hand": Example(Delimited(HDLC, maximum_body=80, checksum=LRC, identifier=Field(0)), range(0, 256, 3)),
    "hdlc_x25": Example(
        Delimited(HDLC, maximum_body=600, checksum=CRC16_X25, header=2, identifier=Field(0, 2, "big", 0x7FF)),
        (0, 0x7E, 0x7D, 0x7FF),
    ),
    "slip_sum": Example(Delimited(SLIP, maximum_body=100, checksum=SUM8)),
    "cobs_crc": Example(Delimited(COBS, maximum_body=64, checksum=CRC16_XMODEM, identifier=Field(0)), range(0, 256, 3)),
    "cobs_long": Example(Delimited(COBS, maximum_body=4000, minimum_body=0, checksum=CRC32)),
    "cobs_bare": Example(Delimited(COBS, maximum_body=32)),
    "lines": Example(Delimited(LINES, maximum_body=120)),
    "lines_and_blanks": Example(Delimited(LINES, maximum_body=200, minimum_body=0)),
}
"""By name."""

ONLY_IN_PYTHON: dict[str, Example] = {
    "recurring": Example(Recurring(b"\xaa\x55", maximum_body=60, minimum_body=4), (1,), (20, 33)),
    "text_matrix": Example(TextMatrix(rows=3, columns=4)),
}
"""By name: framings with which drivers hear what C is to find; and of text, of which little comes."""
