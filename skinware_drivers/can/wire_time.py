"""How long CAN frames take on the wire, in bits of the nominal rate.

Source: ISO 11898-1:2015, 10.4. Stuff bits depend on what is sent; one in ten bits is about what skin data has. The
payload of a CAN FD frame with bit rate switch, with its length and check sum, is sent at a rate of its own.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from skinware_drivers.bus import EXTENDED_FLAG

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
