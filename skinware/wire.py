"""Pieces of the traffic on the wires of drivers: frames of a CAN bus, or bytes of a serial line, with their times.

A piece, all little-endian::

    PIECE            16 bytes
    time_ns <i8[n]   CLOCK_MONOTONIC; of frames one each, of bytes one for all
    frames           n of CLASSIC or FD; or ``count`` bytes, filled up with zeros to a multiple of 8

A driver puts pieces together while they happen, in Python and in C, and publishes them as a service of kind
:data:`KIND`, a frame of which has pieces of one bus. Recordings keep them as they are.
"""

from __future__ import annotations

import struct
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

KIND = "wire"
"""Kind of a service with the traffic on the wires of a driver."""
WISH = "~wire"
"""Announced by programs that want it (:func:`skinware.memory.announcement.is_wished`); no service has this name."""
BATCH_BYTES = 1 << 15
"""Pieces of a frame of such a service, at most."""
MOST_FRAMES, MOST_BYTES = 64, 1 << 14
"""Size of one piece at most."""

CLASSIC, FD, BYTES = 1, 2, 3
"""Forms of a piece: ``struct can_frame``, ``struct canfd_frame``, and bytes of a serial line."""
PIECE = np.dtype([("size", "<u4"), ("count", "<u4"), ("form", "u1"), ("is_sent", "u1"), ("reserved", "u1", (6,))])
"""``size``: of the whole piece; ``count``: of its frames or bytes; ``is_sent``: by the driver, not received."""
ROWS: dict[int, np.dtype[Any]] = {
    form: np.dtype(
        [("identifier", "<u4"), ("length", "u1"), ("flags", "u1"), ("reserved", "<u2"), ("payload", "u1", (size,))]
    )
    for form, size in ((CLASSIC, 8), (FD, 64))
}
"""Frames of a piece. Identifiers have the flags of linux/can.h: 29 bits, remote frame, error frame."""
EXTENDED, REMOTE, ERROR, MASK = 0x8000_0000, 0x4000_0000, 0x2000_0000, 0x1FFF_FFFF
"""Flags of an identifier: 29 bits, remote frame, error frame; and its own bits."""
IS_FD = 0x04
"""Flag of a CAN FD frame (``CANFD_FDF``)."""
IS_CUT = 0x80
"""Flag of a frame that is longer than any that its driver knows: ``length`` is that of the part that is there."""

COLUMNS: dict[str, Any] = {
    "bus": ("<u2", ()),
    "used": ("<u4", ()),
    "missed": ("<u8", ()),
    "pieces": ("u1", BATCH_BYTES),
}
"""Columns of such a service. ``used``: bytes of the pieces; ``missed``: frames or bytes of the bus for which there was
no room so far. Static columns: ``driver``, its name, ``bus_name``, the names of its buses, and ``about``, JSON: the
driver and its options (``driver_type``, ``listen_only``, ``versions``; ``buses`` with ``medium`` and ``options``)."""


SOCKETCAN, SERIAL = 227, 147
"""Link types of interfaces in pcapng: LINKTYPE_CAN_SOCKETCAN, and LINKTYPE_USER0 with :data:`SERIAL_HEADER`."""
SERIAL_HEADER = struct.Struct("<BBH")
"""In front of the bytes of a packet of a serial line: version (1), 0 received or 1 sent, 0."""


class WireItem(NamedTuple):
    """A frame of a CAN bus, or bytes of a serial line that were read or written together.

    Attributes:
        time_ns: CLOCK_MONOTONIC.
        epoch_ns: the same, ns since 1970.
        is_sent: the driver sent it; False: it received it.
        identifier: with the flags of linux/can.h; None for bytes.
        flags: of :data:`ROWS`.
        data: payload, or bytes.
    """

    time_ns: int
    epoch_ns: int
    is_sent: bool
    identifier: int | None
    flags: int
    data: bytes


