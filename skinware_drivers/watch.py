"""A driver's look at every update, for what the wire alone does not call doubtful."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from skinware.status import Status
from skinware_drivers.decoding.skin_state import Updates
from skinware_drivers.description import SkinTables


class Watch:
    """Sees every update of all buses and marks doubtful values that no single frame shows as such.

    Attributes:
        module_status: (n_modules,) uint8, status bits added to every sensor of a module at publication.
        module_untouched: (n_modules,) bool, modules of which nothing shows yet that they live; for people, their values
            count as fresh.
        sees_all: ``look`` is called with all updates; it may be set to False as soon as that is not needed any more.
    """

    sees_all: bool = False

    def __init__(self, tables: SkinTables) -> None:
        self.tables = tables
        self.module_status: npt.NDArray[np.uint8] = np.zeros(tables.structure.n_modules, np.uint8)
        self.module_untouched: npt.NDArray[np.bool_] = np.zeros(tables.structure.n_modules, bool)

    def look(self, updates: Updates) -> None:
        """Called with updates that were just shown, if the wire may have flagged one of them, or it ``sees_all``.

        Of an update, what has no sensor (``updates.sensors`` is ``n_sensors``) has no meaning.
        """

    def suspect(self, patch: int) -> None:
        """Called when a patch reports an error."""
        self.module_status[self.tables.structure.module_patch == patch] |= np.uint8(Status.SUSPECT)

    def forget(self, patch: int) -> None:
        """Called when a patch was set up anew, or reports no error any more: what was held against it is over."""
        self.module_status[self.tables.structure.module_patch == patch] = 0
