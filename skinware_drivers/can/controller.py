"""The controller of a CAN interface, as the kernel and error frames report it: rates, state, troubles, stamps."""

from __future__ import annotations

import errno
import fcntl
import socket
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from skinware.realtime import NS_PER_S
from skinware.status import BusReason

NO_CAN = "this kernel has no CAN: load it (sudo modprobe can-raw), or use a bus that needs none (--bus virtual)"

# linux/rtnetlink.h, linux/if_link.h, linux/can/netlink.h
_RTM_NEWLINK, _RTM_GETLINK, _NLM_F_REQUEST, _NLMSG_ERROR = 16, 18, 1, 2
_IFLA_IFNAME, _IFLA_LINKINFO, _IFLA_INFO_KIND, _IFLA_INFO_DATA, _IFLA_INFO_XSTATS = 3, 18, 1, 2, 3
_IFLA_CAN_BITTIMING, _IFLA_CAN_STATE, _IFLA_CAN_RESTART_MS, _IFLA_CAN_DATA_BITTIMING = 1, 4, 6, 9
_HEADER, _INTERFACE, _ERROR = struct.Struct("=IHHII"), struct.Struct("=BxHiII"), struct.Struct("=i")
_ANSWER_BYTES = 1 << 16
_ERRORS = ("bus_error", "error_warning", "error_passive", "bus_off", "arbitration_lost", "restarts")
"""Counters in ``struct can_device_stats``, u32 each."""


@dataclass(frozen=True)
class Controller:
    """A CAN controller as its kernel driver describes it.

    Attributes:
        bit_rate: of the arbitration phase, bit/s; 0 if not set.
        state: 0 error-active, 1 error-warning, 2 error-passive, 3 bus-off, 4 stopped, 5 sleeping; None: unknown.
        restart_ms: pause before it returns from bus-off by itself; 0: it does not return.
        data_bit_rate: of the data phase of CAN FD, bit/s; 0 if not set.
        sample_point: 0 to 1; 0 if not set.
        errors: counters of the kernel driver, by name: ``bus_error``, ``bus_off`` ...
    """

    bit_rate: int = 0
    state: int | None = None
    restart_ms: int = 0
    data_bit_rate: int = 0
    sample_point: float = 0.0
    errors: Mapping[str, int] = field(default_factory=dict)


def read_controller(interface: str) -> Controller | None:
    """Return the controller of an interface; None if it has none (``vcan``) or cannot be asked."""
    return read_link(interface)[1]


def read_link(interface: str) -> tuple[str, Controller | None]:
    """Return the kind of an interface (``can``, ``vcan``; empty: unknown) and its controller as ``read_controller``."""
    return parse_answer(_ask_for_link(interface))


def is_missing(interface: str) -> bool:
    """Return whether there is no interface of this name; False if the kernel cannot be asked.

    A socket that is bound to a missing one makes the kernel run ``modprobe`` twice, while all buses wait.
    """
    answer = _ask_for_link(interface)
    if len(answer) < _HEADER.size + _ERROR.size or _HEADER.unpack_from(answer)[1] != _NLMSG_ERROR:
        return False
    return bool(_ERROR.unpack_from(answer, _HEADER.size)[0] == -errno.ENODEV)


