"""Times of frames by the stamps of the devices that sent them, for whole batches."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from skinware.structure import Structure
from skinware_drivers.device_time import DeviceClock
from skinware_drivers.layout import DeviceTime, Frame

log: logging.Logger = logging.getLogger("skinware.driver")

Bytes = npt.NDArray[np.uint8]
Indices = npt.NDArray[np.int64]


class DeviceStamps:
    """The clocks of all patches; a patch is one device.

    Args:
        frames: all kinds of frame.
        structure: the skin.

    Attributes:
        clocks: by patch, of those that have sent a stamp.
    """

    def __init__(self, frames: Sequence[Frame], structure: Structure) -> None:
        self._times = [(number, frame.time) for number, frame in enumerate(frames) if frame.time is not None]
        self._structure = structure
        self._module_patch = structure.module_patch.astype(np.intp)
        self._warned: set[int] = set()
        self.clocks: dict[int, DeviceClock] = {}

    @property
    def are_told(self) -> bool:
        return bool(self._times)

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
            if self.clocks[number].stops and number not in self._warned:
                self._warn(number)

    def forget(self, patch: int) -> None:
        self.clocks.pop(patch, None)

    def _warn(self, patch: int) -> None:
        self._warned.add(patch)
        structure = self._structure
        log.warning(
            "%s: the clock of %s stands still, or is far too slow: its samples have the times of their receipt;"
            " told once",
            structure.buses[structure.patch_bus[patch]],
            structure.patch_name[patch].decode(),
        )


def _read(payload: Bytes, time: DeviceTime) -> npt.NDArray[Any]:
    part = np.ascontiguousarray(payload[:, time.offset : time.end])
    return part.view(time.dtype)[:, 0].astype(np.int64) % time.turn
