"""Modules of which nobody knows whether they live: a matrix whose wire is broken tells the same as an untouched one."""

from __future__ import annotations

import logging

import numpy as np
import numpy.typing as npt

from skinware.realtime import NS_PER_S
from skinware.status import Status
from skinware_drivers.decoding.skin_state import Updates
from skinware_drivers.description import SkinTables
from skinware_drivers.watch import Watch

log: logging.Logger = logging.getLogger("skinware.driver")

_MOST_NAMES = 6


class ZeroWatch(Watch):
    """Holds all values of a module for suspect that has told nothing but 0 since its patch began to send.

    After the first other value, a module is believed for good: where taxels rest at 0, a module is suspect until it is
    touched for the first time.

    Attributes:
        patience_s: how long 0 is believed.
    """

    patience_s: float = 10.0

    def __init__(self, tables: SkinTables) -> None:
        super().__init__(tables)
        structure = tables.structure
        self._is_dark: npt.NDArray[np.bool_] = np.ones(structure.n_modules, bool)
        self._since_ns: npt.NDArray[np.int64] = np.zeros(structure.n_patches, np.int64)
        self._is_told: npt.NDArray[np.bool_] = np.zeros(structure.n_patches, bool)
        self.sees_all = True

    def look(self, updates: Updates) -> None:
        """See which modules told something, and hold the others for suspect when the time has come."""
        structure = self.tables.structure
        lit = ((updates.values != 0) & (updates.sensors < structure.n_sensors)).any(axis=1)
        modules = updates.module[lit & self._is_dark[updates.module]]
        self._is_dark[modules] = False
        self.module_status[modules] &= np.uint8(~int(Status.SUSPECT) & 0xFF)
        for patch in np.unique(structure.module_patch[updates.module]).tolist():
            self._judge(patch, int(updates.newest_ns.max()))
        self.sees_all = bool(self._is_dark.any())

    def forget(self, patch: int) -> None:
        """The patch was set up anew: its modules have to show again that they live."""
        super().forget(patch)
        self._is_dark[self.tables.structure.module_patch == patch] = True
        self._since_ns[patch], self._is_told[patch] = 0, False
        self.sees_all = True

    def _judge(self, patch: int, time_ns: int) -> None:
        structure = self.tables.structure
        if not self._since_ns[patch]:
            self._since_ns[patch] = time_ns
        dark = np.flatnonzero(self._is_dark & (structure.module_patch == patch))
        if not len(dark) or time_ns - self._since_ns[patch] < self.patience_s * NS_PER_S:
            return
        self.module_status[dark] |= np.uint8(Status.SUSPECT)
        if not self._is_told[patch]:
            self._is_told[patch] = True
            names = [structure.module_names[module] for module in dark[:_MOST_NAMES].tolist()]
            more = f" and {len(dark) - len(names)} more" if len(dark) > len(names) else ""
            log.warning(
                "nothing but 0 comes from %s%s: broken, or not touched yet; suspect until something else comes",
                "; ".join(names),
                more,
            )


__all__ = ["ZeroWatch"]
