"""Read values and flags from the payloads of one kind of frame, for whole batches."""

from __future__ import annotations

import logging
import traceback
from typing import Any

import numpy as np
import numpy.typing as npt

from skinware_drivers.description import SkinTables
from skinware_drivers.layout import Above, Expand, Flag, Frame, Packed, Sentinel, StatusBytes, Values

log: logging.Logger = logging.getLogger("skinware.driver.expand")

Bytes = npt.NDArray[np.uint8]
Indices = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]
Words = npt.NDArray[np.uint64]


class FrameKind:
    """One kind of frame, compiled.

    Attributes:
        channels: (width,) int64, channel of each value; -1 = dropped.
        carries: the channels for which its frames can have values.
        module_by_byte: (n_patches, keys) module that a payload byte names; None: the identifier names it.
    """

    def __init__(self, frame: Frame, tables: SkinTables) -> None:
        self.frame = frame
        self._is_logged = False
        self._dtype = tables.structure.dtype
        n_channels = tables.channel_to_sensor.shape[1]
        self._n_modules = tables.structure.n_modules
        self.module_by_byte: Indices | None = None
        if frame.module_byte is not None:
            self.module_by_byte = np.full((tables.structure.n_patches, 1 << frame.module_byte.width), -1, np.int64)
            for (patch, key), module in tables.module_key.items():
                if key < self.module_by_byte.shape[1]:
                    self.module_by_byte[patch, key] = module
        self.channels: Indices
        if isinstance(frame.values, Expand):
            self.channels = np.arange(n_channels)
        else:
            channels = [channel for run in frame.runs for channel in run.channels]
            self.channels = np.array([-1 if c is None else c for c in channels], np.int64)
            self.channels[self.channels >= n_channels] = -1
        to = frame.values.to if isinstance(frame.values, Expand) else None
        self.carries: frozenset[int] = frozenset(self.channels[self.channels >= 0].tolist() if to is None else to)

    def name_modules(self, entry: Indices, payload: Bytes) -> Indices:
        """Return (n,) entries in which "some module of this patch" is replaced by the module that the payload names."""
        bits = self.frame.module_byte
        if self.module_by_byte is None or bits is None or bits.byte is None:
            return entry
        key = payload[:, bits.byte] >> bits.shift & ((1 << bits.width) - 1)
        found = self.module_by_byte[entry - self._n_modules, key]
        return np.where(found >= 0, found, entry)

    def read(self, payload: Bytes) -> npt.NDArray[Any]:
        """Return (n, width) values of n frames, in the frame's own dtype.

        Args:
            payload: (n, size) uint8.
        """
        runs = [_read_run(run, payload) for run in self.frame.runs]
        return runs[0] if len(runs) == 1 else np.concatenate(runs, axis=1)

    def expand(self, expand: Expand, payload: Bytes, length: Bytes) -> tuple[npt.NDArray[Any], Flags, Indices]:
        """Return the values of n frames that a function of the driver's author reads.

        Args:
            expand: the frame's.
            payload: (n, size) uint8.
            length: (n,) uint8.

        Returns:
            (n, width) values; (n, width) bool, which of them the frames have; and the frames for which it raised.
        """
        values = np.zeros((len(payload), len(self.channels)), self._dtype)
        found, failed = np.zeros(values.shape, bool), []
        if not len(payload):
            return values, found, np.zeros(0, np.int64)
        try:
            values, found = self._expand(expand, payload, length)
        except (Exception, SystemExit) as error:  # noqa: BLE001 - it costs only the frame
            if not self._is_logged:
                self._is_logged = True
                log.error(
                    "frame %r: its Expand function raised %s: %s (%s:%d); frames for which it does are not shown, and"
                    " counted as bad content; logged once",
                    self.frame.name,
                    type(error).__name__,
                    str(error),  # so that a kept record refers to no frame of the traceback
                    *traceback.extract_tb(error.__traceback__)[-1][:2],
                )
        else:
            return values, found, np.zeros(0, np.int64)
        # the other frames are read one by one
        for row in range(len(payload)):
            one = slice(row, row + 1)
            try:
                values[one], found[one] = self._expand(expand, payload[one], length[one])
            except (Exception, SystemExit):  # noqa: BLE001
                failed.append(row)
        return values, found, np.array(failed, np.int64)

    def _expand(self, expand: Expand, payload: Bytes, length: Bytes) -> tuple[npt.NDArray[Any], Flags]:
        row, channel, value = expand.function(payload, length)
        if not len(row) == len(channel) == len(value) or value.dtype.kind not in "biuf":
            raise ValueError(f"it returned {len(row)} rows, {len(channel)} channels, {len(value)} {value.dtype} values")
        inside = (channel >= 0) & (channel < len(self.channels))
        row, channel, value = row[inside], channel[inside], value[inside]
        with np.errstate(invalid="ignore"):
            held = value.astype(self._dtype)
        if self._dtype.kind in "iu" and (held != value).any():
            raise ValueError(f"it returned {value[held != value][0]}: the driver's dtype {self._dtype} cannot hold it")
        values = np.zeros((len(payload), len(self.channels)), self._dtype)
        values[row, channel] = held
        found = np.zeros(values.shape, bool)
        found[row, channel] = True
        return values, found

    def flag(
        self, payload: Bytes, length: Bytes, raw: npt.NDArray[Any], status: Bytes, columns: slice, channels: Indices
    ) -> None:
        """Set the status bits of n frames.

        Args:
            payload: (n, size) uint8.
            length: (n,) uint8.
            raw: (n, width) what ``read`` returned.
            status: (n, all) uint8, of all values of the update.
            columns: where this frame's values are among them.
            channels: (all,) channel of each of them.
        """
        words: dict[tuple[int, str, int], tuple[Indices, Words]] = {}  # several flags share one
        for flag in self.frame.flags:
            if isinstance(flag, Above):
                status[:, columns] |= np.where(raw > flag.limit, np.uint8(flag.status), np.uint8(0))
                continue
            if isinstance(flag, Sentinel):
                is_none = np.isnan(raw) if flag.value != flag.value else raw == flag.value
                status[:, columns] |= np.where(is_none, np.uint8(flag.status), np.uint8(0))
                continue
            if isinstance(flag, StatusBytes):
                end = flag.offset + raw.shape[1]
                rows = np.flatnonzero(length >= end)
                if len(rows):  # else it may lie behind all payloads
                    status[rows, columns] |= payload[rows, flag.offset : end] & np.uint8(flag.mask)
                continue
            place = flag.offset, np.dtype(flag.dtype).str, flag.normal
            if place not in words:
                words[place] = _flag_words(flag, payload, length)
            flagged, word = words[place]
            if len(flagged):
                _flag_bits(flag, flagged, word, status, channels)


