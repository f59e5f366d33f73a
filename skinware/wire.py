"""What goes over the wires of drivers, in pieces: frames of a CAN bus, or bytes of a serial line, with their times.

A piece, all little-endian::

    PIECE            16 bytes
    time_ns <i8[n]   CLOCK_MONOTONIC; of frames one each, of bytes one for all
    frames           n of CLASSIC or FD; or ``count`` bytes, filled up with zeros to a multiple of 8

A driver puts pieces together while they happen, in Python and in C, and publishes them as a service of kind
:data:`KIND`, a frame of which has pieces of one bus. Recordings keep them as they are.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

KIND = "wire"
"""Kind of a service that tells what goes over the wires of a driver."""
WISH = "~wire"
"""What somebody announces who wants it (:func:`skinware.memory.announcement.is_wished`); no service has this name."""
BATCH_BYTES = 1 << 15
"""Pieces of a frame of such a service, at most."""
MOST_FRAMES, MOST_BYTES = 64, 1 << 14
"""Of one piece."""

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
"""Flag of a frame that is longer than any that its driver knows: ``length`` tells how much of it is there."""

COLUMNS: dict[str, Any] = {"bus": ("<u2", ()), "used": ("<u4", ()), "lost": ("<u8", ()), "pieces": ("u1", BATCH_BYTES)}
"""Of such a service. ``used``: bytes of the pieces; ``lost``: frames or bytes of the bus that there was no room for
so far. Static columns: ``driver``, its name, ``bus_name``, those of its buses, and ``about``, JSON: what the driver is,
and with which options (``driver_type``, ``listen_only``, ``versions``; ``buses`` with ``medium`` and ``options``)."""


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
    """The pieces that some bytes consist of.

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
    """A piece and its size; None if there is none."""
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
