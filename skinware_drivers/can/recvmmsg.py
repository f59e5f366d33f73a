"""Receive all datagrams that have arrived into the rows of a batch, with one system call (``recvmmsg``)."""

from __future__ import annotations

import ctypes
import socket
from weakref import WeakKeyDictionary

import numpy as np
import numpy.typing as npt

from skinware_drivers.bus import FrameBatch

CONTROL_WORDS = 8
"""8-byte words of ancillary data kept for each datagram: a header (2 words), then one ``timespec`` or three."""
_MMSGHDR = np.dtype(
    [
        ("name", np.uint64),
        ("name_length", np.uint64),
        ("iov", np.uint64),
        ("iov_count", np.uint64),
        ("control", np.uint64),
        ("control_length", np.uint64),
        ("flags", np.uint64),
        ("length", np.uint64),
    ]
)
"""``struct mmsghdr`` of a 64-bit Linux; int members are read and written with their padding."""
_IOVEC = np.dtype([("base", np.uint64), ("length", np.uint64)])

_recvmmsg = ctypes.CDLL(None, use_errno=True).recvmmsg
_recvmmsg.argtypes = [ctypes.c_int, ctypes.c_void_p, ctypes.c_uint, ctypes.c_int, ctypes.c_void_p]
_recvmmsg.restype = ctypes.c_int


_CLASSIC_ROW_BYTES, _FD_FRAME_BYTES = 16, 72
"""``struct can_frame`` and ``struct canfd_frame``; the kernel always hands out the whole of the latter."""


class Rows:
    """The arguments of ``recvmmsg`` for the rows of one batch; see ``rows_of``.

    The end of a CAN FD frame that is longer than a row goes into a scratch buffer.

    Attributes:
        control: (capacity, CONTROL_WORDS) int64, ancillary data of each row. Where the kernel writes none, an earlier
            frame's data remains (see ``forget``).
        headers_address: address of the ``mmsghdr`` of the first row.
    """

    def __init__(self, batch: FrameBatch) -> None:
        capacity, rows = batch.capacity, np.arange(batch.capacity)
        self.control: npt.NDArray[np.int64] = np.zeros((capacity, CONTROL_WORDS), np.int64)
        row_bytes = batch.wire.strides[0]
        beyond = _FD_FRAME_BYTES - row_bytes if row_bytes > _CLASSIC_ROW_BYTES else 0
        self._beyond = np.zeros(_FD_FRAME_BYTES, np.uint8)
        self._iov = np.zeros((capacity, 2), _IOVEC)
        self._iov["base"][:, 0] = batch.wire.ctypes.data + row_bytes * rows
        self._iov["length"][:, 0] = row_bytes
        self._iov["base"][:, 1] = self._beyond.ctypes.data
        self._iov["length"][:, 1] = max(0, beyond)
        self._headers = np.zeros(capacity, _MMSGHDR)
        self._headers["iov"] = self._iov.ctypes.data + self._iov.strides[0] * rows
        self._headers["iov_count"] = 2 if beyond > 0 else 1
        self._headers["control"] = self.control.ctypes.data + self.control.strides[0] * rows
        self._control_length = self._headers["control_length"]
        self._flags, self._length = self._headers["flags"], self._headers["length"]
        self.headers_address: int = self._headers.ctypes.data

    def receive(self, fd: int, free: slice) -> int:
        """Fill free rows of the batch; return how many were filled, -1 on an error (errno)."""
        self._control_length[free] = 8 * CONTROL_WORDS  # the kernel wrote what it used
        address = self.headers_address + _MMSGHDR.itemsize * free.start
        count: int = _recvmmsg(fd, address, free.stop - free.start, socket.MSG_DONTWAIT, None)
        return count

    def forget(self, rows: slice) -> None:
        """Clear ancillary data before frames are received that may have none of their own."""
        self.control[rows] = 0

    def cut(self, rows: slice) -> npt.NDArray[np.bool_]:
        """Return (n,) bool: the datagrams that were longer than their row: FD frames, though the layout has none."""
        found: npt.NDArray[np.bool_] = (self._flags[rows] & np.uint64(socket.MSG_TRUNC)) != 0
        return found

    def are_fd(self, rows: slice) -> npt.NDArray[np.bool_]:
        """Return (n,) bool: the CAN FD frames, whatever their flags say; valid right after receiving only."""
        found: npt.NDArray[np.bool_] = (self._length[rows] & np.uint64(0xFFFF_FFFF)) == _FD_FRAME_BYTES
        return found | self.cut(rows)


_rows: WeakKeyDictionary[FrameBatch, Rows] = WeakKeyDictionary()


def rows_of(batch: FrameBatch) -> Rows:
    """Return the arguments for a batch, made once: all buses that fill the batch share them."""
    rows = _rows.get(batch)
    if rows is None:
        rows = _rows[batch] = Rows(batch)
    return rows