def _read_run(run: Values, payload: Bytes) -> npt.NDArray[Any]:
    data = payload[:, run.offset : run.end]
    if isinstance(run.dtype, Packed):
        return _unpack(data, run.count, run.dtype)
    dtype = np.dtype(run.dtype)
    return data if dtype == np.uint8 else np.ascontiguousarray(data).view(dtype)


def _flag_words(flag: Flag, payload: Bytes, length: Bytes) -> tuple[Indices, Words]:
    """Return the frames in which a flag's word is present and not normal (usually few), and the bits that differ."""
    dtype = np.dtype(flag.dtype)
    end = flag.offset + dtype.itemsize
    if end > payload.shape[1]:
        return np.zeros(0, np.int64), np.zeros(0, np.uint64)
    word = np.ascontiguousarray(payload[:, flag.offset : end]).view(dtype)[:, 0] ^ dtype.type(flag.normal)
    flagged = np.flatnonzero(word)
    if len(flagged):
        flagged = flagged[length[flagged] >= end]
    return flagged, word[flagged].astype(np.uint64)


def _flag_bits(flag: Flag, flagged: Indices, word: Words, status: Bytes, channels: Indices) -> None:
    bit = np.uint8(flag.status)
    if flag.mask:
        status[flagged[(word & np.uint64(flag.mask)) != 0]] |= bit
    for channel, shift in flag.each:
        rows = flagged[np.flatnonzero(word & np.uint64(1 << shift))]
        if len(rows):
            status[np.ix_(rows, np.flatnonzero(channels == channel))] |= bit


