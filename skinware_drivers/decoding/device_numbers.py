"""Numbers that devices count up, for whole batches: sequence numbers, and stamps of the devices' own clocks."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from skinware.structure import Structure
from skinware_drivers.device_time import DeviceClock
from skinware_drivers.fields import DeviceTime, SequenceNumber
from skinware_drivers.layout import Frame

log: logging.Logger = logging.getLogger("skinware.driver")

Indices = npt.NDArray[np.int64]
Bytes = npt.NDArray[np.uint8]


def read_numbers(payload: Bytes, sequence: SequenceNumber) -> Indices:
    """Return (n,) the sequence number in each of n payloads; ``payload``: (n, size) uint8."""
    word = _words(payload, sequence)
    if sequence.mask is not None:
        word = (word & word.dtype.type(sequence.mask)) >> word.dtype.type(sequence.shift)
    plain: Indices = word.astype(np.int64)
    return plain


def _words(payload: Bytes, where: SequenceNumber | DeviceTime) -> npt.NDArray[Any]:
    return np.ascontiguousarray(payload[:, where.offset : where.end]).view(where.dtype)[:, 0]


class DeviceStamps:
    """The clocks of all patches; a patch is one device. ``clocks``: by patch, of those that have sent a stamp."""

    def __init__(self, frames: Sequence[Frame], structure: Structure) -> None:
        self._times = [(number, frame.time) for number, frame in enumerate(frames) if frame.time is not None]
        self._structure = structure
        self._module_patch = structure.module_patch.astype(np.intp)
        self._warned: set[int] = set()
        self.clocks: dict[int, DeviceClock] = {}

    @property
    def are_sent(self) -> bool:
        """Whether any kind of frame has a stamp."""
        return bool(self._times)

    def apply(self, kind: Bytes, module: Indices, payload: Bytes, time_ns: Indices) -> None:
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
        sent: dict[int, DeviceTime] = {}
        for number, time in self._times:
            rows = np.flatnonzero((kind == number) & (module < len(self._module_patch)))
            if len(rows):
                stamp[rows] = _words(payload[rows], time).astype(np.int64) % time.turn
                sent.update(dict.fromkeys(np.unique(self._module_patch[module[rows]]).tolist(), time))
        rows = np.flatnonzero(stamp >= 0)
        patch = self._module_patch[module[rows]]
        for number, time in sent.items():
            own = rows[patch == number]
            if number not in self.clocks:
                self.clocks[number] = DeviceClock(time.unit_s, time.turn)
            time_ns[own] = self.clocks[number].convert(stamp[own], time_ns[own])
            if self.clocks[number].stops and number not in self._warned:
                self._warned.add(number)
                log.warning(
                    "%s: the clock of %s stands still, or is far too slow: its samples have the times of their"
                    " receipt; logged once",
                    self._structure.buses[self._structure.patch_bus[number]],
                    self._structure.patch_name[number].decode(),
                )

    def forget(self, patch: int) -> None:
        self.clocks.pop(patch, None)
