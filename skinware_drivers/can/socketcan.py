"""SocketCAN in batches: one ``recvmmsg`` moves all that has arrived straight into the rows of a batch.

Every frame comes with the kernel's own time stamp; what the kernel had to drop is known exactly.
"""

from __future__ import annotations

import array
import ctypes
import errno
import fcntl
import os
import socket
import struct
import time
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from skinware.errors import BusNotAvailable, BusSendError, ConfigurationError
from skinware.realtime import NS_PER_S, now_ns
from skinware_drivers.bus import ERROR_FLAG, REMOTE_FLAG, Bus, FrameBatch

# linux/can.h, linux/can/raw.h, asm-generic/socket.h, linux/net_tstamp.h, linux/sockios.h; CPython lacks the names
_SOL_CAN_RAW = 101
_CAN_RAW_ERR_FILTER = 2
_CAN_RAW_FD_FRAMES = 5
_ALL_ERRORS = 0x1FFF_FFFF
_SO_RCVBUFFORCE = 33
_SO_TIMESTAMPNS = 35
_SO_MEMINFO = 55
_MEMINFO_DROPS = 8
_SIOCGIFFLAGS = 0x8913
_IFF_UP = 1

_CONTROL_WORDS = 4  # cmsghdr (2 words), then a timespec
WANTED_BUFFER_BYTES = 8 << 20
"""Receive buffer that is asked for: about 10,900 frames, 1.3 s of a full 1 Mbit/s bus."""

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


