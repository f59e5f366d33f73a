"""SocketCAN in batches: one ``recvmmsg`` moves many frames into the rows of a batch (``native/receiving.c``).

Every frame carries the kernel's own time stamp, and the kernel counts the frames that it drops.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import fcntl
import os
import socket
import struct
import time
from collections.abc import Sequence
from typing import Annotated, ClassVar, Literal

import msgspec
import numpy as np

from skinware.errors import BusNotAvailable, BusSendError, ConfigurationError
from skinware.realtime import now_ns
from skinware.status import BusReason, Unused
from skinware.wire import IS_FD
from skinware_drivers import native
from skinware_drivers.bus import ERROR_FLAG, REMOTE_FLAG, Filter, FrameBatch, KernelBus, identifier_text
from skinware_drivers.can.controller import (
    CONTROLLER_STATES,
    NO_CAN,
    ControllerHealth,
    has_hardware_stamps,
    is_missing,
    read_controller,
    stamp_frames,
)
from skinware_drivers.native import structs
from skinware_drivers.native.compiling import compile_batch
from skinware_drivers.native.device_time import DeviceClock
from skinware_drivers.options import options_from_strings

# linux/can.h, linux/can/raw.h, asm-generic/socket.h, linux/sockios.h; CPython lacks the names
_SOL_CAN_RAW = 101
_CAN_RAW_FILTER = 1
_CAN_RAW_ERR_FILTER = 2
_CAN_RAW_FD_FRAMES = 5
_CANFD_BRS = 0x01
_CLASSIC_PAYLOAD = 8
_FD_LENGTHS = (12, 16, 20, 24, 32, 48, 64)
_ALL_ERRORS = 0x1FFF_FFFF
_SO_RCVBUFFORCE = 33
_SIOCGIFFLAGS = 0x8913
_IFF_UP = 1
MOST_FILTERS = 512
"""``CAN_RAW_FILTER_MAX`` of linux/can/raw.h."""
_AWAY = (errno.ENETDOWN, errno.ENODEV, errno.ENXIO)

_FLAGS_AT = 5  # in struct canfd_frame
_CLOCK_PART_NS, _CLOCK_JUMP_NS = 250_000_000, 10_000_000  # of the clock of a controller
_SMALL_BUFFER = 1 << 17  # it may be full before so many frames wait that C asks for losses

WANTED_BUFFER_BYTES = 8 << 20
"""Requested receive buffer: about 10,900 frames, 1.3 s of a full 1 Mbit/s bus."""


class SocketCanOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Options behind the name of a CAN interface: ``can0?buffer=100000``."""

    buffer: Annotated[int, msgspec.Meta(description="receive buffer, bytes", ge=1)] = WANTED_BUFFER_BYTES
    timestamps: Annotated[
        Literal["auto", "hardware", "software"],
        msgspec.Meta(description="source of time stamps: the controller, the kernel, or the best available"),
    ] = "auto"
    bitrate_switch: Annotated[
        Literal["on", "off"], msgspec.Meta(description="send the payload of CAN FD frames at the data bit rate")
    ] = "on"
    filter: Annotated[
        Literal["on", "off"],
        msgspec.Meta(description="let the kernel drop frames that the driver does not know; they are not counted"),
    ] = "off"