class Piece(NamedTuple):
    """Frames or bytes that came, or were sent, together.

    Attributes:
        is_sent: by the driver, not received.
        time_ns: (n,) int64, CLOCK_MONOTONIC, of each frame; (1,) of bytes.
        frames: (n,) of ``ROWS``; None of bytes.
        data: bytes; empty of frames.
    """

    is_sent: bool
    time_ns: npt.NDArray[np.int64]
    frames: npt.NDArray[np.void] | None
    data: bytes


def service_name(driver: str) -> str:
    return f"{driver[:42]}-wire"


def size_of(form: int, count: int) -> int:
    if form == BYTES:
        return PIECE.itemsize + 8 + -(-count // 8) * 8
    return PIECE.itemsize + count * (8 + ROWS[form].itemsize)


def read_pieces(data: bytes | memoryview) -> tuple[list[Piece], bool]:
    """Return the pieces that some bytes consist of.

    Returns:
        (pieces, whether the bytes end as a piece does): what comes after something that is none is left out.
    """
    pieces: list[Piece] = []
    at, whole = 0, memoryview(data)
    while at < len(whole):
        piece = _read_piece(whole[at:])
        if piece is None:
            return pieces, False
        pieces.append(piece[0])
        at += piece[1]
    return pieces, True


def _read_piece(data: memoryview) -> tuple[Piece, int] | None:
    """Return a piece and its size; None if there is none."""
    if len(data) < PIECE.itemsize:
        return None
    head = np.frombuffer(data, PIECE, 1)[0]
    form, count, size = int(head["form"]), int(head["count"]), int(head["size"])
    if form not in (CLASSIC, FD, BYTES) or size != size_of(form, count) or size > len(data):
        return None
    is_frames = form in ROWS
    time_ns = np.frombuffer(data, "<i8", count if is_frames else 1, PIECE.itemsize)
    rest = PIECE.itemsize + time_ns.nbytes
    is_sent = bool(head["is_sent"])
    if is_frames:
        return Piece(is_sent, time_ns, np.frombuffer(data, ROWS[form], count, rest), b""), size
    return Piece(is_sent, time_ns, None, bytes(data[rest : rest + count])), size


_TOLD = 0x03
"""Flags of a CAN FD frame that the text has."""
_LONGEST_INTERFACE = 15  # IFNAMSIZ without its end


def candump_line(
    epoch_us: int, channel: str, identifier: int, fd_flags: int | None, payload: bytes, direction: str = ""
) -> str:
    """Return a frame as ``candump -L`` writes it, and ``canplayer`` and python-can read it.

    ::

        (1700000000.123456) vcan0 473#40F0F0F0F0F0F0F0      11-bit identifier: three digits
        (1700000000.123456) vcan0 12345678#0102             29-bit identifier: eight digits
        (1700000000.123456) vcan0 473##1112233              CAN FD: ## and the flags (1 bit-rate switch, 2 error)
        (1700000000.123456) vcan0 123#R                     remote frame
        (1700000000.123456) vcan0 20000004#0004000000000000 error frame: eight digits, with its flag

    Source: can-utils lib.h and the manual of candump.

    Args:
        epoch_us: when, microseconds since 1970.
        identifier: with the flags of linux/can.h.
        fd_flags: of a CAN FD frame; None of a classic one.
        direction: ``R`` received, ``T`` sent; empty: not known.
    """
    seconds, microseconds = divmod(epoch_us, 1_000_000)
    if identifier & ERROR:
        name = f"{identifier & (MASK | ERROR):08X}"
    else:
        name = f"{identifier & MASK:08X}" if identifier & EXTENDED else f"{identifier & MASK:03X}"
    data = "R" if identifier & REMOTE and not identifier & ERROR else payload.hex().upper()
    flags = "" if fd_flags is None else f"#{fd_flags & _TOLD:X}"
    behind = f" {direction}" if direction else ""
    return f"({seconds}.{microseconds:06d}) {channel} {name}#{flags}{data}{behind}"


def channel_name(interface: str, channel: str) -> str:
    """Return a name without blanks that can stand for an interface: ``can0``, ``ttyACM0``, ``virtual``."""
    name = channel.rpartition("/")[2] or interface
    return "".join(letter if letter.isalnum() or letter in "._-" else "_" for letter in name)[:_LONGEST_INTERFACE]
