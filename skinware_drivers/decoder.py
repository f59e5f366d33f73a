"""Frames in, updates out: a layout compiled to lookup tables, applied to whole batches.

Every identifier is looked up in one table (bus and identifier together), the kinds of frame are told apart, the
members of a cycle are paired (``pairing``), and their payloads read (``frame_kind``). The updates are then shown
(``skin_state``) when the publisher finds it right.

Nothing on the wire raises here. What cannot be used is counted.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from skinware_drivers.bus import FrameBatch
from skinware_drivers.description import SkinTables
from skinware_drivers.frame_kind import Assembly, FrameKind, bits_of
from skinware_drivers.layout import Byte, Frame, Identifier, Layout
from skinware_drivers.pairing import Pairing
from skinware_drivers.skin_state import SkinState, Updates

_IDENTIFIERS = 1 << 11
_NO_KIND = 255

Indices = npt.NDArray[np.int64]
Bytes = npt.NDArray[np.uint8]
Flags = npt.NDArray[np.bool_]


class Decoder:
    """A compiled layout for one set of tables.

    Args:
        layout: what frames mean.
        tables: what hangs on the buses.
    """

    def __init__(self, layout: Layout, tables: SkinTables) -> None:
        self.layout = layout
        self.tables = tables
        self.state = SkinState(tables)
        structure = tables.structure
        self._n_modules, self._n_patches = structure.n_modules, structure.n_patches
        self._nobody = self._n_modules + self._n_patches
        self._module_patch = structure.module_patch.astype(np.intp)
        self._frames = list(layout.frames)
        names = [frame.name for frame in self._frames]
        self._members = [names.index(name) for name in layout.cycle.members] if layout.cycle else []
        self._alone = [number for number in range(len(names)) if number not in self._members]
        self._kinds = [FrameKind(frame, tables) for frame in self._frames]
        self._compile_assemblies()
        self._compile_pairing()
        self._entry, self._kinds_of = self._compile_identifiers()
        self._length_ok = np.zeros((256, 256), bool)  # by kind; the last row: right for any frame
        for kind, frame in enumerate(self._frames):
            self._length_ok[[kind, _NO_KIND], np.array(frame.length)[:, None]] = True
        self._header = self._compile_header()
        self._carried: tuple[npt.NDArray[Any], Indices, npt.NDArray[np.uint16]] | None = None
        self._last_sequence = np.full(self._n_modules, -1, np.int64)
        self.unknown_identifiers = np.zeros((len(structure.buses), _IDENTIFIERS), np.int64)

    @property
    def headroom(self) -> int:
        """Rows that a batch must keep free in front for frames that wait for their partners."""
        return max(self._n_modules, self._n_patches) * max(0, len(self._members) - 1)

    def put_back(self, batch: FrameBatch) -> None:
        """Empty a batch, except for the frames that still wait for their partners, which come first."""
        batch.clear()
        if self._carried is not None:
            wire, time_ns, bus = self._carried
            batch.start = batch.headroom - len(wire)
            rows = slice(batch.start, batch.headroom)
            batch.wire[rows], batch.time_ns[rows], batch.bus[rows] = wire, time_ns, bus
            self._carried = None

    def decode(self, batch: FrameBatch) -> tuple[Updates, Indices]:
        """Find the updates of a batch; count what is wrong with the frames of our modules.

        Returns:
            The updates in order of their time, to be shown by ``state.show``; and the rows that belong to no module:
            whoever knows that nobody waits for them has them counted (``count_unknown``).
        """
        first, last = batch.start, batch.stop
        wire, bus = batch.wire[first:last], batch.bus[first:last]
        payload, identifier = wire["payload"], wire["identifier"]
        key = bus * np.int64(_IDENTIFIERS) + identifier
        if len(identifier) and identifier.max() >= _IDENTIFIERS:
            key[identifier >= _IDENTIFIERS] = len(self._entry) - 1
        entry = self._entry[key]
        kind = self._tell_kinds(key, entry, wire["length"], payload, bus)
        for number, compiled in enumerate(self._kinds):
            if compiled.module_by_byte is not None:
                rows = np.flatnonzero(kind == number)
                entry[rows] = compiled.name_modules(entry[rows], payload[rows])
        is_module = entry < self._n_modules
        foreign = np.flatnonzero(~is_module)
        parts = []
        for number in self._alone:
            rows = np.flatnonzero((kind == number) & is_module)
            if len(rows):
                parts.append(self._read(self._assemblies[number], batch, rows[:, None], entry[rows]))
                self._check_sequence(number, payload[rows], entry[rows])
        if self._pairing is not None:
            parts += self._pair(batch, self._pairing, entry, is_module, kind)
        if not parts:
            return self._no_updates, foreign + first
        updates = Updates.join([part for part, _ in parts])
        newest_ns = updates.newest_ns
        if len(parts) > 1:
            updates = updates.take(np.lexsort((np.concatenate([rows for _, rows in parts]), newest_ns)))
        elif (newest_ns[1:] < newest_ns[:-1]).any():
            updates = updates.take(np.argsort(newest_ns, kind="stable"))
        return updates, foreign + first

    def count_unknown(self, batch: FrameBatch, rows: Indices) -> None:
        """Count frames of a batch as unknown identifiers."""
        bus, identifier = batch.bus[rows], batch.wire["identifier"][rows]
        self.state.bus_counters[:, 0] += np.bincount(bus, minlength=len(self.state.bus_counters))
        standard = identifier < _IDENTIFIERS
        np.add.at(self.unknown_identifiers, (bus[standard], identifier[standard]), 1)

    # -- compiling ----------------------------------------------------------------------------------------------

    def _compile_assemblies(self) -> None:
        groups = [[number] for number in self._alone] + ([self._members] if self._members else [])
        width = max(sum(len(self._kinds[number].channels) for number in group) for group in groups)
        made = [Assembly([self._kinds[n] for n in group], self.tables, width) for group in groups]
        self._assemblies = dict(zip(self._alone, made, strict=False))
        self._cycle_assembly = made[-1]
        self._width = width
        empty, none = np.zeros((0, width), np.int64), np.zeros(0, np.int64)
        self._no_updates = Updates(none, none > 0, empty, empty, empty.astype(np.uint8), none, none, False)

    def _compile_pairing(self) -> None:
        structure = self.tables.structure
        self._pairing: Pairing | None = None
        if self.layout.cycle is None:
            return
        places = np.full(256, len(self._members), np.uint8)
        places[self._members] = np.arange(len(self._members))
        self._pairing = Pairing(self.layout.cycle, places)
        if self.layout.cycle.within == "patch":
            groups = np.concatenate([structure.module_patch, np.arange(self._n_patches), [self._n_patches]])
        else:
            groups = np.minimum(np.arange(self._nobody + 1), 0xFFFF)
        self._group_of_entry = groups.astype(np.uint16)

    def _compile_identifiers(self) -> tuple[Indices, npt.NDArray[np.uint16]]:
        """Tables over bus * 2048 + identifier: what it names, and which kinds of frame it can be.

        Entries 0 to n_modules - 1 are modules, then n_patches entries for "some module of this patch", then one
        for "none of ours".
        """
        n_buses = len(self.tables.structure.buses)
        entry = np.full(n_buses * _IDENTIFIERS + 1, self._nobody, np.int64)
        kinds = np.zeros(n_buses * _IDENTIFIERS + 1, np.uint16)
        for bus in range(n_buses):
            for number, frame in enumerate(self._frames):
                for identifier in _matching_identifiers(frame):
                    patch = self.tables.patch_key.get((bus, bits_of(identifier, frame.patch)))
                    if patch is None:
                        continue
                    at = bus * _IDENTIFIERS + identifier
                    found = self._n_modules + patch
                    if frame.module is None or frame.module.byte is None:
                        found = self.tables.module_key.get((patch, bits_of(identifier, frame.module)), found)
                    entry[at] = found
                    kinds[at] |= 1 << number
        return entry, kinds

    def _compile_header(self) -> tuple[int, Bytes] | None:
        """One table over a payload byte and the length, if they tell all kinds of frame apart (a fast case)."""
        conditions = [[c for c in frame.when if isinstance(c, Byte)] for frame in self._frames]
        if not all(len(c) == 1 and c[0].mask == 0xFF for c in conditions):
            return None
        if len({(c[0].offset) for c in conditions}) > 1 or len({c[0].value for c in conditions}) < len(conditions):
            return None
        if len({tuple(c for c in frame.when if isinstance(c, Identifier)) for frame in self._frames}) > 1:
            return None
        offset = conditions[0][0].offset
        table = np.full((256, 256), _NO_KIND, np.uint8)
        for number, (frame, condition) in enumerate(zip(self._frames, conditions, strict=True)):
            # what lies behind the end of a payload means nothing
            table[condition[0].value, [length for length in frame.length if length > offset]] = number
        return offset, table

    # -- decoding -----------------------------------------------------------------------------------------------

    def _tell_kinds(
        self, key: Indices, entry: Indices, length: Bytes, payload: Bytes, bus: npt.NDArray[np.uint16]
    ) -> Bytes:
        """(n,) kind of each frame; 255 for those of no kind, or of a wrong length (which are counted)."""
        n_buses = len(self.state.bus_counters)
        ours = entry < self._nobody
        if self._header is not None:
            at, table = self._header
            kind = table[payload[:, at], length]
            kind[~ours] = _NO_KIND
        else:
            kind = self._match_kinds(key, payload, length)
        wrong = kind == _NO_KIND
        wrong &= ours
        if wrong.any():
            rows = np.flatnonzero(wrong)
            is_length = ~self._length_ok[self._match_kinds(key[rows], payload[rows], length[rows], False), length[rows]]
            self.state.bus_counters[:, 1] += np.bincount(bus[rows[is_length]], minlength=n_buses)
            self.state.bus_counters[:, 2] += np.bincount(bus[rows[~is_length]], minlength=n_buses)
        return kind

    def _match_kinds(self, key: Indices, payload: Bytes, length: Bytes, check_length: bool = True) -> Bytes:
        """(n,) the last kind whose conditions hold, and (if ``check_length``) whose length is right; 255 for none."""
        kind = np.full(len(key), _NO_KIND, np.uint8)
        possible = self._kinds_of[key]
        for number, frame in enumerate(self._frames):
            match = (possible & (1 << number)) != 0
            for condition in frame.when:
                if isinstance(condition, Byte):
                    match &= payload[:, condition.offset] & condition.mask == condition.value
                    match &= length > condition.offset
            kind[match] = number
        if check_length:
            kind[~self._length_ok[kind, length]] = _NO_KIND
        return kind

    def _pair(
        self, batch: FrameBatch, pairing: Pairing, entry: Indices, is_module: Flags, kind: Bytes
    ) -> list[tuple[Updates, Indices]]:
        """The whole cycles of a batch, and the orphans; what may still become whole is kept for the next batch."""
        wire, time_ns = batch.wire[batch.start : batch.stop], batch.time_ns[batch.start : batch.stop]
        pairs = pairing.find(entry, self._group_of_entry[entry], kind, time_ns, is_module)
        if len(pairs.waiting):
            rows = pairs.waiting + batch.start
            self._carried = batch.wire[rows], batch.time_ns[rows], batch.bus[rows]
        if not len(pairs.rows):
            return []
        module, whole = entry[pairs.rows[:, 0]], pairs.whole
        self._count_patches(1, module[~whole])
        self._count_patches(2, entry[pairs.late])
        for member, number in enumerate(self._members):
            if self._frames[number].stamp is not None:
                rows = pairs.rows[whole, member]
                self._check_sequence(number, wire["payload"][rows], module[whole])
        return [self._read(self._cycle_assembly, batch, pairs.rows, module, whole)]

    def _read(
        self, assembly: Assembly, batch: FrameBatch, rows: Indices, module: Indices, whole: Flags | None = None
    ) -> tuple[Updates, Indices]:
        """Updates, and the last row of each."""
        wire, time_ns = batch.wire[batch.start : batch.stop], batch.time_ns[batch.start : batch.stop]
        values = np.zeros((len(rows), self._width), self.state.values.dtype)
        status = np.zeros((len(rows), self._width), np.uint8)
        if whole is None:
            whole = np.ones(len(rows), bool)
        sensors = assembly.read(wire, rows, module, np.flatnonzero(~whole), values, status)
        self._count_patches(0, module[whole])
        oldest_ns = newest_ns = time_ns[rows[:, 0]]
        last_row = rows[:, 0]
        for member in range(1, rows.shape[1]):
            stamps_ns = time_ns[rows[:, member]]
            oldest_ns, newest_ns = np.minimum(oldest_ns, stamps_ns), np.maximum(newest_ns, stamps_ns)
            last_row = np.maximum(last_row, rows[:, member])
        flagged = bool(status.any())
        return Updates(module, whole, sensors, values, status, oldest_ns, newest_ns, flagged), last_row

    def _count_patches(self, counter: int, module: Indices) -> None:
        patch = self._module_patch[module]
        self.state.patch_counters[:, counter] += np.bincount(patch, minlength=self._n_patches)

    def _check_sequence(self, kind: int, payload: Bytes, module: Indices) -> None:
        stamp = self._frames[kind].stamp
        if stamp is None:
            return
        dtype = np.dtype(stamp.dtype)
        modulo = stamp.modulo or 1 << 8 * dtype.itemsize
        raw = np.ascontiguousarray(payload[:, stamp.offset : stamp.offset + dtype.itemsize]).view(dtype)[:, 0]
        patches = self.tables.structure.module_patch[module].tolist()
        for m, patch, number in zip(module.tolist(), patches, raw.tolist(), strict=True):
            step = (number - int(self._last_sequence[m])) % modulo
            if self._last_sequence[m] >= 0:
                if step == 0:
                    self.state.patch_counters[patch, 4] += 1
                else:
                    self.state.patch_counters[patch, 3] += step - 1
            self._last_sequence[m] = number


def _matching_identifiers(frame: Frame) -> list[int]:
    everything = np.arange(_IDENTIFIERS)
    match = np.ones(_IDENTIFIERS, bool)
    for condition in frame.when:
        if isinstance(condition, Identifier):
            match &= everything & condition.mask == condition.value
    found: list[int] = np.flatnonzero(match).tolist()
    return found
