"""Frames in, updates out, for whole batches: in numpy, as the specification of what C does.

The kind and the module of every frame are looked up (``compiled``), the members of a cycle are paired (``pairing``),
and their payloads are read (``frame_kind``). The updates are shown (``skin_state``) when the publisher decides it.

Nothing on the wire raises here. Frames that cannot be used are counted.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from skinware.samples import Unused
from skinware_drivers.bus import FrameBatch
from skinware_drivers.counters import Samples
from skinware_drivers.decoding.addresses import STANDARD_IDENTIFIERS
from skinware_drivers.decoding.compiled import NO_KIND, CompiledLayouts
from skinware_drivers.decoding.device_numbers import DeviceStamps, Sequences
from skinware_drivers.decoding.frame_kind import Assembly
from skinware_drivers.decoding.pairing import CompiledCycle
from skinware_drivers.decoding.skin_state import SkinState, Updates
from skinware_drivers.description import SkinTables
from skinware_drivers.fields import SequenceNumber
from skinware_drivers.layout import Byte, Layout

log: logging.Logger = logging.getLogger("skinware.driver")

_EARLIEST_NS = 1
"""CLOCK_MONOTONIC begins with the machine, and 0 means never."""
_MUCH_HASTE, _NEVER_AGAIN = 200, -(1 << 62)
"""Frames that come too soon, with no whole cycle between, before a warning is logged; and their number afterwards."""

Indices = npt.NDArray[np.int64]
Bytes = npt.NDArray[np.uint8]
Flags = npt.NDArray[np.bool_]


class Decoder:
    """The state of a skin, and the decoding that changes it.

    The arrays are shared with C, which decodes in a running driver; ``decode`` does the same in numpy.

    Args:
        layouts, tables, periods_s: as for :class:`CompiledLayouts`.

    Attributes:
        tables: what is attached to the buses, with update groups.
        samples: for each bus, some of the frames that could not be used.
        sequences, device_stamps: the last numbers and the clocks of the devices.
        haste: (n_patches,) int64, frames that came too soon, since a whole cycle came.
        unknown_identifiers: (n_buses, 2048) int64, frames of each identifier of 11 bits that are of no module.

    Raises:
        ConfigurationError: the buses have more kinds of frame than a driver can have.
    """

    def __init__(
        self, layouts: Sequence[Layout | None], tables: SkinTables, periods_s: Sequence[float] | None = None
    ) -> None:
        self.compiled = CompiledLayouts(layouts, tables, periods_s)
        self.tables: SkinTables = self.compiled.tables
        structure = self.tables.structure
        self._n_modules, self._n_patches = structure.n_modules, structure.n_patches
        self._module_patch = structure.module_patch.astype(np.intp)
        self.state: SkinState = SkinState(self.tables)
        self.samples: list[Samples] = [Samples() for _ in layouts]
        self.sequences = Sequences(structure)
        self.haste = np.zeros(self._n_patches, np.int64)
        self.device_stamps: DeviceStamps = DeviceStamps(self.compiled.frames, structure)
        shape = len(structure.buses), STANDARD_IDENTIFIERS
        self.unknown_identifiers: npt.NDArray[np.int64] = np.zeros(shape, np.int64)
        self._carried: tuple[npt.NDArray[Any], Indices, npt.NDArray[np.uint16]] | None = None

    def put_back(self, batch: FrameBatch) -> None:
        """Empty a batch, except for the frames that still wait for their partners, which come first."""
        batch.clear()
        if self._carried is not None:
            wire, time_ns, bus = self._carried
            batch.start = batch.headroom - len(wire)
            rows = slice(batch.start, batch.headroom)
            batch.wire[rows], batch.time_ns[rows], batch.bus[rows] = wire, time_ns, bus
            self._carried = None

    def decode(self, batch: FrameBatch, interrupted: Sequence[int] = ()) -> tuple[Updates, Indices]:
        """Return the updates of a batch, and count its wrong frames.

        Args:
            interrupted: buses that are known to have lost frames since the last batch: frames that wait for partners on
                them are not joined with new ones.

        Returns:
            The updates in order of their time, to be shown by ``state.show``; and the rows that belong to no module, to
            be counted by ``count_unknown`` unless a handshake awaits them.
        """
        first, last = batch.start, batch.stop
        bus, payload = batch.bus[first:last], batch.wire["payload"][first:last]
        entry, kind, wrong = self.name(batch)
        new = slice(max(0, batch.headroom - first), None)  # those before have their times from the batch before
        time_ns = batch.time_ns[first:last][new]
        self.device_stamps.apply(kind[new], entry[new], payload[new], time_ns)
        self._keep_after_boot(bus[new], time_ns)
        is_module = entry < self._n_modules
        is_foreign = ~is_module
        is_foreign[wrong] = False
        foreign = np.flatnonzero(is_foreign)
        parts = []
        for number, assembly in self.compiled.alone.items():
            rows = np.flatnonzero((kind == number) & is_module)
            if len(rows):
                parts.append(self._read(assembly, batch, rows[:, None], entry[rows]))
                self._compare(self.compiled.frames[number].sequence, payload[rows], entry[rows])
        severed = np.zeros(len(bus), bool)
        if interrupted:
            severed[: new.start] = np.isin(bus[: new.start], interrupted)
        for cycle in self.compiled.cycles:
            parts += self._pair(batch, cycle, entry, is_module, kind, severed)
        if not parts:
            empty, none = np.zeros((0, self.compiled.width), np.int64), np.zeros(0, np.int64)
            groups = np.zeros((0, self.compiled.most_groups), np.int64)
            nothing = Updates(none, groups, none > 0, empty, empty, empty.astype(np.uint8), none, none, False)
            return nothing, foreign + first
        updates = Updates.join([part for part, _ in parts])
        newest_ns = updates.newest_ns
        if len(parts) > 1:
            updates = updates.take(np.lexsort((np.concatenate([rows for _, rows in parts]), newest_ns)))
        elif (newest_ns[1:] < newest_ns[:-1]).any():
            updates = updates.take(np.argsort(newest_ns, kind="stable"))
        return updates, foreign + first

    def name(self, batch: FrameBatch) -> tuple[Indices, Bytes, Indices]:
        """Find the module and the kind of the frames of a batch, and count wrong frames.

        Returns:
            (n,) module of each, ``n_modules`` or more: none; (n,) number of its kind, 255: none; and the wrong rows.
        """
        wire, bus = batch.wire[batch.start : batch.stop], batch.bus[batch.start : batch.stop]
        payload = wire["payload"]
        slots = self.compiled.addresses.slots(bus, wire["identifier"])
        entry = self.compiled.addresses.entry[slots]
        kind, wrong = self._find_kinds(slots, entry, wire, bus)
        for number, compiled in enumerate(self.compiled.kinds):
            if compiled.module_by_byte is not None:
                rows = np.flatnonzero(kind == number)
                entry[rows] = compiled.name_modules(entry[rows], payload[rows])
        return entry, kind, wrong

    def forget(self, patch: int) -> None:
        """Forget the sequence numbers, the rhythm and the clock of a patch that has restarted."""
        self.sequences.forget(patch)
        self.device_stamps.forget(patch)
        for cycle in self.compiled.cycles:
            cycle.forget(np.flatnonzero(self._module_patch == patch))

    def count_unknown(self, batch: FrameBatch, rows: Indices) -> None:
        bus, identifier = batch.bus[rows], batch.wire["identifier"][rows]
        self.state.bus_counters[:, 0] += np.bincount(bus, minlength=len(self.state.bus_counters))
        self.keep_samples(Unused.UNKNOWN, batch.bus, batch.wire, rows)
        standard = identifier < STANDARD_IDENTIFIERS
        np.add.at(self.unknown_identifiers, (bus[standard], identifier[standard]), 1)

    def _keep_after_boot(self, bus: npt.NDArray[np.uint16], time_ns: Indices) -> None:
        """Count stamps from before this machine booted (a clock that was set), and replace them by the earliest."""
        early = time_ns < _EARLIEST_NS
        if early.any():
            time_ns[early] = _EARLIEST_NS
            self.state.bus_counters[:, 3] += np.bincount(bus[early], minlength=len(self.state.bus_counters))

    def keep_samples(self, why: Unused, bus: npt.NDArray[np.uint16], wire: npt.NDArray[np.void], rows: Indices) -> None:
        """Keep some of these rows of a batch, which cannot be used."""
        if len(rows):
            for ordinal, samples in enumerate(self.samples):
                if samples.wants(why):
                    samples.take(why, wire[rows[bus[rows] == ordinal]])

    def _find_kinds(
        self, slots: Indices, entry: Indices, wire: npt.NDArray[np.void], bus: npt.NDArray[np.uint16]
    ) -> tuple[Bytes, Indices]:
        """Return (n,) kind of each frame, 255: none; and rows of ours with no kind or a wrong length, after a count."""
        n_buses, payload = len(self.state.bus_counters), wire["payload"]
        length = np.minimum(wire["length"], self.compiled.length_ok.shape[1] - 1)
        ours = entry < self._n_modules + self._n_patches
        if self.compiled.header is not None:
            at, table = self.compiled.header
            kind = table[payload[:, at], length]
            kind[~ours] = NO_KIND
        else:
            kind = self._match_kinds(slots, payload, length)
        wrong = kind == NO_KIND
        wrong &= ours
        rows = np.flatnonzero(wrong)
        if len(rows):
            rows = rows[
                (entry[rows] < self._n_modules)
                | self.compiled.payload_names[self.compiled.addresses.candidates[slots[rows]]]
            ]
            likely = self._match_kinds(slots[rows], payload[rows], length[rows], check_length=False)
            ours_too = self._name_known_modules(likely, entry[rows], payload[rows], length[rows])
            rows, likely = rows[ours_too], likely[ours_too]
            is_length = ~self.compiled.length_ok[likely, length[rows]]
            self.state.bus_counters[:, 1] += np.bincount(bus[rows[is_length]], minlength=n_buses)
            self.state.bus_counters[:, 2] += np.bincount(bus[rows[~is_length]], minlength=n_buses)
            self.keep_samples(Unused.BAD_LENGTH, bus, wire, rows[is_length])
            self.keep_samples(Unused.BAD_CONTENT, bus, wire, rows[~is_length])
        return kind, rows

    def _name_known_modules(self, kind: Bytes, entry: Indices, payload: Bytes, length: Bytes) -> Flags:
        known = np.ones(len(kind), bool)
        for number, compiled in enumerate(self.compiled.kinds):
            bits = compiled.frame.module_byte
            if bits is not None and bits.byte is not None:
                rows = np.flatnonzero((kind == number) & (length > bits.byte))
                known[rows] = compiled.name_modules(entry[rows], payload[rows]) < self._n_modules
        return known

    def _match_kinds(self, slots: Indices, payload: Bytes, length: Bytes, check_length: bool = True) -> Bytes:
        """Return (n,) the last kind whose conditions hold, and whose length is right if it is checked; 255: none."""
        kind = np.full(len(slots), NO_KIND, np.uint8)
        candidates = self.compiled.addresses.candidates[slots]
        for number, frame in enumerate(self.compiled.frames):
            match = self.compiled.addresses.sets[:, number][candidates]
            for condition in frame.when:
                if isinstance(condition, Byte):
                    match &= payload[:, condition.offset] & condition.mask == condition.value
                    match &= length > condition.offset
            kind[match] = number
        if check_length:
            kind[~self.compiled.length_ok[kind, length]] = NO_KIND
        return kind

    def _pair(
        self, batch: FrameBatch, cycle: CompiledCycle, entry: Indices, is_module: Flags, kind: Bytes, severed: Flags
    ) -> list[tuple[Updates, Indices]]:
        """Return the whole cycles and the orphans of a batch; keep rows that may become whole for the next batch."""
        wire, time_ns = batch.wire[batch.start : batch.stop], batch.time_ns[batch.start : batch.stop]
        pairs = cycle.find(entry, kind, wire["payload"], time_ns, is_module, severed)
        if len(pairs.waiting):
            self._carry(batch, pairs.waiting + batch.start)
        if not len(pairs.rows):
            return []
        module, whole = entry[pairs.rows[:, 0]], pairs.whole
        self._count_patches(1, module[~whole])
        self._count_patches(2, entry[pairs.late])
        self._count_haste(entry[pairs.soon], module[whole])
        if cycle.sequence is not None:
            member, sequence = cycle.sequence
            self._compare(sequence, wire["payload"][pairs.rows[whole, member]], module[whole])
        return [self._read(cycle.assembly, batch, pairs.rows, module, whole)]

    def _count_haste(self, soon: Indices, whole: Indices) -> None:
        """Count frames that come too soon: a patch that always sends such frames is not shown, and a warning says why.

        Args:
            soon: modules whose frames came too soon.
            whole: modules of which whole cycles came.
        """
        haste = self.haste
        haste += np.bincount(self._module_patch[soon], minlength=self._n_patches)
        haste[self._module_patch[whole]] = np.minimum(haste[self._module_patch[whole]], 0)
        self.warn_of_haste()

    def warn_of_haste(self) -> None:
        for patch in np.flatnonzero(self.haste > _MUCH_HASTE).tolist():
            self.haste[patch] = _NEVER_AGAIN
            log.warning(
                "%s sends its cycles so fast that several fit into the layout's maximum_age_s: they cannot be"
                " distinguished and are not shown; give the driver the right period (period_ms, period_s); logged once",
                self.tables.structure.patch_name[patch].decode(),
            )

    def _carry(self, batch: FrameBatch, rows: Indices) -> None:
        kept = batch.wire[rows], batch.time_ns[rows], batch.bus[rows]
        if self._carried is not None:  # of another cycle, that is to say of other modules
            wire, time_ns, bus = self._carried
            kept = np.concatenate([wire, kept[0]]), np.concatenate([time_ns, kept[1]]), np.concatenate([bus, kept[2]])
        self._carried = kept

    def _read(
        self, assembly: Assembly, batch: FrameBatch, rows: Indices, module: Indices, whole: Flags | None = None
    ) -> tuple[Updates, Indices]:
        wire, time_ns = batch.wire[batch.start : batch.stop], batch.time_ns[batch.start : batch.stop]
        values = np.zeros((len(rows), self.compiled.width), self.state.values.dtype)
        status = np.zeros((len(rows), self.compiled.width), np.uint8)
        if whole is None:
            whole = np.ones(len(rows), bool)
        sensors, unreadable = assembly.read(wire, rows, module, np.flatnonzero(~whole), values, status)
        if len(unreadable):
            whole = self._count_unreadable(batch, rows, module, unreadable, whole)
        self._count_patches(0, module[whole])
        oldest_ns = newest_ns = time_ns[rows[:, 0]]
        last_row = rows[:, 0]
        for member in range(1, rows.shape[1]):
            stamps_ns = time_ns[rows[:, member]]
            oldest_ns, newest_ns = np.minimum(oldest_ns, stamps_ns), np.maximum(newest_ns, stamps_ns)
            last_row = np.maximum(last_row, rows[:, member])
        flagged = bool(status.any())
        groups = assembly.groups[module]
        return Updates(module, groups, whole, sensors, values, status, oldest_ns, newest_ns, flagged), last_row

    def _count_unreadable(
        self, batch: FrameBatch, rows: Indices, module: Indices, unreadable: Indices, whole: Flags
    ) -> Flags:
        """Return (n,) which updates are still whole without those frames; their partners become orphans."""
        spoilt, n_frames = np.unique(unreadable, return_counts=True)
        bus = batch.bus[batch.start + rows[unreadable, 0]]
        self.state.bus_counters[:, 2] += np.bincount(bus, minlength=len(self.state.bus_counters))
        self._count_patches(1, np.repeat(module[spoilt], rows.shape[1] - n_frames))
        whole = whole.copy()
        whole[spoilt] = False
        return whole

    def _count_patches(self, counter: int, module: Indices) -> None:
        patch = self._module_patch[module]
        self.state.patch_counters[:, counter] += np.bincount(patch, minlength=self._n_patches)

    def _compare(self, sequence: SequenceNumber | None, payload: Bytes, module: Indices) -> None:
        if sequence is not None and len(module):
            for counter, found in enumerate(self.sequences.compare(sequence, payload, module), start=3):
                self.state.patch_counters[:, counter] += found
