"""Remember values from frame to frame: at rest, their spans, the last seconds, and a wipe test."""

from __future__ import annotations

import math
from collections import deque
from typing import Any

import numpy as np
import numpy.typing as npt

from skinware.realtime import NS_PER_S
from skinware.structure import Structure

Floats = npt.NDArray[np.float32]

_LEAST_SPAN = 8
"""The least span of a scale of changes, in multiples of the noise."""
_FORGET_S = 20.0
_STEPS = (1, 1.5, 2, 3, 4, 6, 8, 10)
SETTLING_S = 1.0
_FALL_S = 1.0
_DRIFT_S = 60.0
_GROW_WHEN_TOUCHED = ("pressure", "force")
LENGTH_S = 10.0
_FRAMES = 320
"""Snapshots that are kept at most: ten seconds at 32 a second."""
_TIMES_THE_NOISE = 6
_FOLLOW_EVERY_NS = NS_PER_S // 4


def rounded_up(value: float) -> float:
    """Return the next of a few round numbers, of any size."""
    if not value > 0 or not math.isfinite(value):
        return 1.0
    unit = 10.0 ** math.floor(math.log10(value))
    return next(step * unit for step in _STEPS if step * unit >= value * (1 - 1e-9))


class DriverRest:
    """The baseline of every sensor of a driver, and its noise.

    A baseline is the mean of the first second. Then it follows slowly, over a minute: a touch stays visible, drift does
    not. Pressure and force only grow when touched, and their baselines follow a lower value within a second: a sensor
    that was touched at the start is right again soon after it was let go.

    Attributes:
        baseline: (n,) float32, physical; NaN for a sensor that had no fresh value so far.
    """

    def __init__(self, structure: Structure) -> None:
        self._structure = structure
        growing = [t.id for t in structure.types if t.name in _GROW_WHEN_TOUCHED]
        self._grows: npt.NDArray[np.bool_] = np.isin(structure.sensor_type, growing)
        n = structure.n_sensors
        self.baseline: Floats = np.full(n, np.nan, np.float32)
        self._age_s = np.zeros(n, np.float32)
        self._unrest = np.zeros(n, np.float32)
        self._is_settling = n > 0
        self._time_ns: int | None = None
        self._every_ns = 0

    def is_due(self, time_ns: int) -> bool:
        """Return whether a snapshot of this time changes anything."""
        return self._time_ns is None or not 0 <= time_ns - self._time_ns < self._every_ns

    def follow(self, physical: Floats, fresh: npt.NDArray[np.bool_], time_ns: int) -> None:
        """Take a snapshot into account; the same one again changes nothing. At rest, four a second are enough.

        Args:
            physical: (n,) physical values.
            fresh: (n,) bool; other sensors are left out.
            time_ns: when it was published, CLOCK_MONOTONIC.
        """
        if not self.is_due(time_ns):
            return
        passed_s = 0.0 if self._time_ns is None else min(1.0, max(0, time_ns - self._time_ns) / 1e9)
        self._time_ns = time_ns
        counts = fresh & np.isfinite(physical)
        if self._is_settling:
            self.baseline = np.where(counts & np.isnan(self.baseline), physical, self.baseline)
        change = np.where(counts, physical - self.baseline, np.float32(0))
        falls, drifts = (np.float32(-math.expm1(-passed_s / duration_s)) for duration_s in (_FALL_S, _DRIFT_S))
        share = np.where((change < 0) & self._grows, falls, drifts)
        self._every_ns = _FOLLOW_EVERY_NS
        if self._is_settling:
            settling = self._age_s < SETTLING_S
            np.maximum(self._unrest, np.where(settling, np.abs(change), 0), out=self._unrest)
            self._age_s += np.float32(passed_s) * counts
            first = np.float32(passed_s) / np.maximum(self._age_s + np.float32(passed_s), np.float32(1e-9))
            share = np.where(settling, first, share)
            self._every_ns = 0 if (settling & counts).any() else _FOLLOW_EVERY_NS
            self._is_settling = bool(settling.any())
        self.baseline += change * share

    def change(self, physical: Floats) -> Floats:
        """Return (n,) float32, 0 or more: distance of values from the baseline, up or down; 0 without a baseline."""
        change: Floats = np.nan_to_num(np.abs(physical - self.baseline), posinf=0.0)
        return change

    def noise(self, type_name: str) -> float:
        """Return the noise of a type: half of its sensors moved less in their first second; at least one count."""
        unrest = self._unrest[self._structure.span(type_name)]
        count = abs(self._structure.type(type_name).scale) if self._structure.dtype.kind != "f" else 0.0
        return max(float(np.median(unrest)), count)


