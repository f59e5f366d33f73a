"""Stamps as C reads them from ancillary data, by clocks that a test sets."""

from __future__ import annotations

import ctypes

import numpy as np
import numpy.typing as npt

from skinware_drivers import native
from skinware_drivers.native import structs
from skinware_drivers.native.device_time import DeviceClock

Stamps = npt.NDArray[np.int64]
SECOND = 10**9


class Stamper:
    """A CAN socket, without the socket."""

    def __init__(self, has_clock: bool, offset_ns: int, poll_ns: int) -> None:
        self._clock = DeviceClock(1e-9, 1 << 62, part_ns=SECOND // 4, jump_ns=SECOND // 100)
        address = ctypes.addressof(self._clock.state) if has_clock else None
        self._can = structs.CanSocket(clock=address, offset_ns=offset_ns, last_poll_ns=poll_ns)

    def read(self, control: Stamps, offset_ns: int, poll_ns: int) -> Stamps:
        """Return (n,) int64 for (n, 8) int64 ancillary data, CLOCK_MONOTONIC ns, at these clocks."""
        words, stamps = np.ascontiguousarray(control), np.zeros(len(control), np.int64)
        native.library().quick.skinware_can_stamp(
            ctypes.byref(self._can),
            ctypes.c_void_p(words.ctypes.data),
            ctypes.c_void_p(stamps.ctypes.data),
            *map(ctypes.c_int64, (len(words), offset_ns, poll_ns)),
        )
        return stamps
