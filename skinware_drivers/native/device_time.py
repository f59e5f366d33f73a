"""The clock of a device that is no patch: of the controller of a CAN interface."""

from __future__ import annotations

import ctypes

import numpy as np
import numpy.typing as npt

from skinware.realtime import NS_PER_S
from skinware_drivers import native
from skinware_drivers.native import structs

Times = npt.NDArray[np.int64]

_PARTS = 60  # CLOCK_PARTS of path.h
_LEAST_NS = -(1 << 63)


class DeviceClock:
    """Brings the stamps of one device onto CLOCK_MONOTONIC (``device_time.c``).

    Args:
        unit_s: seconds per count.
        modulo: the stamps wrap to 0 here.
        part_ns: of this length is each part of the time from which the one frame of least delay is kept.
        jump_ns: a stamp so far in the future shows that the clock was set.

    Attributes:
        state: what is known of the clock.
    """

    def __init__(
        self, unit_s: float, modulo: int = 1 << 32, *, part_ns: int = NS_PER_S, jump_ns: int = NS_PER_S // 20
    ) -> None:
        self._convert = native.library().quick.skinware_clock_convert
        self._points = (structs.ClockPoint * _PARTS)()
        self.state = structs.DeviceClock(
            unit_ns=unit_s * NS_PER_S,
            modulo=modulo,
            part_ns=part_ns,
            jump_ns=jump_ns,
            points=ctypes.addressof(self._points),
            stamp=-1,
            last_ns=_LEAST_NS,
        )

    def convert(self, stamps: npt.ArrayLike, received_ns: npt.ArrayLike) -> Times:
        """Return when frames were stamped, never after their receipt.

        Args:
            stamps: (n,) whole numbers as the device sent them, in the order in which they were received.
            received_ns: (n,) int64, CLOCK_MONOTONIC ns, not descending.

        Returns:
            (n,) int64, CLOCK_MONOTONIC ns, not descending.
        """
        raw, times_ns = np.array(stamps, np.int64), np.array(received_ns, np.int64)
        self._convert(
            ctypes.byref(self.state),
            ctypes.c_void_p(raw.ctypes.data),
            ctypes.c_void_p(times_ns.ctypes.data),
            ctypes.c_int64(len(raw)),
        )
        return times_ns
