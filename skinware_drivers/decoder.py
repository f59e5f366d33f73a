"""Frames in, sensor arrays out: a layout compiled to lookup tables, applied to whole batches.

A batch is decoded in two steps. ``decode`` finds out which frames belong together: it looks every identifier up in
one table (bus and identifier together), tells the kinds of frame apart, and pairs the members of a cycle. ``apply``
then scatters the values of complete updates into the arrays of :class:`SkinState`. Between the two, the publisher
may hold back what would overwrite an update that nobody has seen yet.

Nothing on the wire raises here. What cannot be used is counted.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from skinware.realtime import NS_PER_S
from skinware.status import Status
from skinware_drivers.bus import FrameBatch
from skinware_drivers.description import SkinTables
from skinware_drivers.layout import Byte, Expand, Flag, Frame, Identifier, Layout, Packed, Sentinel

_IDENTIFIERS = 1 << 11
_NO_KIND = 255

BUS_COUNTERS = ("unknown", "bad_length", "bad_content")
"""Per bus: identifiers that are none of ours, wrong payload lengths, known identifiers with unknown content."""
PATCH_COUNTERS = ("updates", "orphans", "late", "sequence_lost", "sequence_repeated")
"""Per patch: module updates shown; frames without their partners; of those, partners that came too late; and what
sequence numbers skipped and repeated."""


class SkinState:
    """What is known of the skin right now: private arrays, copied into the ring at publication.

    Attributes:
        values: (n_sensors + 1,) of the structure's dtype; the last one takes what is dropped.
        status: (n_sensors + 1,) uint8, what the wire said of each sensor.
        module_time_ns: (n_modules,) int64, oldest stamp among the frames shown for a module; 0 = never.
        updated: (n_modules,) bool, shown anew since the last publication.
        touched: (n_modules,) bool, heard since then, if only in part.
        patch_time_ns: (n_patches,) int64, newest stamp of a complete update.
        newest_ns: newest stamp of all.
        bus_counters: (n_buses, len(BUS_COUNTERS)) int64.
        patch_counters: (n_patches, len(PATCH_COUNTERS)) int64.
    """

    def __init__(self, tables: SkinTables) -> None:
        structure = tables.structure
        self.values = np.zeros(structure.n_sensors + 1, structure.dtype)
        self.status = np.full(structure.n_sensors + 1, int(Status.NEVER_SEEN), np.uint8)
        self.module_time_ns = np.zeros(structure.n_modules, np.int64)
        self.updated = np.zeros(structure.n_modules, bool)
        self.touched = np.zeros(structure.n_modules, bool)
        self.patch_time_ns = np.zeros(structure.n_patches, np.int64)
        self.newest_ns = 0
        self.bus_counters = np.zeros((len(structure.buses), len(BUS_COUNTERS)), np.int64)
        self.patch_counters = np.zeros((structure.n_patches, len(PATCH_COUNTERS)), np.int64)


@dataclass
class Updates:
    """Complete updates of one batch, in order of arrival per patch.

    Attributes:
        module: (n,) int64.
        rows: (n, members) int64, rows of the batch; one column per member of the cycle.
        kinds: kind of frame of each column.
        oldest_ns: (n,) int64, oldest stamp of each update.
    """

    module: npt.NDArray[np.int64]
    rows: npt.NDArray[np.int64]
    kinds: tuple[int, ...]
    oldest_ns: npt.NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.module)

    def take(self, which: slice | npt.NDArray[Any]) -> Updates:
        """Some of them."""
        return Updates(self.module[which], self.rows[which], self.kinds, self.oldest_ns[which])


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
        self._frames = list(layout.frames)
        names = [frame.name for frame in self._frames]
        self._members = tuple(names.index(name) for name in layout.cycle.members) if layout.cycle else ()
        self._kinds = [_Kind(frame, tables) for frame in self._frames]
        self._entry, self._kinds_of = self._compile_identifiers()
        self._patch_of_entry = np.concatenate(
            [structure.module_patch, np.arange(self._n_patches), [self._n_patches]]
        ).astype(np.uint16)
        self._length_ok = np.zeros((len(self._frames) + 1, 256), bool)  # the last row: right for any frame
        for kind, frame in enumerate(self._frames):
            self._length_ok[[kind, -1], np.array(frame.length)[:, None]] = True
        self._header = self._compile_header()
        self._carried: tuple[npt.NDArray[Any], npt.NDArray[np.int64], npt.NDArray[np.uint16]] | None = None
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

    def decode(self, batch: FrameBatch) -> tuple[list[Updates], npt.NDArray[np.int64]]:
        """Find the complete updates of a batch; count everything else.

        Returns:
            The updates, to be handed to ``apply``; and the rows that belong to no declared frame.
        """
        first, last = batch.start, batch.stop
        wire, bus, time_ns = batch.wire[first:last], batch.bus[first:last], batch.time_ns[first:last]
        payload = wire["payload"]
        identifier = wire["identifier"]
        key = bus.astype(np.int64)
        key *= _IDENTIFIERS
        key += identifier
        if len(identifier) and identifier.max() >= _IDENTIFIERS:
            key[identifier >= _IDENTIFIERS] = len(self._entry) - 1
        entry = self._entry[key]
        kind = self._tell_kinds(key, entry, wire["length"], payload, bus)
        for number, compiled in enumerate(self._kinds):
            if compiled.module_by_byte is not None:
                rows = np.flatnonzero(kind == number)
                entry[rows] = compiled.name_modules(entry[rows], payload[rows])
        foreign = np.flatnonzero(entry >= self._n_modules)
        if len(foreign):
            self._count_foreign(foreign, identifier, bus)
        updates = []
        for number in range(len(self._kinds)):
            if number not in self._members:
                rows = np.flatnonzero((kind == number) & (entry < self._n_modules))
                if len(rows):
                    updates.append(Updates(entry[rows], rows[:, None], (number,), time_ns[rows]))
        if self._members:
            updates.append(self._pair(batch, entry, kind, time_ns))
        for found in updates:
            found.rows += first
        return updates, foreign + first

    def apply(self, batch: FrameBatch, updates: Updates) -> None:
        """Show updates: scatter their values, status and times. Of several for one module, the last one stays."""
        if not len(updates):
            return
        state, module = self.state, updates.module
        channel_to_sensor = self.tables.channel_to_sensor
        status = np.zeros((len(module), channel_to_sensor.shape[1]), np.uint8)
        for column, kind in enumerate(updates.kinds):
            rows = updates.rows[:, column]
            self._kinds[kind].scatter(
                batch.wire["payload"][rows], batch.wire["length"][rows], module, channel_to_sensor, state.values, status
            )
            self._check_sequence(kind, batch.wire["payload"][rows], module)
        state.status[channel_to_sensor[module]] = status
        state.module_time_ns[module] = updates.oldest_ns
        state.updated[module] = True
        state.touched[module] = True
        patch = self.tables.structure.module_patch[module]
        newest = batch.time_ns[updates.rows].max(axis=1)
        np.maximum.at(state.patch_time_ns, patch, newest)
        state.newest_ns = max(state.newest_ns, int(newest.max()))
        state.patch_counters[:, 0] += np.bincount(patch, minlength=self._n_patches)

    # -- compiling ----------------------------------------------------------------------------------------------

    def _compile_identifiers(self) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.uint16]]:
        """Tables over bus * 2048 + identifier: what it names, and which kinds of frame it can be.

        Entries 0 to n_modules - 1 are modules, then n_patches entries for "some module of this patch", then one
        for "none of ours".
        """
        n_buses = len(self.tables.structure.buses)
        nothing = self._n_modules + self._n_patches
        entry = np.full(n_buses * _IDENTIFIERS + 1, nothing, np.int64)
        kinds = np.zeros(n_buses * _IDENTIFIERS + 1, np.uint16)
        for bus in range(n_buses):
            for number, frame in enumerate(self._frames):
                for identifier in _matching_identifiers(frame):
                    patch_key = _bits(identifier, frame.patch)
                    patch = self.tables.patch_key.get((bus, patch_key))
                    if patch is None:
                        continue
                    at = bus * _IDENTIFIERS + identifier
                    found = self._n_modules + patch
                    if frame.module is None or frame.module.byte is None:
                        found = self.tables.module_key.get((patch, _bits(identifier, frame.module)), found)
                    entry[at] = found
                    kinds[at] |= 1 << number
        return entry, kinds

    def _compile_header(self) -> tuple[int, npt.NDArray[np.uint8]] | None:
        """One table over one payload byte, if that byte alone tells all kinds of frame apart (a fast case)."""
        conditions = [[c for c in frame.when if isinstance(c, Byte)] for frame in self._frames]
        if not all(len(c) == 1 and c[0].mask == 0xFF for c in conditions):
            return None
        if len({(c[0].offset) for c in conditions}) > 1 or len({c[0].value for c in conditions}) < len(conditions):
            return None
        if len({tuple(c for c in frame.when if isinstance(c, Identifier)) for frame in self._frames}) > 1:
            return None
        table = np.full(256, _NO_KIND, np.uint8)
        for number, condition in enumerate(conditions):
            table[condition[0].value] = number
        return conditions[0][0].offset, table

    # -- decoding -----------------------------------------------------------------------------------------------

    def _tell_kinds(
        self,
        key: npt.NDArray[np.int64],
        entry: npt.NDArray[np.int64],
        length: npt.NDArray[np.uint8],
        payload: npt.NDArray[np.uint8],
        bus: npt.NDArray[np.uint16],
    ) -> npt.NDArray[np.uint8]:
        """(n,) kind of each frame; 255 for those of no kind, or of a wrong length (which are counted)."""
        n_buses = len(self.state.bus_counters)
        ours = entry < self._n_modules + self._n_patches
        if self._header is not None:
            at, table = self._header
            kind = table[payload[:, at]]
            kind[length <= at] = _NO_KIND  # what lies behind the end of a payload means nothing
            kind[~ours] = _NO_KIND
        else:
            kind = np.full(len(entry), _NO_KIND, np.uint8)
            possible = self._kinds_of[key]
            for number, frame in enumerate(self._frames):
                match = (possible & (1 << number)) != 0
                for condition in frame.when:
                    if isinstance(condition, Byte):
                        match &= payload[:, condition.offset] & condition.mask == condition.value
                        match &= length > condition.offset
                kind[match] = number
        known = kind != _NO_KIND
        length_ok = self._length_ok[np.where(known, kind, len(self._frames)), length]
        kind[~length_ok] = _NO_KIND
        wrong = ours & ((kind == _NO_KIND) | ~known)
        if wrong.any():
            rows = np.flatnonzero(wrong)
            bad_length = bus[rows[~length_ok[rows]]]
            self.state.bus_counters[:, 1] += np.bincount(bad_length, minlength=n_buses)
            self.state.bus_counters[:, 2] += np.bincount(bus[rows[length_ok[rows]]], minlength=n_buses)
        return kind

    def _count_foreign(
        self, rows: npt.NDArray[np.int64], identifier: npt.NDArray[np.uint32], bus: npt.NDArray[np.uint16]
    ) -> None:
        self.state.bus_counters[:, 0] += np.bincount(bus[rows], minlength=len(self.state.bus_counters))
        standard = rows[identifier[rows] < _IDENTIFIERS]
        np.add.at(self.unknown_identifiers, (bus[standard], identifier[standard]), 1)

    def _pair(
        self,
        batch: FrameBatch,
        entry: npt.NDArray[np.int64],
        kind: npt.NDArray[np.uint8],
        time_ns: npt.NDArray[np.int64],
    ) -> Updates:
        """Find the members of cycles that follow each other without a gap, and keep those that still may."""
        cycle = self.layout.cycle
        if cycle is None:
            raise ValueError("this layout has no cycle")
        members = self._members
        n = len(members)
        position = np.full(256, n, np.uint8)  # kind -> place in the cycle; n = not a member
        position[list(members)] = np.arange(n)
        place = position[kind]
        place[entry >= self._n_modules] = n
        patch = self._patch_of_entry[entry]
        group = patch if cycle.within == "patch" else np.minimum(entry, 0xFFFF).astype(np.uint16)
        order = np.argsort(group, kind="stable")
        sorted_entry, sorted_place, sorted_time = entry[order], place[order], time_ns[order]
        starts = self._find_cycles(sorted_entry, sorted_place, cycle.order)
        maximum_age_ns = round(cycle.maximum_age_s * NS_PER_S)
        in_time = sorted_time[starts + n - 1] - sorted_time[starts] <= maximum_age_ns
        late = starts[~in_time]
        starts = starts[in_time]
        windows = starts[:, None] + np.arange(n)
        used = np.zeros(len(order), bool)
        used[windows] = True
        carried = self._still_hoping(sorted_entry, sorted_place, group[order], used)
        orphan = (sorted_place < n) & ~used
        orphan[carried] = False
        if orphan.any():
            self._count_orphans(sorted_entry[orphan], sorted_entry[late])
        self._carry(batch, order[carried])
        rows = order[windows]
        rows = np.take_along_axis(rows, np.argsort(sorted_place[windows], axis=1), axis=1)
        return Updates(sorted_entry[starts], rows, members, time_ns[rows].min(axis=1) if len(rows) else starts)

    def _find_cycles(
        self, entry: npt.NDArray[np.int64], place: npt.NDArray[np.uint8], order: str
    ) -> npt.NDArray[np.int64]:
        """First rows of runs of n frames of one module that are a whole cycle; runs do not overlap."""
        n = len(self._members)
        m = max(0, len(entry) - n + 1)
        whole = np.ones(m, bool)
        seen = np.zeros(m, np.uint32)
        for j in range(n):
            whole &= entry[j : m + j] == entry[:m]
            if order == "given":
                whole &= place[j : m + j] == j
            else:
                seen |= np.left_shift(np.uint32(1), place[j : m + j].astype(np.uint32))
        if order != "given":
            whole &= seen == (1 << n) - 1
        if order == "ends_with":
            whole &= place[n - 1 : m + n - 1] == n - 1
        starts = np.flatnonzero(whole)
        if order == "any" and len(starts) > 1 and np.diff(starts).min() < n:
            chosen: list[int] = []
            for start in starts.tolist():
                if not chosen or start >= chosen[-1] + n:
                    chosen.append(start)
            starts = np.array(chosen, np.int64)
        return starts

    def _still_hoping(
        self,
        entry: npt.NDArray[np.int64],
        place: npt.NDArray[np.uint8],
        group: npt.NDArray[np.uint16],
        used: npt.NDArray[np.bool_],
    ) -> npt.NDArray[np.int64]:
        """Rows at the end of each group that may become a cycle with what comes next."""
        n = len(self._members)
        if not len(entry):
            return np.zeros(0, np.int64)
        ends = np.append(np.flatnonzero(group[1:] != group[:-1]), len(group) - 1)
        ends = ends[(place[ends] < n) & ~used[ends]]
        keep = np.zeros(len(entry), bool)
        ordered = self.layout.cycle is not None and self.layout.cycle.order == "given"
        for length in range(n - 1, 0, -1):
            first = ends - length + 1
            fits = first >= 0
            seen = np.zeros(len(ends), np.uint32)
            for j in range(length):
                at = np.maximum(first + j, 0)
                fits &= (entry[at] == entry[ends]) & ~used[at] & (place[at] < n)
                if ordered:
                    fits &= place[at] == j
                bit = np.left_shift(np.uint32(1), place[at].astype(np.uint32))
                fits &= (seen & bit) == 0
                seen |= bit
            for start in first[fits].tolist():
                keep[start : start + length] = True
            ends = ends[~fits]
        return np.flatnonzero(keep)

    def _carry(self, batch: FrameBatch, rows: npt.NDArray[np.int64]) -> None:
        if len(rows):
            rows = np.sort(rows) + batch.start
            self._carried = batch.wire[rows], batch.time_ns[rows], batch.bus[rows]

    def _count_orphans(self, orphans: npt.NDArray[np.int64], late: npt.NDArray[np.int64]) -> None:
        module_patch = self.tables.structure.module_patch
        self.state.touched[orphans] = True
        self.state.patch_counters[:, 1] += np.bincount(module_patch[orphans], minlength=self._n_patches)
        if len(late):
            self.state.patch_counters[:, 2] += np.bincount(module_patch[late], minlength=self._n_patches)

    def _check_sequence(self, kind: int, payload: npt.NDArray[np.uint8], module: npt.NDArray[np.int64]) -> None:
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


class _Kind:
    """One compiled kind of frame: from payloads to sensors."""

    def __init__(self, frame: Frame, tables: SkinTables) -> None:
        self._frame = frame
        self._sink = tables.structure.n_sensors
        self._n_modules = tables.structure.n_modules
        self.module_by_byte: npt.NDArray[np.int64] | None = None
        if frame.module is not None and frame.module.byte is not None:
            n_patches = tables.structure.n_patches
            self.module_by_byte = np.full((n_patches, 1 << frame.module.width), -1, np.int64)
            for (patch, key), module in tables.module_key.items():
                if key < self.module_by_byte.shape[1]:
                    self.module_by_byte[patch, key] = module
        if not isinstance(frame.values, Expand):
            channels = np.array([-1 if c is None else c for c in frame.values.channels], np.int64)
            width = tables.channel_to_sensor.shape[1]
            table = np.append(tables.channel_to_sensor, np.full((self._n_modules, 1), self._sink), axis=1)
            self._channels = np.where((channels < 0) | (channels >= width), width, channels)
            self._destination = table[:, self._channels]

    def name_modules(self, entry: npt.NDArray[np.int64], payload: npt.NDArray[np.uint8]) -> npt.NDArray[np.int64]:
        """(n,) entries in which "some module of this patch" became the module that the payload names."""
        bits = self._frame.module
        if self.module_by_byte is None or bits is None or bits.byte is None:
            return entry
        key = payload[:, bits.byte] >> bits.shift & ((1 << bits.width) - 1)
        found = self.module_by_byte[entry - self._n_modules, key]
        return np.where(found >= 0, found, entry)

    def scatter(
        self,
        payload: npt.NDArray[np.uint8],
        length: npt.NDArray[np.uint8],
        module: npt.NDArray[np.int64],
        channel_to_sensor: npt.NDArray[np.int64],
        values: npt.NDArray[Any],
        status: npt.NDArray[np.uint8],
    ) -> None:
        """Write the values of n frames into ``values`` and their flags into ``status`` (n, n_channels)."""
        layout = self._frame.values
        if isinstance(layout, Expand):
            row, channel, raw = layout.function(payload, length)
            inside = (channel >= 0) & (channel < channel_to_sensor.shape[1])
            row, channel, raw = row[inside], channel[inside], raw[inside]
            values[channel_to_sensor[module[row], channel]] = raw
        else:
            if isinstance(layout.dtype, Packed):
                raw = _unpack(payload[:, layout.offset : layout.end], layout.count, layout.dtype)
            else:
                raw = np.ascontiguousarray(payload[:, layout.offset : layout.end]).view(layout.dtype)
            values[self._destination[module]] = raw
        for flag in self._frame.flags:
            if isinstance(flag, Sentinel):
                self._flag_sentinels(flag, raw, status)
            else:
                _flag_bits(flag, payload, length, status)

    def _flag_sentinels(self, flag: Sentinel, raw: npt.NDArray[Any], status: npt.NDArray[np.uint8]) -> None:
        hit = np.isnan(raw) if flag.value != flag.value else raw == flag.value
        for column, channel in enumerate(self._channels.tolist()):
            if channel < status.shape[1]:
                status[:, channel] |= np.where(hit[:, column], np.uint8(flag.status), np.uint8(0))


def _flag_bits(
    flag: Flag, payload: npt.NDArray[np.uint8], length: npt.NDArray[np.uint8], status: npt.NDArray[np.uint8]
) -> None:
    dtype = np.dtype(flag.dtype)
    end = flag.offset + dtype.itemsize
    word = np.ascontiguousarray(payload[:, flag.offset : end]).view(dtype)[:, 0].astype(np.uint32)
    word[length < end] = 0
    if not word.any():
        return
    bit = np.uint8(flag.status)
    if flag.mask:
        status[(word & flag.mask) != 0] |= bit
    for channel, shift in flag.each:
        status[(word >> shift & 1) != 0, channel] |= bit


def _unpack(data: npt.NDArray[np.uint8], count: int, packed: Packed) -> npt.NDArray[np.int64]:
    bits = np.unpackbits(np.ascontiguousarray(data), axis=1, bitorder=packed.order)[:, : count * packed.bits]
    weights = 1 << np.arange(packed.bits, dtype=np.int64)
    if packed.order == "big":
        weights = weights[::-1]
    values: npt.NDArray[np.int64] = bits.reshape(len(data), count, packed.bits).astype(np.int64) @ weights
    if packed.signed:
        values -= (values >> (packed.bits - 1) & 1) << packed.bits
    return values


def _matching_identifiers(frame: Frame) -> list[int]:
    everything = np.arange(_IDENTIFIERS)
    match = np.ones(_IDENTIFIERS, bool)
    for condition in frame.when:
        if isinstance(condition, Identifier):
            match &= everything & condition.mask == condition.value
    found: list[int] = np.flatnonzero(match).tolist()
    return found


def _bits(identifier: int, bits: Any) -> int:
    return 0 if bits is None else identifier >> bits.shift & ((1 << bits.width) - 1)
