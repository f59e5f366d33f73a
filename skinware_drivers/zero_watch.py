"""Modules that nothing has touched so far: a matrix whose wire is broken sends the same as an untouched one."""

from __future__ import annotations

import logging

import numpy as np
import numpy.typing as npt

from skinware.realtime import NS_PER_S
from skinware_drivers.decoding.skin_state import Updates
from skinware_drivers.description import SkinTables
from skinware_drivers.watch import Watch

log: logging.Logger = logging.getLogger("skinware.driver")

_MOST_NAMES = 6


class ZeroWatch(Watch):
    """Knows which modules have sent nothing but 0 since they were first heard: not touched yet, or dead.

    Their values are good and fresh: hands whose taxels rest at exactly 0 are usual. What is known is published as
    :attr:`skinware.DriverSnapshot.module_untouched`. After the first other value, a module counts as alive for good.

    Attributes:
        patience_s: for how long 0 comes before the log names a module.
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
        """See which modules sent another value than 0."""
        time_ns, whole = int(updates.newest_ns.max()), updates.module[updates.whole]
        self._since_ns[whole] = np.where(self._since_ns[whole] == 0, time_ns, self._since_ns[whole])
        lit = ((updates.values != 0) & (updates.sensors < self.tables.structure.n_sensors)).any(axis=1)
        self._is_dark[updates.module[lit]] = False
        self.module_untouched[:] = self._is_dark & (self._since_ns > 0)
        self._name(time_ns)
        self.sees_all = bool(self._is_dark.any())

    def forget(self, patch: int) -> None:
        """The patch was set up again: its modules have to show again that they live."""
        super().forget(patch)
        modules = self.tables.structure.module_patch == patch
        self._is_dark[modules], self._since_ns[modules], self._is_told[modules] = True, 0, False
        self.module_untouched[modules] = False
        self.sees_all = True

    def _name(self, time_ns: int) -> None:
        has_waited = self.module_untouched & (time_ns - self._since_ns >= self.patience_s * NS_PER_S)
        untold = np.flatnonzero(has_waited & ~self._is_told)
        if len(untold) and (has_waited == self.module_untouched).all():  # not one by one
            self._is_told[untold] = True
            names = [self.tables.structure.module_names[module] for module in untold[:_MOST_NAMES].tolist()]
            more = f" and {len(untold) - len(names)} more" if len(untold) > len(names) else ""
            log.info("nothing but 0 has come from %s%s so far: not touched yet, or dead", "; ".join(names), more)