class SocketCanBus(Bus):
    """A CAN interface of the kernel (``can0``, ``vcan0``, ``slcan0``).

    Options: ``buffer``: receive buffer in bytes, default 8 MiB. The bit rate is set where the interface is set up
    (``ip link set can0 type can bitrate 1000000``).
    """

    medium: ClassVar[str] = "can"

    def __init__(
        self,
        channel: str,
        options: dict[str, str] | None = None,
        *,
        payload_size: int = 8,
        listen_only: bool = False,
    ) -> None:
        super().__init__(channel, options, payload_size=payload_size, listen_only=listen_only)
        unknown = set(self.options) - {"buffer"}
        if unknown:
            raise ConfigurationError(f"bus {channel}: unknown option {sorted(unknown)[0]!r}. Known: buffer")
        try:
            self._wanted_buffer = int(self.options.get("buffer", WANTED_BUFFER_BYTES))
        except ValueError:
            raise ConfigurationError(f"bus {channel}: buffer={self.options['buffer']} is no number of bytes") from None
        self._socket: socket.socket | None = None
        self._lost_before = 0
        self.granted_buffer = 0
        self._last_poll_ns = 0
        self._rows = _Rows(FrameBatch(1, payload_size))

    def open(self) -> None:
        """Open and bind the socket.

        Raises:
            BusNotAvailable: no CAN in the kernel, no such interface, not a CAN interface, down, or not permitted.
        """
        try:
            sock = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
        except OSError as error:
            if error.errno == errno.EAFNOSUPPORT:
                raise BusNotAvailable(
                    "this kernel has no CAN: load it (modprobe can-raw), or use a bus that needs none (--bus virtual)"
                ) from None
            raise BusNotAvailable(f"bus {self.channel}: cannot open a CAN socket ({error.strerror})") from None
        try:
            if self.payload_size > 8:
                sock.setsockopt(_SOL_CAN_RAW, _CAN_RAW_FD_FRAMES, 1)
            sock.setsockopt(_SOL_CAN_RAW, _CAN_RAW_ERR_FILTER, _ALL_ERRORS)
            sock.bind((self.channel,))
            if not _is_up(sock, self.channel):
                raise BusNotAvailable(
                    f"bus {self.channel} is down; bring it up: ip link set {self.channel} up", is_down=True
                )
        except OSError as error:
            sock.close()
            raise BusNotAvailable(_why_not_bound(self.channel, error)) from None
        except BusNotAvailable:
            sock.close()
            raise
        self.adopt(sock)

    def adopt(self, sock: socket.socket) -> None:
        """Receive from an open socket whose datagrams are ``struct can_frame`` (or canfd_frame)."""
        self.granted_buffer = _enlarge_buffer(sock, self._wanted_buffer)
        # not SO_TIMESTAMPING: that costs 20 ns a frame more, and leaves frames unstamped that came before the kernel
        # began to stamp (in the background)
        sock.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
        sock.setblocking(False)
        self._socket = sock
        self._lost_before = self.counters.lost
        self._last_poll_ns = now_ns()

    @property
    def note(self) -> str:
        """A receive buffer that is smaller than was asked for, and what to do about it."""
        if not self._socket or self.granted_buffer >= self._wanted_buffer:
            return ""
        return (
            f"bus {self.channel}: receive buffer of {self.granted_buffer} bytes granted, {self._wanted_buffer} wanted;"
            f" for more, run with CAP_NET_ADMIN or: sysctl net.core.rmem_max={self._wanted_buffer}"
        )

    def fileno(self) -> int:
        """The socket, -1 while closed."""
        return self._socket.fileno() if self._socket else -1

    def receive(self, batch: FrameBatch, ordinal: int) -> int:
        """Append what has arrived; see :class:`skinware_drivers.bus.Bus`."""
        if self._socket is None:
            raise BusNotAvailable(f"bus {self.channel} is not open")
        if not batch.free:
            return 0
        if self._rows.batch is not batch:
            self._rows = _Rows(batch)
        first = batch.stop
        count = self._rows.receive(self._socket.fileno())
        if count < 0:
            return self._nothing_received(ctypes.get_errno())
        batch.time_ns[first : first + count] = self._stamps(self._rows.control[first : first + count])
        batch.bus[first : first + count] = ordinal
        kept = self._sort_out(batch, first, count)
        batch.stop += kept
        self.counters.frames += kept
        self.counters.lost = self._lost_before + self._kernel_drops()
        return kept

    def send(self, identifier: int, payload: bytes) -> None:
        """Send one frame; see :class:`skinware_drivers.bus.Bus`."""
        if self.listen_only:
            raise BusSendError(f"bus {self.channel} is opened to listen only")
        if self._socket is None:
            raise BusSendError(f"bus {self.channel} is not open")
        size = 8 if len(payload) <= 8 else 64
        frame = struct.pack("=IB3x", identifier, len(payload)) + payload.ljust(size, b"\0")
        try:
            self._socket.send(frame)
        except OSError as error:
            self.counters.send_failures += 1
            raise BusSendError(f"bus {self.channel}: frame {identifier:03X} not sent ({error.strerror})") from None
        self.counters.sent += 1

    def close(self) -> None:
        """Close the socket. Idempotent."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _nothing_received(self, number: int) -> int:
        if number in (errno.EAGAIN, errno.EINTR):
            return 0
        if number == errno.ENETDOWN:
            raise BusNotAvailable(f"bus {self.channel} went down", is_down=True)
        raise BusNotAvailable(f"bus {self.channel} vanished ({os.strerror(number)})")

    def _stamps(self, control: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
        """Kernel stamps on our clock: CLOCK_REALTIME with an offset sampled now, so that clock steps do no harm."""
        poll_ns = now_ns()
        offset_ns = poll_ns - time.time_ns()
        stamps = control[:, 2] * NS_PER_S + control[:, 3] + offset_ns
        np.maximum(stamps, self._last_poll_ns, out=stamps)
        np.minimum(stamps, poll_ns, out=stamps)
        # one batch may be taken in several calls, so frames of this call can be older than its predecessor's end
        self._last_poll_ns = min(int(stamps[-1]), poll_ns)
        return stamps

    def _sort_out(self, batch: FrameBatch, first: int, count: int) -> int:
        """Take error and remote frames out of the new rows; returns how many are left."""
        rows = slice(first, first + count)
        identifier = batch.wire["identifier"][rows]
        flags = np.uint32(ERROR_FLAG | REMOTE_FLAG)
        if not np.bitwise_or.reduce(identifier) & flags:
            return count
        special = identifier & flags
        is_error = (special & np.uint32(ERROR_FLAG)) != 0
        self.counters.error_frames += int(is_error.sum())
        self.counters.refused += int(((special != 0) & ~is_error).sum())
        good = first + np.flatnonzero(special == 0)
        kept = slice(first, first + len(good))
        batch.wire[kept], batch.time_ns[kept], batch.bus[kept] = batch.wire[good], batch.time_ns[good], batch.bus[good]
        return len(good)

    def _kernel_drops(self) -> int:
        if self._socket is None:
            return 0
        words = array.array("I", self._socket.getsockopt(socket.SOL_SOCKET, _SO_MEMINFO, 4 * (_MEMINFO_DROPS + 1)))
        return words[_MEMINFO_DROPS]


class _Rows:
    """What ``recvmmsg`` needs to put frames straight into the rows of one batch, made once.

    Attributes:
        batch: the batch.
        control: (capacity, 4) int64, ancillary data of each row.
    """

    def __init__(self, batch: FrameBatch) -> None:
        capacity, rows = batch.capacity, np.arange(batch.capacity)
        self.batch = batch
        self.control = np.zeros((capacity, _CONTROL_WORDS), np.int64)
        self._iov = np.zeros(capacity, _IOVEC)
        self._iov["base"] = batch.wire.ctypes.data + batch.wire.strides[0] * rows
        self._iov["length"] = batch.wire.strides[0]
        self._headers = np.zeros(capacity, _MMSGHDR)
        self._headers["iov"] = self._iov.ctypes.data + _IOVEC.itemsize * rows
        self._headers["iov_count"] = 1
        self._headers["control"] = self.control.ctypes.data + self.control.strides[0] * rows
        self._control_length = self._headers["control_length"]
        self._address = self._headers.ctypes.data

    def receive(self, fd: int) -> int:
        """Fill the free rows of the batch; returns how many were filled, -1 on an error (errno)."""
        first, free = self.batch.stop, self.batch.free
        self._control_length[first:] = 8 * _CONTROL_WORDS  # the kernel wrote what it used
        address = self._address + _MMSGHDR.itemsize * first
        count: int = _recvmmsg(fd, address, free, socket.MSG_DONTWAIT, None)
        return count


def _enlarge_buffer(sock: socket.socket, wanted: int) -> int:
    """Ask for a receive buffer, with force if we may; returns what the kernel granted (it doubles what is set)."""
    try:
        sock.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, wanted // 2)
    except PermissionError:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, wanted // 2)
    return sock.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)


def _is_up(sock: socket.socket, interface: str) -> bool:
    request = struct.pack("16sH14x", interface.encode(), 0)
    flags: int = struct.unpack("16sH14x", fcntl.ioctl(sock, _SIOCGIFFLAGS, request))[1]
    return bool(flags & _IFF_UP)


def _why_not_bound(interface: str, error: OSError) -> str:
    if error.errno == errno.ENODEV:
        others = ", ".join(name for _, name in socket.if_nameindex() if "can" in name) or "none"
        return f"there is no CAN interface {interface!r}; CAN interfaces here: {others} (see: ip link)"
    if error.errno in (errno.EPERM, errno.EACCES):
        return f"bus {interface}: not permitted ({error.strerror}); ask for access to the interface"
    return f"bus {interface}: cannot be opened ({error.strerror})"