def _ask_for_link(interface: str) -> bytes:
    """Return the kernel's answer; empty if it gives none."""
    name = interface.encode() + b"\0"
    attribute = struct.pack("=HH", 4 + len(name), _IFLA_IFNAME) + name.ljust(-(-len(name) // 4) * 4, b"\0")
    body = _INTERFACE.pack(socket.AF_UNSPEC, 0, 0, 0, 0) + attribute
    request = _HEADER.pack(_HEADER.size + len(body), _RTM_GETLINK, _NLM_F_REQUEST, 1, 0) + body
    try:
        with socket.socket(socket.AF_NETLINK, socket.SOCK_RAW | socket.SOCK_CLOEXEC, socket.NETLINK_ROUTE) as netlink:
            netlink.settimeout(1.0)  # it answers within the call
            netlink.send(request)
            return netlink.recv(_ANSWER_BYTES)
    except OSError:
        return b""


def parse_answer(answer: bytes) -> tuple[str, Controller | None]:
    """Return kind and controller in an ``RTM_NEWLINK`` message; empty and None if it describes none."""
    if len(answer) < _HEADER.size + _INTERFACE.size or _HEADER.unpack_from(answer)[1] != _RTM_NEWLINK:
        return "", None
    link = dict(_attributes(answer[_HEADER.size + _INTERFACE.size :]))
    info = dict(_attributes(link.get(_IFLA_LINKINFO, b"")))
    kind = info.get(_IFLA_INFO_KIND, b"").rstrip(b"\0").decode(errors="replace")
    data = {of: _numbers(value) for of, value in _attributes(info.get(_IFLA_INFO_DATA, b""))}
    if _IFLA_CAN_STATE not in data and _IFLA_CAN_BITTIMING not in data:
        return kind, None
    first = {of: numbers[0] for of, numbers in data.items() if numbers}
    return kind, Controller(
        bit_rate=first.get(_IFLA_CAN_BITTIMING, 0),
        state=first.get(_IFLA_CAN_STATE),
        restart_ms=first.get(_IFLA_CAN_RESTART_MS, 0),
        data_bit_rate=first.get(_IFLA_CAN_DATA_BITTIMING, 0),
        sample_point=sum(data.get(_IFLA_CAN_BITTIMING, ())[1:2]) / 1000,  # in tenths of a percent
        errors=dict(zip(_ERRORS, _numbers(info.get(_IFLA_INFO_XSTATS, b"")), strict=False)),
    )


def _numbers(data: bytes) -> tuple[int, ...]:
    return struct.unpack_from(f"={len(data) // 4}I", data)


def _attributes(data: bytes) -> Iterator[tuple[int, bytes]]:
    offset = 0
    while offset + 4 <= len(data):
        length, kind = struct.unpack_from("=HH", data, offset)
        if length < 4:
            return
        yield kind & 0x3FFF, data[offset + 4 : offset + length]
        offset += -(-length // 4) * 4


# linux/can/error.h: classes, in the identifier
_CONTROLLER, _PROTOCOL, _TRANSCEIVER, _NO_ACK = 0x4, 0x8, 0x10, 0x20
_BUS_OFF, _BUS_ERROR, _RESTARTED = 0x40, 0x80, 0x100
# details of the controller, in byte 1
_RX_OVERFLOW, _WARNING, _PASSIVE, _ACTIVE = 0x01, 0x04 | 0x08, 0x10 | 0x20, 0x40
# place in a frame of a protocol error, in byte 3: the two places of the acknowledgement
_ACK_SLOT, _ACK_DELIMITER = 0x19, 0x1B

CONTROLLER_STATES = (BusReason.NONE, BusReason.ERROR_WARNING, BusReason.ERROR_PASSIVE, BusReason.BUS_OFF)
"""States 0 to 3 of a controller, in the order of ``enum can_state``."""
_ACTIVE_CODE, _WARNING_CODE, _PASSIVE_CODE, _BUS_OFF_CODE = 1, 2, 3, 4  # one more than the index of the state
_TROUBLES = (BusReason.OVERFLOW, BusReason.NO_ACKNOWLEDGEMENT, BusReason.BUS_ERRORS)
TROUBLE_LASTS_S = 5.0
"""Time for which a trouble counts that is reported when it happens, but not when it ends."""


class ControllerHealth:
    """The state of one controller, as its error frames add up.

    Error frames come in the stream of data frames, with ``CAN_ERR_FLAG`` in the identifier. With ``berr-reporting`` a
    bad wire brings thousands a second, so they are read batch by batch.

    Attributes:
        overflows: how often the controller reported lost frames.
        bus_offs: how often it left the wire.
    """

    def __init__(self) -> None:
        self.overflows: int = 0
        self.bus_offs: int = 0
        self._state = BusReason.NONE
        self._trouble_until_ns = dict.fromkeys(_TROUBLES, 0)

    def take(self, identifier: npt.NDArray[np.uint32], payload: npt.NDArray[np.uint8], time_ns: int) -> None:
        """Add n error frames, in order of arrival; the time is now, CLOCK_MONOTONIC ns."""
        detail = np.where(identifier & _CONTROLLER, payload[:, 1], 0)
        protocol = (identifier & (_PROTOCOL | _BUS_ERROR | _TRANSCEIVER)) != 0
        at_ack = protocol & np.isin(payload[:, 3], (_ACK_SLOT, _ACK_DELIMITER))
        overflows = np.count_nonzero(detail & _RX_OVERFLOW)
        reports = {
            BusReason.OVERFLOW: overflows,
            BusReason.NO_ACKNOWLEDGEMENT: np.count_nonzero(at_ack | ((identifier & _NO_ACK) != 0)),
            BusReason.BUS_ERRORS: np.count_nonzero(protocol & ~at_ack),
        }
        for trouble, count in reports.items():
            if count:
                self._trouble_until_ns[trouble] = time_ns + round(TROUBLE_LASTS_S * NS_PER_S)
        code = np.zeros(len(identifier), np.uint8)  # a worse state overwrites a better one
        code[(detail & _ACTIVE) | (identifier & _RESTARTED) != 0] = _ACTIVE_CODE
        code[detail & _WARNING != 0] = _WARNING_CODE
        code[detail & _PASSIVE != 0] = _PASSIVE_CODE
        code[identifier & _BUS_OFF != 0] = _BUS_OFF_CODE
        self.overflows += int(overflows)
        code = code[code != 0]
        if len(code):
            was_off = np.append(self._state == BusReason.BUS_OFF, code[:-1] == _BUS_OFF_CODE)
            self.bus_offs += int(np.count_nonzero((code == _BUS_OFF_CODE) & ~was_off))
            self._state = CONTROLLER_STATES[int(code[-1]) - 1]

    def heard_data(self) -> None:
        """Note a data frame after all error frames so far: a controller that receives is not off the wire."""
        if self._state == BusReason.BUS_OFF:
            self._state = BusReason.NONE

    def believe(self, state: BusReason) -> None:
        """Take over the state that the kernel knows: error frames can be lost."""
        if state == BusReason.BUS_OFF != self._state:
            self.bus_offs += 1
        self._state = state

    def reset(self) -> None:
        """Forget all troubles: the interface is another one, or was set down and up. Counts go on."""
        self._state = BusReason.NONE
        self._trouble_until_ns = dict.fromkeys(_TROUBLES, 0)

    def reason(self, time_ns: int) -> BusReason:
        """Return the worst present trouble; ``NONE`` if there is none."""
        if self._state != BusReason.NONE:
            return self._state
        return next((t for t, until_ns in self._trouble_until_ns.items() if time_ns < until_ns), BusReason.NONE)


# asm-generic/socket.h, linux/net_tstamp.h, linux/ethtool.h
_SO_TIMESTAMPNS, _SO_TIMESTAMPING = 35, 37
_RX_HARDWARE, _RX_SOFTWARE, _SOFTWARE, _RAW_HARDWARE = 1 << 2, 1 << 3, 1 << 4, 1 << 6
_SIOCETHTOOL, _ETHTOOL_GET_TS_INFO = 0x8946, 0x41
_TS_INFO_BYTES = 44


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


def stamp_frames(sock: socket.socket, hardware: bool) -> None:
    """Have the kernel stamp the frames of a socket, and the controller, too, where it can (decision 7)."""
    if hardware:
        flags = _RX_HARDWARE | _RAW_HARDWARE | _RX_SOFTWARE | _SOFTWARE
        sock.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPING, flags)
    else:
        # 20 ns a frame cheaper, and stamps also frames from before the kernel began to stamp (in the background)
        sock.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
