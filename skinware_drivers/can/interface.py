"""Ask the kernel about a CAN interface (rtnetlink), and compute how long frames take on its wire."""

from __future__ import annotations

import socket
import struct
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from skinware_drivers.bus import EXTENDED_FLAG

_RTM_NEWLINK, _RTM_GETLINK = 16, 18
_NLM_F_REQUEST = 1
_IFLA_IFNAME, _IFLA_LINKINFO = 3, 18
_IFLA_INFO_DATA = 2
_IFLA_CAN_BITTIMING, _IFLA_CAN_STATE, _IFLA_CAN_RESTART_MS, _IFLA_CAN_DATA_BITTIMING = 1, 4, 6, 9
_HEADER, _INTERFACE = struct.Struct("=IHHII"), struct.Struct("=BxHiII")
_ANSWER_BYTES = 1 << 16

NO_CAN = "this kernel has no CAN: load it (sudo modprobe can-raw), or use a bus that needs none (--bus virtual)"


@dataclass(frozen=True)
class Controller:
    """A CAN controller as its kernel driver tells.

    Attributes:
        bit_rate: of the arbitration phase, bit/s; 0 where not set.
        state: 0 error-active, 1 error-warning, 2 error-passive, 3 bus-off, 4 stopped, 5 sleeping; None: not told.
        restart_ms: pause before it comes back from bus-off by itself; 0: it does not.
        data_bit_rate: of the data phase of CAN FD, bit/s; 0 where not set.
    """

    bit_rate: int = 0
    state: int | None = None
    restart_ms: int = 0
    data_bit_rate: int = 0


def read_controller(interface: str) -> Controller | None:
    """The controller of an interface; None where there is none (``vcan``), or it cannot be asked."""
    name = interface.encode() + b"\0"
    attribute = struct.pack("=HH", 4 + len(name), _IFLA_IFNAME) + name.ljust(-(-len(name) // 4) * 4, b"\0")
    body = _INTERFACE.pack(socket.AF_UNSPEC, 0, 0, 0, 0) + attribute
    request = _HEADER.pack(_HEADER.size + len(body), _RTM_GETLINK, _NLM_F_REQUEST, 1, 0) + body
    try:
        with socket.socket(socket.AF_NETLINK, socket.SOCK_RAW | socket.SOCK_CLOEXEC, socket.NETLINK_ROUTE) as netlink:
            netlink.settimeout(1.0)  # it answers within the call
            netlink.send(request)
            return parse_answer(netlink.recv(_ANSWER_BYTES))
    except OSError:
        return None


def parse_answer(answer: bytes) -> Controller | None:
    """The controller in an ``RTM_NEWLINK`` message; None if it tells of none."""
    if len(answer) < _HEADER.size + _INTERFACE.size or _HEADER.unpack_from(answer)[1] != _RTM_NEWLINK:
        return None
    link = dict(_attributes(answer[_HEADER.size + _INTERFACE.size :]))
    told = dict(_attributes(dict(_attributes(link.get(_IFLA_LINKINFO, b""))).get(_IFLA_INFO_DATA, b"")))
    if _IFLA_CAN_STATE not in told and _IFLA_CAN_BITTIMING not in told:
        return None
    return Controller(
        _number(told.get(_IFLA_CAN_BITTIMING)) or 0,
        _number(told.get(_IFLA_CAN_STATE)),
        _number(told.get(_IFLA_CAN_RESTART_MS)) or 0,
        _number(told.get(_IFLA_CAN_DATA_BITTIMING)) or 0,
    )


def _number(data: bytes | None) -> int | None:
    return struct.unpack_from("=I", data)[0] if data is not None and len(data) >= 4 else None


def _attributes(data: bytes) -> Iterator[tuple[int, bytes]]:
    offset = 0
    while offset + 4 <= len(data):
        length, kind = struct.unpack_from("=HH", data, offset)
        if length < 4:
            return
        yield kind & 0x3FFF, data[offset + 4 : offset + length]
        offset += -(-length // 4) * 4


_CLASSIC_PAYLOAD = 8
_CLASSIC_BITS, _CLASSIC_EXTENDED_BITS = 47, 67  # without payload and stuff bits, with the pause after it
_FD_BITS, _FD_EXTENDED_BITS = 30, 49  # at the nominal rate: up to the bit rate switch, and from the acknowledgement on
_FD_SHORT_DATA_BITS, _FD_LONG_DATA_BITS = 32, 37  # beside the payload, with the fixed stuff bits: check sum of 17 or 21
_LONGEST_SHORT_FD = 16
_STUFFING = 1.1
# flags of linux/can.h; kernels before 5.14 do not set the last one
_SWITCHED, _PASSIVE_SENDER, _IS_FD = 0x01, 0x02, 0x04


def wire_bits(wire: npt.NDArray[np.void], speed_up: float = 1.0) -> float:
    """About how many bits of the nominal rate frames take.

    Args:
        wire: (n,) rows of :func:`skinware_drivers.bus.wire_dtype`.
        speed_up: by how much the payload of CAN FD frames that switch is faster.
    """
    if wire.dtype["payload"].shape[0] == _CLASSIC_PAYLOAD:
        return _classic_bits(wire)
    length, flags = wire["length"].astype(np.int64), wire["flags"]
    is_fd = (flags & np.uint8(_SWITCHED | _PASSIVE_SENDER | _IS_FD) != 0) | (length > _CLASSIC_PAYLOAD)
    fd, length = wire[is_fd], length[is_fd]
    extended = int(np.count_nonzero(fd["identifier"] & np.uint32(EXTENDED_FLAG)))
    bits = _FD_BITS * (len(fd) - extended) + _FD_EXTENDED_BITS * extended
    data = np.where(length > _LONGEST_SHORT_FD, _FD_LONG_DATA_BITS, _FD_SHORT_DATA_BITS) + 8 * length
    share = np.where(fd["flags"] & np.uint8(_SWITCHED), 1 / speed_up, 1.0)
    return _classic_bits(wire[~is_fd]) + _STUFFING * (bits + float(data @ share))


def _classic_bits(wire: npt.NDArray[np.void]) -> float:
    extended = int(np.count_nonzero(wire["identifier"] & np.uint32(EXTENDED_FLAG)))
    bits = _CLASSIC_BITS * (len(wire) - extended) + _CLASSIC_EXTENDED_BITS * extended
    return _STUFFING * (bits + 8 * int(wire["length"].sum(dtype=np.int64)))
