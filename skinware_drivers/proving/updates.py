"""Compare two decodings of one wire, update by update, and find the first difference.

Updates with the same time are compared, or else the updates one by one from the last one backwards: times by the clock
of a device are estimated, at first not very well, and another decoder may begin to estimate at another update.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
import numpy.typing as npt

from skinware.errors import BadRecording
from skinware.realtime import NS_PER_S
from skinware.structure import Structure

Times = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class ModuleUpdates:
    """The updates of one module, in order.

    Attributes:
        time_ns: (k,) int64, since the recording began.
        values: (k, n) raw.
    """

    sensors: tuple[str, ...]
    time_ns: Times
    values: npt.NDArray[Any]

    def __len__(self) -> int:
        return len(self.time_ns)


Decoding = Mapping[tuple[int, ...], ModuleUpdates]
"""The updates of each module, by the uids of its sensors."""


@dataclass(frozen=True)
class Difference:
    """A raw value that differs between two decodings; None: there is no such update."""

    time_s: float
    sensor: str
    then: float | None
    now: float | None

    def __str__(self) -> str:
        then, now = ("no update" if value is None else f"{value:g}" for value in (self.then, self.now))
        return f"at {self.time_s:.4f} s, {self.sensor}: {then} then, {now} now"


@dataclass(frozen=True)
class Comparison:
    """Two decodings of one wire.

    Attributes:
        then, now: number of updates of each decoding.
        difference: the first by time; None: they are equal.
    """

    compared: int
    then: int
    now: int
    difference: Difference | None


class Collected:
    """Collect updates from snapshots of a recording that began at ``began_ns``."""

    def __init__(self, began_ns: int = 0) -> None:
        self._began_ns = began_ns
        self._parts: dict[tuple[int, ...], list[ModuleUpdates]] = {}

    def add(self, structure: Structure, values: npt.NDArray[Any], module_time_ns: Times) -> None:
        """Add snapshots of one structure, in order.

        Args:
            values: (frames, sensors) raw.
            module_time_ns: (frames, modules) int64; 0: never seen.
        """
        for module in range(structure.n_modules):
            mine = np.flatnonzero(structure.sensor_module == module)
            time_ns = module_time_ns[:, module]
            rows = np.flatnonzero((time_ns != 0) & np.r_[True, np.diff(time_ns) != 0])
            if len(mine) and len(rows):
                names = tuple(structure.sensor_name(int(position)) for position in mine)
                found = ModuleUpdates(names, time_ns[rows] - self._began_ns, values[np.ix_(rows, mine)])
                self._parts.setdefault(tuple(structure.sensor_uid[mine].tolist()), []).append(found)

    def decoding(self) -> Decoding:
        found: dict[tuple[int, ...], ModuleUpdates] = {}
        for uids, parts in self._parts.items():
            time_ns, first = np.unique(np.concatenate([part.time_ns for part in parts]), return_index=True)
            values = np.concatenate([part.values for part in parts])
            found[uids] = ModuleUpdates(parts[-1].sensors, time_ns, values[first])
        return found


def compare(then: Decoding, now: Decoding) -> Comparison:
    """Compare two decodings of one wire.

    The beginnings may differ, because a driver shows nothing until it knows its devices. So each module is compared
    from its first common update to its last. In between, each recorded update must exist now with the same values. More
    updates now are no difference: a machine may have been too busy to show all.
    """
    pairs: list[tuple[int, Difference | None]] = []  # number of compared updates and first difference of each module
    for uids, old in then.items():
        new = now.get(uids)
        pairs.append((0, _without_partner(old, 0, is_then=True)) if new is None else _of_module(old, new))
    pairs += [(0, _without_partner(new, 0, is_then=False)) for uids, new in now.items() if uids not in then]
    differences = sorted((found for _, found in pairs if found is not None), key=lambda one: one.time_s)
    return Comparison(
        sum(compared for compared, _ in pairs),
        sum(map(len, then.values())),
        sum(map(len, now.values())),
        differences[0] if differences else None,
    )


def _of_module(old: ModuleUpdates, new: ModuleUpdates) -> tuple[int, Difference | None]:
    if old.values.shape[1:] != new.values.shape[1:]:
        return 0, _without_partner(old, 0, is_then=True)
    common = min(len(old), len(new))
    if not _differ(old.values[-common:], new.values[-common:]).any():
        return common, None
    # the decoded update nearest to each recorded one, if the two are nearest to each other
    nearest, back = _nearest(old.time_ns, new.time_ns), _nearest(new.time_ns, old.time_ns)
    apart_ns = np.abs(new.time_ns[nearest] - old.time_ns)
    usual_ns = float(np.median(np.diff(old.time_ns))) if len(old) > 1 else np.inf
    is_paired = (back[nearest] == np.arange(len(old))) & (apart_ns < usual_ns / 2)
    rows = np.flatnonzero(is_paired)
    if not len(rows):
        return 0, _without_partner(old, 0, is_then=True)
    within = np.arange(rows[0], rows[-1] + 1)
    one, other = old.values[within], new.values[nearest[within]]
    differs = _differ(one, other)
    wrong = np.flatnonzero(~is_paired[within] | differs.any(axis=1))
    if not len(wrong):
        return len(rows), None
    first = int(wrong[0])
    if not is_paired[within[first]]:
        return len(rows), _without_partner(old, int(within[first]), is_then=True)
    sensor = int(np.flatnonzero(differs[first])[0])
    time_s = float(old.time_ns[within[first]]) / NS_PER_S
    found = Difference(time_s, old.sensors[sensor], float(one[first, sensor]), float(other[first, sensor]))
    return len(rows), found


def _differ(one: npt.NDArray[Any], other: npt.NDArray[Any]) -> Flags:
    """Return which values differ; NaN is equal to NaN."""
    found: Flags = (one != other) & ~((one != one) & (other != other))
    return found


def _nearest(of_ns: Times, in_ns: Times) -> Times:
    after = np.clip(np.searchsorted(in_ns, of_ns), 1, max(1, len(in_ns) - 1))
    if len(in_ns) == 1:
        return np.zeros(len(of_ns), np.int64)
    is_before = of_ns - in_ns[after - 1] <= in_ns[after] - of_ns
    found: Times = after - is_before
    return found


def _without_partner(of: ModuleUpdates, row: int, *, is_then: bool) -> Difference:
    value = float(of.values[row, 0])
    then, now = (value, None) if is_then else (None, value)
    return Difference(float(of.time_ns[row]) / NS_PER_S, of.sensors[0], then, now)


def save(decoding: Decoding, path: Path) -> None:
    arrays: dict[str, Any] = {}
    for number, (uids, of) in enumerate(decoding.items()):
        arrays |= {
            f"{number}.uids": np.array(uids, np.uint64),
            f"{number}.sensors": np.array(of.sensors),
            f"{number}.time_ns": of.time_ns,
            f"{number}.values": of.values,
        }
    np.savez_compressed(path, **arrays)


def load(path: Path) -> Decoding:
    """Read a file of :func:`save`; raise ``BadRecording`` if it is not one."""
    try:
        with path.open("rb") as raw, np.load(raw, allow_pickle=False) as file:
            found: dict[tuple[int, ...], ModuleUpdates] = {}
            for number in sorted({int(name.partition(".")[0]) for name in file.files}):
                uids, sensors = file[f"{number}.uids"], tuple(file[f"{number}.sensors"].tolist())
                updates = ModuleUpdates(sensors, file[f"{number}.time_ns"], file[f"{number}.values"])
                found[tuple(uids.tolist())] = updates
            return found
    except (ValueError, KeyError, EOFError, BadZipFile) as error:
        raise BadRecording(f"{path}: not a file of skin-prove --save ({error})") from None
