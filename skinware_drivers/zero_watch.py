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
    """Holds all values of a module for suspect that has told nothing but 0 since it was first heard.

    After the first other value, a module is believed for good: where taxels rest at 0, a module is suspect until it is
    touched for the first time.

    Attributes:
        patience_s: how long 0 is believed.
    """

    patience_s: float = 10.0

    def __init__(self, tables: SkinTables) -> None:
        super().__init__(tables)
        n_modules = tables.structure.n_modules
        self._is_dark: npt.NDArray[np.bool_] = np.ones(n_modules, bool)
        self._since_ns: npt.NDArray[np.int64] = np.zeros(n_modules, np.int64)  # 0: not heard yet
        self._is_told: npt.NDArray[np.bool_] = np.zeros(n_modules, bool)
        self.sees_all = True

    def look(self, updates: Updates) -> None:
        """See which modules told something, and hold the others for suspect when the time has come."""
        time_ns, whole = int(updates.newest_ns.max()), updates.module[updates.whole]
        self._since_ns[whole] = np.where(self._since_ns[whole] == 0, time_ns, self._since_ns[whole])
        lit = ((updates.values != 0) & (updates.sensors < self.tables.structure.n_sensors)).any(axis=1)
        believed = updates.module[lit & self._is_dark[updates.module]]
        self._is_dark[believed] = False
        self.module_status[believed] &= np.uint8(~int(Status.SUSPECT) & 0xFF)
        self._doubt(time_ns)
        self.sees_all = bool(self._is_dark.any())

    def forget(self, patch: int) -> None:
        """The patch was set up anew: its modules have to show again that they live."""
        super().forget(patch)
        modules = self.tables.structure.module_patch == patch
        self._is_dark[modules], self._since_ns[modules], self._is_told[modules] = True, 0, False
        self.sees_all = True

    def _doubt(self, time_ns: int) -> None:
        dark = self._is_dark & (self._since_ns > 0)
        doubted = dark & (time_ns - self._since_ns >= self.patience_s * NS_PER_S)
        self.module_status[doubted] |= np.uint8(Status.SUSPECT)
        untold = np.flatnonzero(doubted & ~self._is_told)
        if len(untold) and (doubted == dark).all():  # not one by one
            self._is_told[untold] = True
            names = [self.tables.structure.module_names[module] for module in untold[:_MOST_NAMES].tolist()]
            more = f" and {len(untold) - len(names)} more" if len(untold) > len(names) else ""
            log.warning(
                "nothing but 0 comes from %s%s: broken, or not touched yet; suspect until something else comes",
                "; ".join(names),
                more,
            )


__all__ = ["ZeroWatch"]
