"""From payloads to values and flags, in numpy: what ``reading.c`` is compared with."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from skinware_drivers.decoding.compiled import Assembly, FrameKind
from skinware_drivers.fields import Above, Flag, Packed, Sentinel, StatusBytes
from skinware_drivers.layout import Expand, Values

Bytes = npt.NDArray[np.uint8]
Indices = npt.NDArray[np.int64]
Words = npt.NDArray[np.uint64]


def read_updates(
    assembly: Assembly,
    n_sensors: int,
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
    sensors = assembly.destination[module]
    unreadable = orphans[:0]
    for member, (kind, columns) in enumerate(zip(assembly.kinds, assembly.columns, strict=True)):
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
            sensors[:, columns][missing] = n_sensors
            unreadable = np.append(unreadable, complete[failed])
            values[:, columns] = raw
        else:
            runs = [payload[:, :0], *(_read_run(run, payload) for run in kind.frame.runs)]
            with np.errstate(invalid="ignore"):  # a signaling NaN
                raw = np.concatenate(runs, axis=1)
            values[:, columns] = np.concatenate(runs, axis=1, dtype=values.dtype, casting="unsafe")
        _flag(kind, payload, length, raw, status, columns, assembly.channels)
    nowhere = np.append(orphans, unreadable) if len(unreadable) else orphans
    sensors[nowhere] = n_sensors
    status[nowhere] = 0
    return sensors, unreadable


def name_modules(kind: FrameKind, entry: Indices, payload: Bytes, n_modules: int) -> Indices:
    """Return (n,) entries in which "some module of this patch" is replaced by the module that the payload names."""
    bits = kind.frame.module_byte
    if kind.module_by_byte is None or bits is None or bits.byte is None:
        return entry
    key = payload[:, bits.byte] >> bits.shift & ((1 << bits.width) - 1)
    found = kind.module_by_byte[entry - n_modules, key]
    return np.where(found >= 0, found, entry)


def _flag(
    kind: FrameKind,
    payload: Bytes,
    length: Bytes,
    raw: npt.NDArray[Any],
    status: Bytes,
    columns: slice,
    channels: Indices,
) -> None:
    """Set the status bits of n frames.

    Args:
        payload: (n, size) uint8.
        length: (n,) uint8.
        raw: (n, width) values, in a dtype that holds those of all runs.
        status: (n, all) uint8, of all values of the update.
        columns: where this frame's values are among them.
        channels: (all,) channel of each of them.
    """
    words: dict[tuple[int, str, int], tuple[Indices, Words]] = {}  # several flags share one
    for flag in kind.frame.flags:
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
