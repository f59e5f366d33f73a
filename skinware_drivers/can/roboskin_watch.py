"""Which ROBOSKIN boards may have moved their baseline without a word.

Source: robotology/icub-firmware embot_app_application_theSkin.cpp: a board counts the cycles of its triangles with a
channel that does not acknowledge though it is connected (several triangles count together), re-calibrates all its
triangles at the fifth, and begins again at 0. The count is a static variable: no command resets it, a restart does.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from skinware.status import Status
from skinware_drivers.decoding.skin_state import Updates
from skinware_drivers.description import SkinTables
from skinware_drivers.polling import Watch

_RECALIBRATION_CYCLES = 5
_ZERO, _ALL = 1, (1 << _RECALIBRATION_CYCLES) - 1


class BaselineWatch(Watch):
    """Marks boards that may have moved their baseline.

    When they have, the flag of the channel goes away. What they send from then on is measured from an unknown baseline,
    until they are set up again.

    What a board has counted is not always known: whether one that was set up anew had restarted, it does not say. So
    all counts that are possible are followed, as bits, and one that may have reached the fifth is marked.
    """

    def __init__(self, tables: SkinTables) -> None:
        super().__init__(tables)
        self._counts: npt.NDArray[np.int64] = np.full(tables.structure.n_patches, _ZERO)  # bit k: it may be at k

    def look(self, updates: Updates) -> None:
        """Count what was not acknowledged, per board; see :class:`skinware_drivers.adapter.Watch`."""
        status = updates.status[:, 0]  # these flags are of all sensors of a triangle
        silent = (status & (Status.NO_ACK | Status.NOT_CONNECTED)) == Status.NO_ACK
        if not silent.any():
            return
        module_patch = self.tables.structure.module_patch
        cycles = np.bincount(module_patch[updates.module[silent]], minlength=len(self._counts))
        moved = (self._counts << np.minimum(cycles, _RECALIBRATION_CYCLES)) > _ALL
        turned = self._counts << cycles % _RECALIBRATION_CYCLES
        self._counts = (turned | turned >> _RECALIBRATION_CYCLES | moved * _ZERO) & _ALL
        self.module_status[moved[module_patch]] |= np.uint8(Status.SUSPECT)

    def forget(self, patch: int) -> None:
        """The board was set up anew, so its baseline is known again; it goes on counting, unless it had restarted."""
        super().forget(patch)
        self._counts[patch] |= _ZERO