class RecentValues:
    def __init__(self, structure: Structure) -> None:
        self._values: npt.NDArray[Any] = np.zeros((_FRAMES, structure.n_sensors), structure.dtype)
        self._time_ns = np.zeros(_FRAMES, np.int64)
        self._count = 0

    def add(self, values: npt.NDArray[Any], time_ns: int) -> None:
        """Keep the (n,) raw values of a snapshot, published later than all before."""
        row = self._count % _FRAMES
        self._values[row], self._time_ns[row] = values, time_ns
        self._count += 1

    def series(self, position: int) -> tuple[npt.NDArray[np.int64], npt.NDArray[Any]]:
        """Return (k,) int64 ns and (k,) raw values of a sensor in the ten seconds before the newest snapshot."""
        rows = np.arange(max(0, self._count - _FRAMES), self._count) % _FRAMES
        times = self._time_ns[rows]
        rows = rows[times >= times.max(initial=0) - LENGTH_S * NS_PER_S]
        return self._time_ns[rows], self._values[rows, position]


class WipeTest:
    """How far every sensor of a driver has moved while a hand goes over the whole skin.

    A sensor that never moved is broken, however plausible its value is.
    """

    def __init__(self, structure: Structure) -> None:
        self._structure = structure
        self._lowest: Floats = np.full(structure.n_sensors, np.inf, np.float32)
        self._highest: Floats = np.full(structure.n_sensors, -np.inf, np.float32)

    def follow(self, physical: Floats, fresh: npt.NDArray[np.bool_]) -> None:
        """Take (n,) physical values into account where they are fresh."""
        np.fmin(self._lowest, physical, out=self._lowest, where=fresh)
        np.fmax(self._highest, physical, out=self._highest, where=fresh)

    def travel(self) -> Floats:
        """Return (n,) float32, from the lowest to the highest value of each sensor; 0 without any fresh value."""
        travel: Floats = np.nan_to_num(np.maximum(self._highest - self._lowest, 0))
        return travel

    def never_moved(self, type_name: str, noise: float) -> npt.NDArray[np.int64]:
        """Return positions of the sensors of a type that never moved by more than ``threshold(noise)``."""
        index = self._structure.index(type_name)
        positions = np.arange(self._structure.n_sensors)[index]
        return positions[self.travel()[index] <= threshold(noise)]


def threshold(noise: float) -> float:
    """Return how far a sensor moves at least when it is touched."""
    return _TIMES_THE_NOISE * noise


class Memory:
    def __init__(self, structure: Structure, rest: DriverRest | None = None) -> None:
        self.structure = structure
        self.rest = rest or DriverRest(structure)
        self.wipe: WipeTest | None = None
        self.peak: tuple[str, Floats] | None = None
        self.loads: deque[tuple[str, npt.NDArray[np.float64]]] = deque(maxlen=_FRAMES)
        self._greatest: dict[tuple[str, str], tuple[float, int]] = {}  # and when
        self._extremes: dict[tuple[str, str], tuple[float, float]] = {}

    def span(self, key: tuple[str, str], change: Floats, noise: float, time_ns: int) -> float:
        """Return the greatest change from rest seen lately, rounded up; it is forgotten slowly.

        Args:
            change: (k,) physical, 0 or more, of the sensors that count.
            noise: how far values move without a touch; the span is at least 8 times as large.
        """
        greatest, before_ns = self._greatest.get(key, (0.0, time_ns))
        greatest *= math.exp(-max(0, time_ns - before_ns) / 1e9 / _FORGET_S)
        greatest = max(greatest, float(change.max(initial=0)))
        self._greatest[key] = greatest, time_ns
        return rounded_up(max(greatest, _LEAST_SPAN * noise))

    def limits(self, key: tuple[str, str], values: Floats, known: tuple[float, float]) -> tuple[float, float]:
        """Return the two limits of values where they are known, otherwise the extremes of (k,) values seen so far."""
        if all(map(math.isfinite, known)):
            return known
        counting = values[np.isfinite(values)]
        low, high = self._extremes.get(key, (math.inf, -math.inf))
        low, high = min(low, float(counting.min(initial=math.inf))), max(high, float(counting.max(initial=-math.inf)))
        self._extremes[key] = low, high
        return (low, high) if low <= high else (0.0, 1.0)
