"""The state of a skin and its decoder, on arrays that C changes; ``tests/specification`` says what C does."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from skinware.status import Status, Unused
from skinware_drivers.counters import Samples
from skinware_drivers.decoding.addresses import STANDARD_IDENTIFIERS
from skinware_drivers.decoding.compiled import CompiledLayouts
from skinware_drivers.description import SkinTables
from skinware_drivers.fields import SequenceNumber
from skinware_drivers.layout import Layout

log: logging.Logger = logging.getLogger("skinware.driver")

Indices = npt.NDArray[np.int64]
Bytes = npt.NDArray[np.uint8]

BUS_COUNTERS = ("unknown", "bad_length", "bad_content", "before_boot")
"""Per bus: frames with foreign identifiers, wrong lengths, or unknown contents; frames stamped before this machine
booted."""
PATCH_COUNTERS = ("updates", "orphans", "late", "sequence_lost", "sequence_repeated", "sequence_back")
"""Per patch: updates of modules; frames without partners; cycles whose frames came too late, or out of the device's
rhythm; sequence numbers that were skipped, were repeated, or went back (overtaken ones, or a restart)."""
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

    def take(self, which: slice | npt.NDArray[Any]) -> Updates:
        """Return some of the updates."""
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


class SkinState:
    """Values, status and times of a skin; copied into the ring at publication.

    The arrays have one element more than there are sensors, groups or patches, for values without a sensor: that is
    cheaper than to sort them out. ``values``, ``status``, ``group_time_ns`` ... are views without that element.

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
        self.values, self.status, self.group_time_ns = (
            self.all_values[:-1],
            self.all_status[:-1],
            self.all_group_time_ns[:-1],
        )
        self.patch_time_ns = self.all_patch_time_ns[:-1]
        self.bus_counters: npt.NDArray[np.int64] = np.zeros((len(structure.buses), len(BUS_COUNTERS)), np.int64)
        self.patch_counters: npt.NDArray[np.int64] = np.zeros((structure.n_patches, len(PATCH_COUNTERS)), np.int64)

    @property
    def updated(self) -> npt.NDArray[np.bool_]:
        return self.all_updated[:-1]

    @property
    def touched(self) -> npt.NDArray[np.bool_]:
        return self.all_touched[:-1]

    @property
    def module_time_ns(self) -> npt.NDArray[np.int64]:
        """(n_modules,) int64, the oldest of the times of each module's groups."""
        first_group = np.searchsorted(self._structure.group_module, np.arange(self._structure.n_modules))
        return np.minimum.reduceat(self.group_time_ns, first_group)

    def settle_pace(self, period_ns: int) -> None:
        """Count groups whose own period is much longer than the driver's as not prompt."""
        self.is_prompt[:] = self._structure.group_period_ns <= period_ns * _PROMPT


NONE_YET = -1
_MUCH_HASTE, _NEVER_AGAIN = 200, -(1 << 62)
"""Frames that come too soon, with no whole cycle between, before a warning is logged; and their number, and that
of a clock's stops, afterwards."""


def read_numbers(payload: Bytes, sequence: SequenceNumber) -> Indices:
    """Return (n,) the sequence number in each of n payloads; ``payload``: (n, size) uint8."""
    word = np.ascontiguousarray(payload[:, sequence.offset : sequence.end]).view(sequence.dtype)[:, 0]
    if sequence.mask is not None:
        word = (word & word.dtype.type(sequence.mask)) >> word.dtype.type(sequence.shift)
    plain: Indices = word.astype(np.int64)
    return plain


class Decoder:
    """The compiled layouts of a driver's buses, and the state of its skin.

    Nothing on the wire raises. Frames that cannot be used are counted.

    Attributes:
        samples: for each bus, some of the frames that could not be used.
        last_sequence: (n_modules, 3) int64, of each the newest sequence number, which of the 64 before came (as bits),
            and one that was left out; -1: none yet.
        module_flags: (n_modules,) uint8, status bits that status frames set for other modules.
        haste: (n_patches,) int64, frames that came too soon, since a whole cycle came.
        knows_clock: (n_patches,) bool, something is known of the device's own clock.
        clock_stops: (n_patches,) int64, how often that clock was found to stand still.
        unknown_identifiers: (n_buses, 2048) int64, frames of each identifier of 11 bits that are of no module.
    """

    def __init__(
        self, layouts: Sequence[Layout | None], tables: SkinTables, periods_s: Sequence[float] | None = None
    ) -> None:
        self.compiled = CompiledLayouts(layouts, tables, periods_s)
        self.tables: SkinTables = self.compiled.tables
        structure = self.tables.structure
        self._module_patch = structure.module_patch.astype(np.intp)
        self.state: SkinState = SkinState(self.tables)
        self.samples: list[Samples] = [Samples() for _ in layouts]
        self.last_sequence = np.full((structure.n_modules, 3), NONE_YET, np.int64)
        self.module_flags = np.zeros(structure.n_modules, np.uint8)
        self.haste = np.zeros(structure.n_patches, np.int64)
        self.knows_clock = np.zeros(structure.n_patches, bool)
        self.clock_stops = np.zeros(structure.n_patches, np.int64)
        shape = len(structure.buses), STANDARD_IDENTIFIERS
        self.unknown_identifiers: npt.NDArray[np.int64] = np.zeros(shape, np.int64)

    def forget(self, patch: int) -> None:
        """Forget the sequence numbers, the flags, the rhythm and the clock of a patch that has restarted."""
        self.knows_clock[patch] = False
        modules = np.flatnonzero(self._module_patch == patch)
        self.last_sequence[modules] = NONE_YET
        self.module_flags[modules] = 0
        for cycle in self.compiled.cycles:
            cycle.forget(modules)

    def keep_samples(self, why: Unused, bus: npt.NDArray[np.uint16], wire: npt.NDArray[np.void], rows: Indices) -> None:
        """Keep some of these rows of a batch, which cannot be used."""
        if len(rows):
            for ordinal, samples in enumerate(self.samples):
                if samples.wants(why):
                    samples.take(why, wire[rows[bus[rows] == ordinal]])

    def warn(self) -> None:
        """Log once that a patch sends too fast, or that its clock stands still."""
        structure = self.tables.structure
        for patch in np.flatnonzero(self.clock_stops > 0).tolist():
            self.clock_stops[patch] = _NEVER_AGAIN
            log.warning(
                "%s: the clock of %s stands still, or is far too slow: its samples have the times of their"
                " receipt; logged once",
                structure.buses[structure.patch_bus[patch]],
                structure.patch_name[patch].decode(),
            )
        for patch in np.flatnonzero(self.haste > _MUCH_HASTE).tolist():
            self.haste[patch] = _NEVER_AGAIN
            log.warning(
                "%s sends its cycles so fast that several fit into the layout's maximum_age_s: they cannot be"
                " distinguished and are not shown; give the driver the right period (period_ms, period_s); logged once",
                structure.patch_name[patch].decode(),
            )
