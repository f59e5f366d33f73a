"""Turn values into what is drawn: quantities, levels, scales, values at rest, and the last seconds."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from skinware._columns import Index
from skinware.geometry import Geometry
from skinware.realtime import NS_PER_S
from skinware.sensor_types import PRESSURE, SHEAR_X, SHEAR_Y, SensorType
from skinware.status import Status
from skinware.structure import Structure
from skinware.tactile.neighbours import pitch_m


@dataclass(frozen=True, eq=False)
class Quantity:
    """A picture of a skin: n taxels, each with a value, and with a vector where sensors of three axes lie together.

    Attributes:
        name: for people: ``pressure``; ``force`` of ``force_x``, ``force_y`` and ``force_z``.
        type: of the value: of three axes the one along the normal.
        index: (n,) int64, positions in a frame of the n sensors that tell the values.
        where: the same, as a slice where it is one.
        geometry: places of the n taxels.
        axes: names of the types of the two axes within the skin; none where the skin has no such sensors.
        shear: (n, 2) int64, positions of the sensors of these axes, -1 where there is none.
    """

    name: str
    type: SensorType
    index: npt.NDArray[np.int64]
    where: Index
    geometry: Geometry
    axes: tuple[str, ...]
    shear: npt.NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.index)

    @cached_property
    def pitch_m(self) -> float:
        """From a taxel to the nearest other, usually, m; NaN where places are not known."""
        pitch = pitch_m(self.geometry)
        pitch = pitch[pitch > 0]
        return float(np.median(pitch)) if len(pitch) else float("nan")


def quantities_of(structure: Structure) -> tuple[Quantity, ...]:
    """All pictures that there are of a skin, in the order of its types; at least one."""
    types = {t.name: t for t in structure.types if (structure.sensor_type == t.id).any()}
    names: dict[str, str] = {}
    axes: dict[str, tuple[str, str]] = {}
    for name in types:
        prefix = name.removesuffix("_z")
        beside = (SHEAR_X.name, SHEAR_Y.name) if name == PRESSURE.name else (f"{prefix}_x", f"{prefix}_y")
        if (prefix != name or name == PRESSURE.name) and types.keys() >= set(beside):
            names[name], axes[name] = prefix, beside
    shown = [name for name in types if not any(name in pair for pair in axes.values())]
    positions = np.arange(structure.n_sensors)
    return tuple(
        Quantity(
            names.get(name, name),
            types[name],
            positions[structure.index(name)],
            structure.index(name),
            _geometry(structure, name),
            axes.get(name, ()),
            _beside(structure, name, axes.get(name, ())),
        )
        for name in shown
    )


def _geometry(structure: Structure, name: str) -> Geometry:
    where = structure.index(name)
    if structure.geometry is not None:
        return structure.geometry[where]
    uid = structure.sensor_uid[where]
    return Geometry.unknown([name] * len(uid), uid)


def _beside(structure: Structure, name: str, axes: tuple[str, ...]) -> npt.NDArray[np.int64]:
    """(n, 2) positions of the sensors of two axes that have the uids of those of a type; (n, 0) without axes."""
    uid = structure.sensor_uid[structure.index(name)].tolist()
    columns = []
    for axis in axes:
        positions = np.arange(structure.n_sensors)[structure.index(axis)].tolist()
        of_uid = dict(zip(structure.sensor_uid[positions].tolist(), positions, strict=True))
        columns.append([of_uid.get(one, -1) for one in uid])
    return np.array(columns, np.int64).reshape(len(axes), len(uid)).T


Levels = npt.NDArray[np.uint8]

HIGHEST = 250
NO_VALUE = 255
WITHOUT_VALUE = Status.NO_ACK | Status.MASKED | Status.NEVER_SEEN | Status.NOT_CONNECTED
"""Of these a value means nothing."""
_LONGEST = 127
_STEEPEST = float(np.finfo(np.float32).max)


def levels_of(values: npt.NDArray[np.floating[Any]], status: npt.NDArray[np.uint8], low: float, high: float) -> Levels:
    """(n,) uint8: where values lie between ``low`` (0) and ``high`` (250), in even steps; 255 where there is no value.

    Args:
        values: (n,) physical.
        status: (n,) uint8, bits of :class:`skinware.status.Status`.
        low: what is level 0, and all below it.
        high: what is level 250, and all above it.
    """
    scaled = (values - values.dtype.type(low)).astype(np.float32, copy=False)
    known = np.isfinite(scaled)
    if not known.all():
        scaled[~known] = 0
    steepness = HIGHEST / (high - low) if high > low else np.inf
    scaled *= np.float32(min(steepness, _STEEPEST))
    scaled += np.float32(0.5)
    np.clip(scaled, 0, HIGHEST, out=scaled)
    levels = scaled.astype(np.uint8)
    if not known.all():
        levels[~known] = NO_VALUE
    levels[(status & np.uint8(WITHOUT_VALUE)) != 0] = NO_VALUE
    return levels


def shear_of(vectors: npt.NDArray[np.floating[Any]], longest: float) -> npt.NDArray[np.int8]:
    """(n, 2) int8: vectors as parts of ``longest``, which is 127; 0 where one is not known."""
    scaled = np.nan_to_num(vectors * np.float32(_LONGEST / longest if longest > 0 else 0.0), posinf=0.0, neginf=0.0)
    parts: npt.NDArray[np.int8] = np.clip(np.rint(scaled), -_LONGEST, _LONGEST).astype(np.int8)
    return parts


Floats = npt.NDArray[np.float32]

_LEAST_SPAN = 8
"""Of a scale of changes, in multiples of the noise."""
_FORGET_S = 20.0
_STEPS = (1, 1.5, 2, 3, 4, 6, 8, 10)


class ChangeSpan:
    """The greatest change from rest seen lately, rounded up; forgotten slowly."""

    def __init__(self) -> None:
        self._greatest = 0.0
        self._time_ns = 0

    def follow(self, change: Floats, noise: float, time_ns: int) -> float:
        """The span with what is new.

        Args:
            change: (k,) physical, 0 or more, of the sensors that count.
            noise: how far values move by themselves: the span is at least 8 times as much.
            time_ns: of the frame.
        """
        passed_s = max(0, time_ns - self._time_ns) / 1e9
        self._time_ns = time_ns
        self._greatest *= math.exp(-passed_s / _FORGET_S)
        self._greatest = max(self._greatest, float(change.max(initial=0)))
        return rounded_up(max(self._greatest, _LEAST_SPAN * noise))


class ValueLimits:
    """Two limits where they are known, otherwise the extremes seen so far."""

    def __init__(self) -> None:
        self._low, self._high = math.inf, -math.inf

    def follow(self, values: Floats, limits: tuple[float, float]) -> tuple[float, float]:
        """The limits with what is new.

        Args:
            values: (k,) of the sensors that count.
            limits: infinite where they are not known.
        """
        if all(map(math.isfinite, limits)):
            return limits
        counting = values[np.isfinite(values)]
        self._low = min(self._low, float(counting.min(initial=math.inf)))
        self._high = max(self._high, float(counting.max(initial=-math.inf)))
        return (self._low, self._high) if self._low <= self._high else (0.0, 1.0)


def rounded_up(value: float) -> float:
    """The next of a few round numbers, of any size."""
    if not value > 0 or not math.isfinite(value):
        return 1.0
    unit = 10.0 ** math.floor(math.log10(value))
    return next(step * unit for step in _STEPS if step * unit >= value * (1 - 1e-9))


SETTLING_S = 1.0
_FALL_S = 1.0
_DRIFT_S = 60.0
_GROW_WHEN_TOUCHED = ("pressure", "force")


class Rest:
    """The baseline of every sensor of a driver, and how much it moves by itself.

    A baseline is the mean of the first second, and follows slowly then, over a minute: a touch stays to be seen, drift
    does not. That of pressure and force, which only grow when touched, follows a lower value within a second: who was
    touched at the start is right again soon after it was let go.

    Args:
        structure: of the driver.

    Attributes:
        baseline: (n,) float32, physical; NaN where a sensor had no fresh value so far.
    """

    def __init__(self, structure: Structure) -> None:
        self._structure = structure
        growing = [t.id for t in structure.types if t.name in _GROW_WHEN_TOUCHED]
        self._fall_s = np.where(np.isin(structure.sensor_type, growing), _FALL_S, _DRIFT_S).astype(np.float32)
        self.begin()

    def begin(self) -> None:
        """Forget everything: what comes next is the baseline."""
        n = self._structure.n_sensors
        self.baseline: Floats = np.full(n, np.nan, np.float32)
        self._age_s = np.zeros(n, np.float32)
        self._unrest = np.zeros(n, np.float32)
        self._time_ns: int | None = None

    def follow(self, physical: Floats, fresh: npt.NDArray[np.bool_], time_ns: int) -> None:
        """Take a frame into account; the same one again changes nothing.

        Args:
            physical: (n,) physical values.
            fresh: (n,) bool; others are left out.
            time_ns: of the frame, CLOCK_MONOTONIC.
        """
        passed_s = np.float32(0 if self._time_ns is None else min(1.0, max(0, time_ns - self._time_ns) / 1e9))
        self._time_ns = time_ns
        counts = fresh & np.isfinite(physical)
        self.baseline = np.where(counts & np.isnan(self.baseline), physical, self.baseline)
        change = np.where(counts, physical - self.baseline, np.float32(0))
        settling = self._age_s < SETTLING_S
        np.maximum(self._unrest, np.where(settling, np.abs(change), 0), out=self._unrest)
        slow_s = np.where(change < 0, self._fall_s, np.float32(_DRIFT_S))
        self._age_s += passed_s * counts
        follow_s = np.where(settling, self._age_s, slow_s)
        self.baseline += change * (passed_s / np.maximum(follow_s + passed_s, np.float32(1e-9)))

    def change(self, physical: Floats) -> Floats:
        """(n,) float32, 0 or more: how far values are from the baseline, up or down; 0 where there is none."""
        change: Floats = np.nan_to_num(np.abs(physical - self.baseline), posinf=0.0)
        return change

    def noise(self, type_name: str) -> float:
        """How far a sensor of a type moves by itself: half of them moved less in their first second.

        At least one count of the hardware.
        """
        unrest = self._unrest[self._structure.index(type_name)]
        count = abs(self._structure.type(type_name).scale) if self._structure.dtype.kind != "f" else 0.0
        return max(float(np.median(unrest)), count)


LENGTH_S = 10.0
_FRAMES = 320
"""Kept at most: ten seconds at 32 pictures a second."""


class Past:
    """Values of n sensors, frame by frame; the oldest are forgotten.

    Args:
        n: sensors.
        dtype: of their values.
    """

    def __init__(self, n: int, dtype: npt.DTypeLike) -> None:
        self._values: npt.NDArray[Any] = np.zeros((_FRAMES, n), dtype)
        self._time_ns = np.zeros(_FRAMES, np.int64)
        self._count = 0

    def add(self, values: npt.NDArray[Any], time_ns: int) -> None:
        """Keep a frame.

        Args:
            values: (n,) raw.
            time_ns: when it was published, later than all before it.
        """
        row = self._count % _FRAMES
        self._values[row], self._time_ns[row] = values, time_ns
        self._count += 1

    def series(self, position: int) -> tuple[npt.NDArray[np.int64], npt.NDArray[Any]]:
        """(k,) int64 ns and (k,): times and raw values of a sensor in the last ten seconds before the newest frame."""
        rows = self._rows()
        return self._time_ns[rows], self._values[rows, position]

    def noise(self, positions: list[int]) -> npt.NDArray[np.float64]:
        """(k,) float64: standard deviation of the raw values of sensors, as they go from frame to frame.

        NaN before there are three frames.
        """
        rows = self._rows()
        if len(rows) < 3:
            return np.full(len(positions), np.nan)
        values = self._values[np.ix_(rows, np.array(positions, np.int64))].astype(np.float64)
        noise: npt.NDArray[np.float64] = np.diff(values, axis=0).std(axis=0) / np.sqrt(2)
        return noise

    def _rows(self) -> npt.NDArray[np.int64]:
        """Rows of the last ten seconds, the oldest first."""
        rows = np.arange(max(0, self._count - _FRAMES), self._count) % _FRAMES
        if not len(rows):
            return rows
        times = self._time_ns[rows]
        recent: npt.NDArray[np.int64] = rows[times >= times[-1] - LENGTH_S * NS_PER_S]
        return recent
