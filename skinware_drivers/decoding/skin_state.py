"""The state of a skin, and the updates that change it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from skinware.status import Status
from skinware_drivers.description import SkinTables

BUS_COUNTERS = ("unknown", "bad_length", "bad_content", "before_boot")
"""Per bus: frames with foreign identifiers, wrong lengths, or unknown contents; frames stamped before this machine
booted."""
PATCH_COUNTERS = ("updates", "orphans", "late", "sequence_lost", "sequence_repeated", "sequence_back")
"""Per patch: updates of modules; frames without partners; cycles whose frames came too late, or out of the device's
rhythm; sequence numbers that were skipped, were repeated, or went back (out of order, or a restart)."""
_PROMPT = 1.5
"""The longest period of a group that frames wait for, in periods of the driver."""


@dataclass(slots=True)
class Updates:
    """New values of modules, in order of arrival; they hold no reference to their frames.

    Attributes:
        module: (n,) int64.
        groups: (n, most) int64, update groups of each; ``n_groups``: none. The first stands for the update.
        whole: (n,) bool; False: only a part was heard (an orphan), which shows nothing.
        sensors: (n, width) int64, the sensors of the values; ``n_sensors``: none.
        values: (n, width) of the structure's dtype.
        status: (n, width) uint8, status bits from the wire.
        oldest_ns: (n,) int64, oldest stamp of the frames of each.
        newest_ns: (n,) int64, newest stamp of them.
        flagged: False: ``status`` is all zero.
    """

    module: npt.NDArray[np.int64]
    groups: npt.NDArray[np.int64]
    whole: npt.NDArray[np.bool_]
    sensors: npt.NDArray[np.int64]
    values: npt.NDArray[Any]
    status: npt.NDArray[np.uint8]
    oldest_ns: npt.NDArray[np.int64]
    newest_ns: npt.NDArray[np.int64]
    flagged: bool

    def __len__(self) -> int:
        return len(self.module)

    @property
    def group(self) -> npt.NDArray[np.int64]:
        """(n,) int64, the update group that stands for each."""
        return self.groups[:, 0]


class SkinState:
    """Values, status and times of a skin; copied into the ring at publication.

    The arrays have one element more than there are sensors, groups or patches, for values without a sensor: that is
    cheaper than to sort them out.

    Attributes:
        all_values: (n_sensors + 1,) of the structure's dtype.
        all_status: (n_sensors + 1,) uint8, status bits from the wire.
        all_group_time_ns: (n_groups + 1,) int64, oldest stamp among the frames shown for an update group; 0: never.
        all_updated: (n_groups + 1,) bool, shown since the last publication.
        all_touched: (n_groups + 1,) bool, heard since then, if only in part.
        all_patch_time_ns: (n_patches + 1,) int64, newest stamp of a complete update of a prompt group; 0: never.
        group_patch: (n_groups,) the patch of each group.
        is_prompt: (n_groups,) bool: updated in every period, so that frames wait for it.
        bus_counters: (n_buses, len(BUS_COUNTERS)) int64.
        patch_counters: (n_patches, len(PATCH_COUNTERS)) int64.
    """

    def __init__(self, tables: SkinTables) -> None:
        structure = self._structure = tables.structure
        self.all_values = np.zeros(structure.n_sensors + 1, structure.dtype)
        self.all_status = np.full(structure.n_sensors + 1, int(Status.NEVER_SEEN), np.uint8)
        self.all_group_time_ns = np.zeros(structure.n_groups + 1, np.int64)
        self.all_updated = np.zeros(structure.n_groups + 1, bool)
        self.all_touched = np.zeros(structure.n_groups + 1, bool)
        self.all_patch_time_ns = np.zeros(structure.n_patches + 1, np.int64)
        self.group_patch = structure.group_patch.astype(np.intp)
        self.is_prompt: npt.NDArray[np.bool_] = np.ones(structure.n_groups, bool)
        self.bus_counters: npt.NDArray[np.int64] = np.zeros((len(structure.buses), len(BUS_COUNTERS)), np.int64)
        self.patch_counters: npt.NDArray[np.int64] = np.zeros((structure.n_patches, len(PATCH_COUNTERS)), np.int64)

    @property
    def values(self) -> npt.NDArray[Any]:
        """(n_sensors,) of the structure's dtype."""
        return self.all_values[:-1]

    @property
    def status(self) -> npt.NDArray[np.uint8]:
        """(n_sensors,) uint8."""
        return self.all_status[:-1]

    @property
    def group_time_ns(self) -> npt.NDArray[np.int64]:
        """(n_groups,) int64."""
        return self.all_group_time_ns[:-1]

    @property
    def updated(self) -> npt.NDArray[np.bool_]:
        """(n_groups,) bool."""
        return self.all_updated[:-1]

    @property
    def touched(self) -> npt.NDArray[np.bool_]:
        """(n_groups,) bool."""
        return self.all_touched[:-1]

    @property
    def patch_time_ns(self) -> npt.NDArray[np.int64]:
        """(n_patches,) int64."""
        return self.all_patch_time_ns[:-1]

    @property
    def module_time_ns(self) -> npt.NDArray[np.int64]:
        """(n_modules,) int64, the oldest of the times of each module's groups."""
        first_group = np.searchsorted(self._structure.group_module, np.arange(self._structure.n_modules))
        return np.minimum.reduceat(self.group_time_ns, first_group)

    def settle_pace(self, period_ns: int) -> None:
        """Count groups whose own period is much longer than the driver's as not prompt."""
        self.is_prompt[:] = self._structure.group_period_ns <= period_ns * _PROMPT
