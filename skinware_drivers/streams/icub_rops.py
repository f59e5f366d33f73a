"""Frames of remote operations, as the Ethernet boards of iCub send them by UDP; skin data are CAN frames in them.

Source: robotology/icub-firmware-shared, eth/embobj (EOropframe_hid.h, EOrop.h, EOrop.c, EoProtocol.h, EoProtocolSK.h,
EoSkin.h, EOarray.h). All little-endian:

* A frame: start 12345678 u32, bytes of the operations u16, their number u16, time in us u64, sequence number u64;
  the operations; end 87654321 u32.
* An operation: control u8 (bit 2: time follows, bit 3: signature follows; bits 6 and 7: version 0), code u8 (2 say,
  4 signal), bytes of data u16, variable u32; the data, filled up to a multiple of four; signature u32; time u64.
* The variable of a board's skin: ``endpoint 3 | entity 0 | skin | tag 2``, a byte each from the highest. A board has a
  skin on each of its two CAN ports. Its data are an array: room u8, bytes of an item (10) u8, items u8, u8; then items,
  each ``length << 12 | CAN identifier`` u16 and eight bytes. Regular signals have room for 24 items, used or not.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator

from skinware_drivers.serial.framing import Field
from skinware_drivers.serial.packets import Length, Packet
from skinware_drivers.serial.splitting import Split

_HEADER, _OVERHEAD, _LONGEST_DATAGRAM = 24, 28, 1500
_HEAD = struct.Struct("<BBHI")
_SAY, _SIGNAL = 2, 4
_TIME, _SIGNATURE, _VERSION = 0x04, 0x08, 0xC0
_SKIN = 0x0300_0002
_ITEM, _LONGEST_CAN = 10, 8


def rops(port: int) -> Split:
    """The framing; what it finds are the CAN frames of the skin on a CAN port, 1 or 2."""
    return Split(_FRAMES, lambda _, operations: _can_frames(operations, _SKIN | (port - 1) << 8))


def _can_frames(operations: bytes, wanted: int) -> Iterator[tuple[int, bytes]]:
    """The CAN frames in those operations of a frame that tell a variable: (identifier, payload)."""
    place = 0
    while len(operations) - place >= _HEAD.size:
        control, code, size, variable = _HEAD.unpack_from(operations, place)
        begin = place + _HEAD.size
        place = begin + -(-size // 4) * 4 + (4 if control & _SIGNATURE else 0) + (8 if control & _TIME else 0)
        if control & _VERSION or place > len(operations):
            return  # where the next one begins is not known
        if code in (_SAY, _SIGNAL) and variable == wanted:
            yield from _items(operations[begin : begin + size])


def _items(array: bytes) -> Iterator[tuple[int, bytes]]:
    if len(array) < 4 or array[1] != _ITEM or array[2] > array[0]:
        return
    for at in range(4, min(len(array) - _ITEM, 4 + _ITEM * (array[2] - 1)) + 1, _ITEM):
        info = array[at] | array[at + 1] << 8
        length = info >> 12
        if length <= _LONGEST_CAN:
            yield info & 0x7FF, array[at + 2 : at + 2 + length]


_FRAMES = Packet(
    sync=(0x78, 0x56, 0x34, 0x12),
    length=Length(Field(4, 2), more=_OVERHEAD),
    maximum=_LONGEST_DATAGRAM,
    trailer=(0x21, 0x43, 0x65, 0x87),
    header=_HEADER,
)
