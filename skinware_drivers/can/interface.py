"""What the kernel knows of a CAN interface: bit rate, state of the controller, restarts. By rtnetlink; needs no rights.

Sources: linux/rtnetlink.h, linux/if_link.h, linux/can/netlink.h.
"""

from __future__ import annotations

import socket
import struct
from collections.abc import Iterator
from dataclasses import dataclass

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