def _unpack(data: Bytes, count: int, packed: Packed) -> Indices:
    end = packed.skip + count * packed.bits
    bits = np.unpackbits(np.ascontiguousarray(data), axis=1, bitorder=packed.order)[:, packed.skip : end]
    weights = 1 << np.arange(packed.bits, dtype=np.int64)
    if packed.order == "big":
        weights = weights[::-1]
    values: Indices = bits.reshape(len(data), count, packed.bits).astype(np.int64) @ weights
    if packed.signed:
        values -= (values >> (packed.bits - 1) & 1) << packed.bits
    return values


class Assembly:
    """The frames that together make one update of a module, and the sensors of their values.

    Args:
        kinds: the frames, in the order of the cycle.
        width: values of every update, whatever it is made of; at least the sum over ``kinds``.
        groups: (n_modules + 1, most) update groups that an update of each module belongs to.
    """

    def __init__(self, kinds: list[FrameKind], tables: SkinTables, width: int, groups: Indices) -> None:
        self.groups = groups
        self._kinds = kinds
        self._sink = tables.structure.n_sensors
        self.channels = np.full(width, -1, np.int64)
        self.columns: list[slice] = []
        end = 0
        for kind in kinds:
            columns = slice(end, end + len(kind.channels))
            self.columns.append(columns)
            self.channels[columns] = kind.channels
            end = columns.stop
        # one column more for what is dropped, one row more for updates that are not shown
        table = np.full((len(tables.channel_to_sensor) + 1, tables.channel_to_sensor.shape[1] + 1), self._sink)
        table[:-1, :-1] = tables.channel_to_sensor
        self.destination = np.ascontiguousarray(table[:, self.channels])

    def read(
        self,
        wire: npt.NDArray[Any],
        rows: Indices,
        module: Indices,
        orphans: Indices,
        values: npt.NDArray[Any],
        status: Bytes,
    ) -> tuple[Indices, Indices]:
        """Read the values and flags of n updates.

        Args:
            rows: (n, members) rows of it.
            module: (n,) module of each.
            orphans: those of the n that are not whole: their values have no sensor and no flag.
            values: (n, width), filled in.
            status: (n, width) uint8, all zero; flags are set in it.

        Returns:
            (n, width) int64: the sensor of each value; and for each frame that cannot be read, its update.
        """
        sensors = self.destination[module]
        unreadable = orphans[:0]
        for member, (kind, columns) in enumerate(zip(self._kinds, self.columns, strict=True)):
            taken = wire[rows[:, member]]
            payload, length = taken["payload"], taken["length"]
            payload[orphans] = 0
            if isinstance(kind.frame.values, Expand):
                complete = np.delete(np.arange(len(rows)), orphans)
                expanded, found, failed = kind.expand(kind.frame.values, payload[complete], length[complete])
                raw = np.zeros((len(rows), len(kind.channels)), expanded.dtype)
                raw[complete] = expanded
                missing = np.ones(raw.shape, bool)
                missing[complete] = ~found
                sensors[:, columns][missing] = self._sink
                unreadable = np.append(unreadable, complete[failed])
            else:
                raw = kind.read(payload)
            values[:, columns] = raw
            kind.flag(payload, length, raw, status, columns, self.channels)
        nowhere = np.append(orphans, unreadable) if len(unreadable) else orphans
        sensors[nowhere] = self._sink
        status[nowhere] = 0
        return sensors, unreadable
