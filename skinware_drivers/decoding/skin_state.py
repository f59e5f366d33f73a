"""What is known of the skin right now, and the updates that change it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from skinware.status import Status
from skinware_drivers.description import SkinTables

BUS_COUNTERS = ("unknown", "bad_length", "bad_content", "before_boot")
"""Per bus: identifiers that are none of ours, wrong payload lengths, known identifiers with unknown content; frames
stamped before this machine booted."""
PATCH_COUNTERS = ("updates", "orphans", "late", "sequence_lost", "sequence_repeated", "sequence_back")
"""Per patch: module updates decoded; frames without their partners; of those, cycles whose frames came too late, or out
of the device's rhythm; what sequence numbers skipped; how often one came again, and how often they went back (out of
order, or a restart)."""
_PROMPT = 1.5
"""The longest period of a group that frames wait for, in periods of the driver."""


@dataclass(slots=True)
class Updates:
    """New values of modules, in order of arrival; they hold no reference to the frames that they came from.

    Attributes:
        module: (n,) int64.
        groups: (n, most) int64, update groups that each belongs to; ``n_groups``: none. The first stands for it.
        whole: (n,) bool; False: only a part was heard (an orphan), which shows nothing.
        sensors: (n, width) int64, where the values go; ``n_sensors`` = nowhere.
        values: (n, width) of the structure's dtype.
        status: (n, width) uint8, what the wire said of each.
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

    def take(self, which: slice | npt.NDArray[Any]) -> Updates:
        """Some of them."""
        return Updates(
            self.module[which],
            self.groups[which],
            self.whole[which],
            self.sensors[which],
            self.values[which],
            self.status[which],
            self.oldest_ns[which],
            self.newest_ns[which],
            self.flagged,
        )

    @staticmethod
    def join(parts: Sequence[Updates]) -> Updates:
        """All of several, one after the other."""
        if len(parts) == 1:
            return parts[0]
        return Updates(
            np.concatenate([p.module for p in parts]),
            np.concatenate([p.groups for p in parts]),
            np.concatenate([p.whole for p in parts]),
            np.concatenate([p.sensors for p in parts]),
            np.concatenate([p.values for p in parts]),
            np.concatenate([p.status for p in parts]),
            np.concatenate([p.oldest_ns for p in parts]),
            np.concatenate([p.newest_ns for p in parts]),
            any(p.flagged for p in parts),
        )


class SkinState:
    """Private arrays, copied into the ring at publication.

    Attributes:
        values: (n_sensors,) of the structure's dtype.
        status: (n_sensors,) uint8, what the wire said of each sensor.
        group_time_ns: (n_groups,) int64, oldest stamp among the frames shown for an update group; 0 = never.
        updated: (n_groups,) bool, shown since the last publication.
        touched: (n_groups,) bool, heard since then, if only in part.
        is_prompt: (n_groups,) bool: updated in every period, so that frames wait for it.
        patch_time_ns: (n_patches,) int64, newest stamp of a complete update of a prompt group; 0 = never.
        newest_ns: newest stamp of all.
        bus_counters: (n_buses, len(BUS_COUNTERS)) int64.
        patch_counters: (n_patches, len(PATCH_COUNTERS)) int64.
    """

    def __init__(self, tables: SkinTables) -> None:
        structure = tables.structure
        # one element more than there is: it takes what belongs nowhere, which is cheaper than to sort it out
        self.values_and_sink = np.zeros(structure.n_sensors + 1, structure.dtype)
        self.status_and_sink = np.full(structure.n_sensors + 1, int(Status.NEVER_SEEN), np.uint8)
        self._group_time_ns = np.zeros(structure.n_groups + 1, np.int64)
        self._updated = np.zeros(structure.n_groups + 1, bool)
        self._touched = np.zeros(structure.n_groups + 1, bool)
        self._patch_time_ns = np.zeros(structure.n_patches + 1, np.int64)
        self.values: npt.NDArray[Any] = self.values_and_sink[:-1]
        self.status: npt.NDArray[np.uint8] = self.status_and_sink[:-1]
        self.group_time_ns: npt.NDArray[np.int64] = self._group_time_ns[:-1]
        self.updated: npt.NDArray[np.bool_] = self._updated[:-1]
        self.patch_time_ns: npt.NDArray[np.int64] = self._patch_time_ns[:-1]
        self.touched: npt.NDArray[np.bool_] = self._touched[:-1]
        self.is_prompt: npt.NDArray[np.bool_] = np.ones(structure.n_groups, bool)
        self.newest_ns: int = 0
        self._group_period_ns = structure.group_period_ns
        self.bus_counters: npt.NDArray[np.int64] = np.zeros((len(structure.buses), len(BUS_COUNTERS)), np.int64)
        self.patch_counters: npt.NDArray[np.int64] = np.zeros((structure.n_patches, len(PATCH_COUNTERS)), np.int64)
        self._status_is_zero = False
        self._nobody, self._no_patch = structure.n_groups, structure.n_patches
        self.group_patch = structure.group_patch.astype(np.intp)
        self._patch = np.append(self.group_patch, self._no_patch)
        self._first_group = np.searchsorted(structure.group_module, np.arange(structure.n_modules))

    @property
    def module_time_ns(self) -> npt.NDArray[np.int64]:
        """(n_modules,) int64, the oldest of the times of each module's groups."""
        return np.minimum.reduceat(self.group_time_ns, self._first_group)

    def settle_pace(self, period_ns: int) -> None:
        """Take groups whose own period is much longer than the driver's as not prompt."""
        self.is_prompt[:] = self._group_period_ns <= period_ns * _PROMPT
        self._patch[:-1] = np.where(self.is_prompt, self.group_patch, self._no_patch)

    def show(self, updates: Updates) -> None:
        """Show updates. Of several for one module, the last one stays."""
        if not len(updates):
            return
        shown = np.where(updates.whole[:, None], updates.groups, self._nobody)
        self.values_and_sink[updates.sensors] = updates.values
        if updates.flagged or not self._status_is_zero:
            self.status_and_sink[updates.sensors] = updates.status
            self._status_is_zero = not updates.flagged and not self.status.any()
        self._group_time_ns[shown] = updates.oldest_ns[:, None]
        self._updated[shown] = True
        self._touched[updates.groups] = True
        self._patch_time_ns[self._patch[shown[:, 0]]] = updates.newest_ns
        self.newest_ns = max(self.newest_ns, int(updates.newest_ns[-1]))

    def begin_frame(self) -> None:
        """Forget what was shown since the last publication."""
        self.updated[:] = False
        self.touched[:] = False
