"""Receive all datagrams that have arrived with one system call (``recvmmsg``), and date them on CLOCK_MONOTONIC.

The time is that of the kernel's stamps or of the controller's clock (decision 7).
"""

from __future__ import annotations

import ctypes
import fcntl
import socket
import struct
import time
from typing import Literal
from weakref import WeakKeyDictionary

import numpy as np
import numpy.typing as npt

from skinware.realtime import NS_PER_S, now_ns
from skinware_drivers.bus import FrameBatch
from skinware_drivers.device_time import DeviceClock

Stamps = npt.NDArray[np.int64]

LONGEST_DELAY_NS = 100_000_000
"""No frame had its stamp longer before the kernel had the frame."""
_PART_NS, _JUMP_NS = 250_000_000, 10_000_000  # of the clock of a controller

Stamping = Literal["auto", "hardware", "software"]

# asm-generic/socket.h, linux/net_tstamp.h, linux/ethtool.h
_SO_TIMESTAMPNS, _SO_TIMESTAMPING = 35, 37
_RX_HARDWARE, _RX_SOFTWARE, _SOFTWARE, _RAW_HARDWARE = 1 << 2, 1 << 3, 1 << 4, 1 << 6
_SIOCETHTOOL, _ETHTOOL_GET_TS_INFO = 0x8946, 0x41
_TS_INFO_BYTES = 44
_SOFTWARE_WORD, _HARDWARE_WORD = 2, 6  # words of the ancillary data: seconds, then nanoseconds

_CLOCK_READS = 3
_SLEW_NS = 2_000_000
"""A larger change of CLOCK_REALTIME between two polls is a step: it is disciplined by far less."""


def has_hardware_stamps(sock: socket.socket, interface: str) -> bool:
    """Return whether the controller of an interface stamps the frames that it receives."""
    info = bytearray(struct.pack("=I", _ETHTOOL_GET_TS_INFO).ljust(_TS_INFO_BYTES, b"\0"))
    buffer = np.frombuffer(info, np.uint8)
    request = struct.pack("=16sQ", interface.encode(), buffer.ctypes.data).ljust(40, b"\0")
    try:
        fcntl.ioctl(sock, _SIOCETHTOOL, request)
    except OSError:
        return False
    (flags,) = struct.unpack_from("=I", info, 4)
    return bool(flags & _RX_HARDWARE and flags & _RAW_HARDWARE)


class Stamper:
    """Reads the stamps of one socket.

    Software stamps are CLOCK_REALTIME. They are converted with an offset that is sampled at every poll, so that steps
    of that clock do no harm: a frame lies between two polls, and only one of the offsets before and after a step puts
    it there. Hardware stamps are on the controller's clock, which may be set or restarted at any time.

    Attributes:
        hardware: read the controller's stamps, too.
        offset_ns: CLOCK_MONOTONIC - CLOCK_REALTIME, ns.
        last_poll_ns: CLOCK_MONOTONIC ns.
    """

    def __init__(self, hardware: bool = False) -> None:
        self.hardware = hardware
        self._clock = DeviceClock(1e-9, 1 << 62, part_ns=_PART_NS, jump_ns=_JUMP_NS)
        self.last_poll_ns = now_ns()
        self.offset_ns = _offset_now_ns()[0]

    def switch_on(self, sock: socket.socket) -> None:
        if self.hardware:
            flags = _RX_HARDWARE | _RAW_HARDWARE | _RX_SOFTWARE | _SOFTWARE
            sock.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPING, flags)
        else:
            # 20 ns a frame cheaper, and stamps also frames from before the kernel began to stamp (in the background)
            sock.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)

    def read(self, control: Stamps) -> Stamps:
        """Return (n,) int64, CLOCK_MONOTONIC ns: when the frames of (n, 8) int64 ancillary data arrived, in order."""
        before_ns = self.offset_ns
        self.offset_ns, poll_ns = _offset_now_ns()
        software = control[:, _SOFTWARE_WORD] * NS_PER_S + control[:, _SOFTWARE_WORD + 1]
        stamps: Stamps = software + self.offset_ns
        is_step = abs(self.offset_ns - before_ns) > _SLEW_NS
        if is_step:
            other = software + before_ns
            is_other = (other >= self.last_poll_ns) & (other <= poll_ns)
            is_other &= (stamps < self.last_poll_ns) | (stamps > poll_ns)
            stamps[is_other] = other[is_other]
        if self.hardware:
            stamps[software == 0] = poll_ns
        np.maximum(stamps, self.last_poll_ns, out=stamps)
        np.minimum(stamps, poll_ns, out=stamps)
        if is_step:
            np.maximum.accumulate(stamps, out=stamps)
        else:
            # the kernel begins to stamp in the background: earlier frames have the time at which they were read
            stamps = np.minimum.accumulate(stamps[::-1])[::-1]
        # one batch may be taken in several calls, so frames of this call can be older than its predecessor's end
        self.last_poll_ns = min(int(stamps[-1]), poll_ns)
        if self.hardware:
            return self.by_controller(control[:, _HARDWARE_WORD] * NS_PER_S + control[:, _HARDWARE_WORD + 1], stamps)
        return stamps

    def by_controller(self, hardware: Stamps, software: Stamps) -> Stamps:
        """Return (n,) int64, CLOCK_MONOTONIC ns: when frames were on the wire.

        Args:
            hardware: (n,) int64, stamps of the controller, ns, in order; 0: none.
            software: (n,) int64, stamps of the kernel, CLOCK_MONOTONIC ns; kept where the controller gave none.
        """
        stamps, known = software.copy(), np.flatnonzero(hardware)
        earliest_ns = software[known] - LONGEST_DELAY_NS
        stamps[known] = np.maximum(self._clock.convert(hardware[known], software[known]), earliest_ns)
        return stamps


def _offset_now_ns() -> tuple[int, int]:
    """Return (CLOCK_MONOTONIC - CLOCK_REALTIME, CLOCK_MONOTONIC), ns; a pause between the two readings does no harm."""
    best_ns, offset_ns, poll_ns = NS_PER_S, 0, 0
    for _ in range(_CLOCK_READS):
        first_ns, real_ns, second_ns = now_ns(), time.time_ns(), now_ns()
        if second_ns - first_ns < best_ns or not poll_ns:
            best_ns, offset_ns = second_ns - first_ns, (first_ns + second_ns) // 2 - real_ns
        poll_ns = second_ns
        if best_ns < 2000:
            break
    return offset_ns, poll_ns


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
