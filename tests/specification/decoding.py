"""Frames in, updates out, for whole batches, in numpy: what ``naming.c`` and ``decoding.c`` are compared with.

The kind and the module of every frame are looked up, the members of a cycle are paired (``pairing``), and their
payloads are read (``reading``). The updates are shown when the publisher decides it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from skinware.status import Unused
from skinware_drivers.bus import FrameBatch
from skinware_drivers.decoding.addresses import FIELD_BITS, STANDARD_IDENTIFIERS, Addresses, Form, KeyField
from skinware_drivers.decoding.compiled import NO_KIND, Assembly, CompiledCycle
from skinware_drivers.decoding.decoder import NONE_YET, PATCH_COUNTERS, Decoder, SkinState, Updates, read_numbers
from skinware_drivers.description import SkinTables
from skinware_drivers.fields import Byte, Flag, SequenceNumber
from skinware_drivers.layout import Layout
from tests.specification.device_time import DeviceStamps
from tests.specification.pairing import Pairing
from tests.specification.reading import name_modules, read_updates

_LOST, _REPEATED, _BACK = (PATCH_COUNTERS.index(f"sequence_{what}") for what in ("lost", "repeated", "back"))
_WINDOW = 64
_EARLIEST_NS = 1
"""CLOCK_MONOTONIC begins with the machine, and 0 means never."""

Indices = npt.NDArray[np.int64]
Bytes = npt.NDArray[np.uint8]
Flags = npt.NDArray[np.bool_]


def join(parts: Sequence[Updates]) -> Updates:
    """Return the updates of several objects, one after the other."""
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


def slots_of(addresses: Addresses, bus: npt.NDArray[np.uint16], identifier: npt.NDArray[np.uint32]) -> Indices:
    slots: Indices = bus * np.int64(STANDARD_IDENTIFIERS) + identifier
    if len(identifier) and identifier.max() >= STANDARD_IDENTIFIERS:
        rows = np.flatnonzero(identifier >= STANDARD_IDENTIFIERS)
        slots[rows] = addresses.foreign
        for form in addresses.forms:
            _look_up(form, bus[rows], identifier[rows].astype(np.int64), slots, rows)
    return slots


def _look_up(form: Form, bus: npt.NDArray[np.uint16], identifier: Indices, slots: Indices, rows: Indices) -> None:
    match = bus == form.bus
    for condition in form.conditions:
        match &= identifier & condition.mask == condition.value
    hits = np.flatnonzero(match)
    if not len(hits):
        return
    patch_key = _field(form.patch, identifier[hits])
    code = patch_key << FIELD_BITS | _field(form.module, identifier[hits])
    for codes, found, key in ((form.patch_codes, form.patch_slots, patch_key), (form.codes, form.slots, code)):
        if len(codes):
            at = np.minimum(np.searchsorted(codes, key), len(codes) - 1)
            known = codes[at] == key
            slots[rows[hits[known]]] = found[at[known]]


def _field(field: KeyField, identifier: Indices) -> Indices:
    return identifier >> field.shift & field.mask | field.constant


class SpecifiedState(SkinState):
    """The state of a skin that shows updates.

    Attributes:
        newest_ns: newest stamp of all.
    """

    newest_ns: int = 0

    def show(self, updates: Updates) -> None:
        """Show updates; if there are several of one module, the last one stays."""
        if not len(updates):
            return
        shown = np.where(updates.whole[:, None], updates.groups, self._structure.n_groups)
        self.all_values[updates.sensors] = updates.values
        self.all_status[updates.sensors] = updates.status
        self.all_group_time_ns[shown] = updates.oldest_ns[:, None]
        self.all_updated[shown] = True
        self.all_touched[updates.groups] = True
        patch = np.where(self.is_prompt, self.group_patch, self._structure.n_patches)
        self.all_patch_time_ns[np.append(patch, self._structure.n_patches)[shown[:, 0]]] = updates.newest_ns
        self.newest_ns = max(self.newest_ns, int(updates.newest_ns[-1]))


class SpecifiedDecoder(Decoder):
    """A decoder that decodes by itself."""

    state: SpecifiedState

    def __init__(
        self, layouts: Sequence[Layout | None], tables: SkinTables, periods_s: Sequence[float] | None = None
    ) -> None:
        super().__init__(layouts, tables, periods_s)
        self.state = SpecifiedState(self.tables)
        self.device_stamps = DeviceStamps(self)
        self._n_modules, self._n_patches = self.tables.structure.n_modules, self.tables.structure.n_patches
        self._pairings = [(cycle, Pairing(cycle)) for cycle in self.compiled.cycles]
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
        self._leave_out_overtaken(entry, kind, payload)
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
        severed = np.zeros(len(bus), bool)
        if interrupted:
            severed[: new.start] = np.isin(bus[: new.start], interrupted)
        for cycle, pairing in self._pairings:
            parts += self._pair(batch, cycle, pairing, entry, is_module, kind, severed)
        if not parts:
            empty, none = np.zeros((0, self.compiled.width), np.int64), np.zeros(0, np.int64)
            groups = np.zeros((0, self.compiled.most_groups), np.int64)
            nothing = Updates(none, groups, none > 0, empty, empty, empty.astype(np.uint8), none, none, False)
            return nothing, foreign + first
        updates = join([part for part, _ in parts])
        newest_ns, rows = updates.newest_ns, np.concatenate([rows for _, rows in parts])
        order = np.lexsort((rows, newest_ns)) if len(parts) > 1 else np.argsort(newest_ns, kind="stable")
        updates = updates.take(order)
        self._add_module_flags(updates, kind, batch.wire[first:last], rows[order])
        return updates, foreign + first

    def _add_module_flags(self, updates: Updates, kind: Bytes, wire: npt.NDArray[np.void], rows: Indices) -> None:
        if not any(frame.module_flags for frame in self.compiled.frames):
            return
        for number, row in enumerate(rows.tolist()):
            module = int(updates.module[number])
            if updates.whole[number]:
                for flag in self.compiled.frames[kind[row]].module_flags:
                    end = flag.offset + np.dtype(flag.dtype).itemsize
                    if wire["length"][row] >= end:
                        word = int(wire["payload"][row, flag.offset : end].view(flag.dtype)[0]) ^ flag.normal
                        self._flag_modules(flag, word, int(self._module_patch[module]))
                updates.status[number] |= self.module_flags[module]
        updates.flagged |= bool(updates.status.any())

    def _flag_modules(self, flag: Flag, word: int, patch: int) -> None:
        for key, bit in flag.each_module:
            module = self.tables.module_key.get((patch, key))
            if module is not None:
                others = int(self.module_flags[module]) & ~int(flag.status)
                self.module_flags[module] = others | (int(flag.status) if word >> bit & 1 else 0)

    def name(self, batch: FrameBatch) -> tuple[Indices, Bytes, Indices]:
        """Find the module and the kind of the frames of a batch, and count wrong frames.

        Returns:
            (n,) module of each, ``n_modules`` or more: none; (n,) number of its kind, 255: none; and the wrong rows.
        """
        wire, bus = batch.wire[batch.start : batch.stop], batch.bus[batch.start : batch.stop]
        payload = wire["payload"]
        slots = slots_of(self.compiled.addresses, bus, wire["identifier"])
        entry = self.compiled.addresses.entry[slots]
        kind, wrong = self._find_kinds(slots, entry, wire, bus)
        for number, compiled in enumerate(self.compiled.kinds):
            if compiled.module_by_byte is not None:
                rows = np.flatnonzero(kind == number)
                entry[rows] = name_modules(compiled, entry[rows], payload[rows], self._n_modules)
        return entry, kind, wrong

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
                known[rows] = name_modules(compiled, entry[rows], payload[rows], self._n_modules) < self._n_modules
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
        self,
        batch: FrameBatch,
        cycle: CompiledCycle,
        pairing: Pairing,
        entry: Indices,
        is_module: Flags,
        kind: Bytes,
        severed: Flags,
    ) -> list[tuple[Updates, Indices]]:
        """Return the whole cycles and the orphans of a batch; keep rows that may become whole for the next batch."""
        wire, time_ns = batch.wire[batch.start : batch.stop], batch.time_ns[batch.start : batch.stop]
        pairs = pairing.find(entry, kind, wire["payload"], time_ns, is_module, severed)
        if len(pairs.waiting):
            self._carry(batch, pairs.waiting + batch.start)
        if not len(pairs.rows):
            return []
        module, whole = entry[pairs.rows[:, 0]], pairs.whole
        self._count_patches("orphans", module[~whole])
        self._count_patches("late", entry[pairs.late])
        self._count_haste(entry[pairs.soon], module[whole])
        if cycle.sequence is not None:
            member, sequence = cycle.sequence
            shown = ~whole
            shown[whole] = ~self._overtaken(sequence, wire["payload"][pairs.rows[whole, member]], module[whole])
            module, whole = module[shown], whole[shown]
            return [self._read(cycle.assembly, batch, pairs.rows[shown], module, whole)] if len(module) else []
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
        self.warn()

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
        sensors, unreadable = read_updates(
            assembly, self.tables.structure.n_sensors, wire, rows, module, np.flatnonzero(~whole), values, status
        )
        if len(unreadable):
            whole = self._count_unreadable(batch, rows, module, unreadable, whole)
        self._count_patches("updates", module[whole])
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
        self._count_patches("orphans", np.repeat(module[spoilt], rows.shape[1] - n_frames))
        whole = whole.copy()
        whole[spoilt] = False
        return whole

    def _count_patches(self, counter: str, module: Indices) -> None:
        patch = self._module_patch[module]
        self.state.patch_counters[:, PATCH_COUNTERS.index(counter)] += np.bincount(patch, minlength=self._n_patches)

    def _leave_out_overtaken(self, entry: Indices, kind: Bytes, payload: Bytes) -> None:
        """Set the kind of frames that others have overtaken to 255; those of cycles are compared as a whole."""
        for row in np.flatnonzero((entry < self._n_modules) & np.isin(kind, list(self.compiled.alone))).tolist():
            rows = slice(row, row + 1)
            if self._overtaken(self.compiled.frames[kind[row]].sequence, payload[rows], entry[rows]).any():
                kind[row] = NO_KIND

    def _overtaken(self, sequence: SequenceNumber | None, payload: Bytes, module: Indices) -> Flags:
        """Compare the numbers of frames, in order of arrival, with those of their module before, and count.

        Args:
            payload: (n, size) uint8.
            module: (n,) module of each.

        Returns:
            (n,) which frames others have overtaken, or repeat an old number that none follows: they are not shown.
        """
        found = np.zeros(len(module), bool)
        if sequence is None:
            return found
        turn = sequence.turn
        for at, (one, number) in enumerate(zip(module.tolist(), read_numbers(payload, sequence).tolist(), strict=True)):
            newest, came, left_out = self.last_sequence[one].tolist()
            step = 1 if newest == NONE_YET else (number - newest) % turn
            back, counters = turn - step, self.state.patch_counters[self._module_patch[one]]
            is_back = step > turn // 2
            is_near = is_back and back <= _WINDOW and turn > 2 * _WINDOW
            counters[_BACK] += is_back
            if is_near and not came >> (back - 1) & 1:
                counters[_LOST] -= 1
                came, found[at] = came | 1 << (back - 1), True
            elif is_near and left_out != (number - 1) % turn:
                left_out, found[at] = number, True
            else:
                counters[_LOST] += 0 if is_back else max(step - 1, 0)
                counters[_REPEATED] += step == 0
                if is_back:
                    came = -1
                elif step:
                    came = 0 if step > _WINDOW else (came << 1 | 1) << (step - 1)
                newest, left_out = number, NONE_YET
            came &= (1 << _WINDOW) - 1
            self.last_sequence[one] = newest, came - (came >> (_WINDOW - 1) << _WINDOW), left_out
        return found
