"""What sensors read at rest, as a view of them guesses it; the drivers and their data know nothing of it."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from skinware.structure import Structure

Floats = npt.NDArray[np.float32]

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
