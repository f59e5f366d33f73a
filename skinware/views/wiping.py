"""A wipe test: a hand goes over the whole skin once; what never moved is broken, however plausible its value."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import numpy.typing as npt

from skinware.structure import Structure

Floats = npt.NDArray[np.float32]
_TIMES_THE_NOISE = 6


class WipeTest:
    """How far every sensor of a driver has moved since the test began.

    Args:
        structure: of the driver.
    """

    def __init__(self, structure: Structure) -> None:
        self._structure = structure
        self._lowest: Floats = np.full(structure.n_sensors, np.inf, np.float32)
        self._highest: Floats = np.full(structure.n_sensors, -np.inf, np.float32)

    def follow(self, physical: Floats, fresh: npt.NDArray[np.bool_]) -> None:
        """Take a frame into account.

        Args:
            physical: (n,) physical values.
            fresh: (n,) bool; others are left out.
        """
        np.fmin(self._lowest, physical, out=self._lowest, where=fresh)
        np.fmax(self._highest, physical, out=self._highest, where=fresh)

    def travel(self) -> Floats:
        """(n,) float32: from the lowest to the highest value of each sensor; 0 for one that had no fresh value."""
        travel: Floats = np.nan_to_num(np.maximum(self._highest - self._lowest, 0))
        return travel

    def never_moved(self, type_name: str, noise: float) -> npt.NDArray[np.int64]:
        """Positions in a frame of the sensors of a type that never moved by more than ``threshold(noise)``."""
        index = self._structure.index(type_name)
        positions = np.arange(self._structure.n_sensors)[index]
        return positions[self.travel()[index] <= threshold(noise)]

    def save(self, folder: Path, driver: str, type_name: str, noise: float) -> Path:
        """Write a list of the sensors that never moved.

        Args:
            folder: where to put it.
            driver: name of the driver.
            type_name: which sensors.
            noise: of that type, physical.

        Returns:
            The new file; its name has the time.

        Raises:
            OSError: it cannot be written.
        """
        structure = self._structure
        never = self.never_moved(type_name, noise)
        unit = structure.type(type_name).unit
        size = len(np.arange(structure.n_sensors)[structure.index(type_name)])
        path = folder / f"never-moved-{driver}-{type_name}-{time.strftime('%Y%m%d-%H%M%S')}.txt"
        head = f"# {driver}: {len(never)} of {size} {type_name} sensors never moved by more than"
        lines = [f"{head} {threshold(noise):.4g} {unit}".rstrip(), "# position in a frame, uid, name"]
        lines += [f"{p}\t{int(structure.sensor_uid[p]):#x}\t{structure.sensor_name(p)}" for p in never.tolist()]
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")
        return path


def threshold(noise: float) -> float:
    """How far a sensor must move to have been touched, given how far it moves by itself."""
    return _TIMES_THE_NOISE * noise
