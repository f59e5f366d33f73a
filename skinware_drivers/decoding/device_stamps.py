"""Times of frames by the stamps of the devices that sent them, for whole batches."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from skinware_drivers.device_time import DeviceClock
from skinware_drivers.layout import DeviceTime, Frame

Bytes = npt.NDArray[np.uint8]
Indices = npt.NDArray[np.int64]


class DeviceStamps:
    """The clocks of all patches; a patch is one device.

    Args:
        frames: all kinds of frame.
        module_patch: (n_modules,) patch of each module.

    Attributes:
        clocks: by patch, of those that have sent a stamp.
    """

    def __init__(self, frames: Sequence[Frame], module_patch: npt.NDArray[np.intp]) -> None:
        self._times = [(number, frame.time) for number, frame in enumerate(frames) if frame.time is not None]
        self._module_patch = module_patch
        self.clocks: dict[int, DeviceClock] = {}

    def tell(self, kind: Bytes, module: Indices, payload: Bytes, time_ns: Indices) -> None:
        """Replace the times at which frames were received by those at which they were stamped.

        Args:
            kind: (n,) uint8, kind of each frame.
            module: (n,) its module; those from ``n_modules`` on are none.
            payload: (n, size) uint8.
            time_ns: (n,) int64, CLOCK_MONOTONIC ns, changed in place.
        """
        if not self._times:
            return
        stamp = np.full(len(kind), -1, np.int64)
        said: dict[int, DeviceTime] = {}
        for number, time in self._times:
            rows = np.flatnonzero((kind == number) & (module < len(self._module_patch)))
            if len(rows):
                stamp[rows] = _read(payload[rows], time)
                said.update(dict.fromkeys(np.unique(self._module_patch[module[rows]]).tolist(), time))
        rows = np.flatnonzero(stamp >= 0)
        patch = self._module_patch[module[rows]]
        for number, time in said.items():
            own = rows[patch == number]
            if number not in self.clocks:
                self.clocks[number] = DeviceClock(time.unit_s, time.turn)
            time_ns[own] = self.clocks[number].convert(stamp[own], time_ns[own])


def _read(payload: Bytes, time: DeviceTime) -> npt.NDArray[Any]:
    part = np.ascontiguousarray(payload[:, time.offset : time.end])
    return part.view(time.dtype)[:, 0].astype(np.int64) % time.turn