class SocketCanBus(KernelBus):
    """A CAN interface of the kernel (``can0``, ``vcan0``, ``slcan0``).

    Options: :class:`SocketCanOptions`. The bit rate is set where the interface is set up (``ip link set can0 type can
    bitrate 1000000``).
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
        try:
            self._wanted = options_from_strings(SocketCanOptions, self.options)
        except ConfigurationError as error:
            raise ConfigurationError(f"bus {channel}: {error}") from None
        self.narrows: bool = self._wanted.filter == "on"
        self._filters: Sequence[Filter] = ()
        self._socket: socket.socket | None = None
        self.granted_buffer: int = 0
        self._can = structs.CanSocket(speed_up=1.0)
        self._clock: DeviceClock | None = None
        self._batch, self._rows = FrameBatch(0), structs.Batch()
        self._health = ControllerHealth()
        self._is_bound = False
        self._restarts_itself = True

    def open(self) -> None:
        try:
            sock = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
        except OSError as error:
            if error.errno == errno.EAFNOSUPPORT:
                raise BusNotAvailable(NO_CAN) from None
            raise BusNotAvailable(
                f"bus {self.channel}: cannot open a CAN socket ({error.strerror})", reason=BusReason.REFUSED
            ) from None
        try:
            # also if the layout has none: FD frames on the bus explain why no others are heard
            sock.setsockopt(_SOL_CAN_RAW, _CAN_RAW_FD_FRAMES, 1)
            sock.setsockopt(_SOL_CAN_RAW, _CAN_RAW_ERR_FILTER, _ALL_ERRORS)
            if self._filters:
                _set_filters(sock, self._filters)
            if is_missing(self.channel):
                raise OSError(errno.ENODEV, os.strerror(errno.ENODEV))
            sock.bind((self.channel,))
            if not _is_up(sock, self.channel):
                raise BusNotAvailable(
                    f"bus {self.channel} is down; bring it up: ip link set {self.channel} up", is_down=True
                )
        except OSError as error:
            sock.close()
            raise _why_not_bound(self.channel, error) from None
        except BusNotAvailable:
            sock.close()
            raise
        self.adopt(sock)
        self._is_bound = True
        self._health.reset()
        self._ask_kernel()

    def adopt(self, sock: socket.socket) -> None:
        """Receive from an open socket whose datagrams are ``struct can_frame`` (or canfd_frame)."""
        wanted = self._wanted.buffer // 2  # the kernel doubles it
        try:
            sock.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, wanted)
        except PermissionError:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, wanted)
        self.granted_buffer = sock.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)
        has_clock = self._wanted.timestamps != "software" and has_hardware_stamps(sock, self.channel)
        stamp_frames(sock, has_clock)
        self._clock = None
        if has_clock:
            self._clock = DeviceClock(1e-9, 1 << 62, part_ns=_CLOCK_PART_NS, jump_ns=_CLOCK_JUMP_NS)
        sock.setblocking(False)
        self._socket = sock
        can, time_ns = self._can, now_ns()
        can.fd, can.clock = sock.fileno(), None if self._clock is None else ctypes.addressof(self._clock.state)
        can.offset_ns, can.last_poll_ns = time_ns - time.time_ns(), time_ns
        can.dropped_before = can.dropped = self.counters.dropped
        can.is_small = self.granted_buffer < _SMALL_BUFFER

    @property
    def note(self) -> str:
        """Advice on a receive buffer smaller than requested, missing stamps, and a controller that stays off."""
        notes = []
        if self._socket and self.granted_buffer < self._wanted.buffer:
            notes.append(
                f"bus {self.channel}: receive buffer of {self.granted_buffer} bytes granted, {self._wanted.buffer}"
                f" wanted; for more, run with CAP_NET_ADMIN or: sysctl net.core.rmem_max={self._wanted.buffer}"
            )
        if self._socket and self._wanted.timestamps == "hardware" and self._clock is None:
            notes.append(f"bus {self.channel}: its controller gives no time stamps; the kernel's are taken instead")
        if not self._restarts_itself:
            notes.append(
                f"bus {self.channel}: its controller will not come back from bus-off by itself; to let it:"
                f" ip link set {self.channel} down; ip link set {self.channel} type can restart-ms 100;"
                f" ip link set {self.channel} up"
            )
        return "\n".join(notes)

    def narrow(self, filters: Sequence[Filter]) -> None:
        """Set the kernel's filters; see :class:`skinware_drivers.bus.Bus`. More than it takes count as none."""
        filters = filters if len(filters) <= MOST_FILTERS else ()
        if filters != self._filters and self._socket is not None:
            with contextlib.suppress(OSError):  # the interface is gone: ``receive`` reports it
                _set_filters(self._socket, filters)
        self._filters = filters

    def check(self) -> None:
        if self._socket is None or not self._is_bound:
            return
        name = str(self._socket.getsockname()[0])
        if not name:
            raise BusNotAvailable(f"bus {self.channel} vanished")
        try:
            is_up = _is_up(self._socket, name)
        except OSError as error:
            raise BusNotAvailable(f"bus {self.channel} vanished ({error.strerror})") from None
        if not is_up:
            raise BusNotAvailable(f"bus {self.channel} went down", is_down=True)
        self._ask_kernel()

    def reason(self, time_ns: int) -> BusReason:
        return self._health.reason(time_ns)

    def fileno(self) -> int:
        return self._socket.fileno() if self._socket else -1

    def receive(self, batch: FrameBatch, ordinal: int) -> int:
        source, call = structs.Source(bus=ordinal), native.library().quick
        if not self._describe(source):
            raise BusNotAvailable(f"bus {self.channel} is not open")
        if batch is not self._batch:
            self._batch, self._rows = batch, compile_batch(batch, structs.Arrays())
        can, rows, begin = ctypes.byref(self._can), self._rows, batch.stop
        while batch.free:
            first = rows.stop = batch.stop
            rows.limit = batch.limit
            count = call.skinware_can_receive(ctypes.byref(source), ctypes.byref(rows))
            if count < 0:
                self.nothing_received(-count)
            if count <= 0:
                break
            kept = self.sort_out(batch, slice(first, first + count))
            batch.stop += kept
            call.skinware_can_count(can, ctypes.byref(rows), ctypes.c_int64(first), ctypes.c_int64(kept))
        call.skinware_can_look(can)
        self._take_counts()
        return batch.stop - begin

    @property
    def reads_natively(self) -> bool:
        return True

    def hand_over(self, batch: FrameBatch, source: structs.Source) -> bool:  # noqa: ARG002
        return self._describe(source)

    def take_back(self, source: structs.Source) -> None:  # noqa: ARG002
        self._take_counts()
        if self._can.is_heard:
            self._health.heard_data()

    def _describe(self, source: structs.Source) -> bool:
        can = self._can
        source.fd, source.can, source.tap = can.fd, ctypes.addressof(can), self.tap.address
        can.is_counted = self.bit_rate > 0
        can.frames = can.is_heard = 0
        can.wire_bits = can.fullest = 0.0
        return self._socket is not None

    def _take_counts(self) -> None:
        can = self._can
        self.counters.frames += can.frames
        self.counters.dropped = can.dropped
        self.wire_bits += can.wire_bits
        self.fullest = max(self.fullest, can.fullest)

    def send(self, identifier: int, payload: bytes) -> None:
        sock = self.may_send_by(self._socket)
        if len(payload) <= 8:
            frame = struct.pack("=IB3x", identifier, len(payload)) + payload.ljust(8, b"\0")
        else:
            longest = _FD_LENGTHS[-1]
            length = next((length for length in _FD_LENGTHS if length >= len(payload)), None)
            if length is None:
                raise BusSendError(f"bus {self.channel}: {len(payload)} bytes of payload; CAN FD carries {longest}")
            flags = _CANFD_BRS if self._wanted.bitrate_switch == "on" else 0
            frame = struct.pack("=IBB2x", identifier, length, flags) + payload.ljust(longest, b"\0")
        sent_ns = now_ns()  # not later than an answer
        try:
            sock.send(frame)
        except OSError as error:
            self.counters.send_failures += 1
            why = f"frame {identifier_text(identifier)} not sent ({error.strerror})"
            raise BusSendError(f"bus {self.channel}: {why}") from None
        self.counters.sent += 1
        if self.tap.is_open:
            flags = frame[_FLAGS_AT] if len(payload) > 8 else 0
            self.tap.keep_frame(sent_ns, identifier, payload, flags=flags, is_sent=True)

    def close(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None
            self._is_bound = False

    def _ask_kernel(self) -> None:
        controller = read_controller(self.channel)
        if controller is None:
            return
        self._restarts_itself = controller.restart_ms > 0
        self.bit_rate = 0 if self.narrows else controller.bit_rate  # filtered frames cannot be counted
        if controller.bit_rate and controller.data_bit_rate:
            self._can.speed_up = controller.data_bit_rate / controller.bit_rate
        if controller.state is not None and controller.state < len(CONTROLLER_STATES):
            self._health.believe(CONTROLLER_STATES[controller.state])
            self.counters.bus_offs = self._health.bus_offs

    def nothing_received(self, number: int) -> int:
        if number in (errno.EAGAIN, errno.EINTR):
            return 0
        if number == errno.ENETDOWN:
            raise BusNotAvailable(f"bus {self.channel} went down", is_down=True)
        reason = BusReason.INTERFACE_GONE if number in _AWAY else BusReason.FAILED
        raise BusNotAvailable(f"bus {self.channel} vanished ({os.strerror(number)})", reason=reason)

    def sort_out(self, batch: FrameBatch, new: slice) -> int:
        """Remove rows that are no data frames of this layout from new rows of a batch; return how many are left."""
        wire, first = batch.wire[new], new.start
        identifier, is_foreign = wire["identifier"], wire["length"] > batch.payload_size
        if batch.payload_size == _CLASSIC_PAYLOAD:
            is_foreign |= (wire["flags"] & np.uint8(IS_FD)) != 0
        is_error = (identifier & np.uint32(ERROR_FLAG)) != 0
        other = (((identifier & np.uint32(REMOTE_FLAG)) != 0) | is_foreign) & ~is_error
        self.counters.errors += int(np.count_nonzero(is_error))
        self.counters.refused += int(np.count_nonzero(other))
        self.samples.take(Unused.REFUSED, wire[other])
        good, errors = np.flatnonzero(~(is_error | other)), np.flatnonzero(is_error)
        if len(errors):
            self._health.take(identifier[errors], wire["payload"][errors], now_ns())
        if len(good) and (not len(errors) or good[-1] > errors[-1]):
            self._health.heard_data()
        self.counters.overflows, self.counters.bus_offs = self._health.overflows, self._health.bus_offs
        good += first
        kept = slice(first, first + len(good))
        batch.wire[kept], batch.time_ns[kept], batch.bus[kept] = batch.wire[good], batch.time_ns[good], batch.bus[good]
        return len(good)


def _set_filters(sock: socket.socket, filters: Sequence[Filter]) -> None:
    everything = (Filter(0, 0),)  # an empty list would let nothing through
    packed = b"".join(struct.pack("=II", *one) for one in filters or everything)
    sock.setsockopt(_SOL_CAN_RAW, _CAN_RAW_FILTER, packed)


def _is_up(sock: socket.socket, interface: str) -> bool:
    request = struct.pack("16sH14x", interface.encode(), 0)
    flags: int = struct.unpack("16sH14x", fcntl.ioctl(sock, _SIOCGIFFLAGS, request))[1]
    return bool(flags & _IFF_UP)


def _why_not_bound(interface: str, error: OSError) -> BusNotAvailable:
    if error.errno == errno.ENODEV:
        others = ", ".join(name for _, name in socket.if_nameindex() if "can" in name) or "none"
        return BusNotAvailable(f"there is no CAN interface {interface!r}; CAN interfaces here: {others} (see: ip link)")
    if error.errno in (errno.EPERM, errno.EACCES):
        why = f"bus {interface}: not permitted ({error.strerror}); ask for access to the interface"
        return BusNotAvailable(why, reason=BusReason.REFUSED)
    return BusNotAvailable(f"bus {interface}: cannot be opened ({error.strerror})", reason=BusReason.FAILED)
