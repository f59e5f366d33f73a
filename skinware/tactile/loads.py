"""Choose the loads in which the contacts of a chain are found."""

from __future__ import annotations

from typing import Self

import numpy as np
import numpy.typing as npt

from skinware.tactile.chain import Chain
from skinware.tactile.contacts_service import More
from skinware.tactile.onsets import Onsets
from skinware.tactile.rule import SIGNED_TYPES, UNUSABLE


class Loads:
    """The loads of n taxels of a chain: values of one type, or lengths of vectors of three.

    Args:
        chain: the chain.
        names: the types; the contacts are those of the last one.

    Attributes:
        type_name: sensor type of the contacts.
        n_sensors: number of all sensors of the chain.
    """

    def __init__(self, chain: Chain, names: tuple[str, ...]) -> None:
        self.type_name, self.n_sensors = names[-1], chain.structure.n_sensors
        self._stages = [chain.baseline_stages[name] for name in names]
        self._indexes = [chain.structure.index(name) for name in names]
        self._before = self._stages[-1].before
        self._onsets = Onsets(len(self._before), self._before.resolution)

    @classmethod
    def of(cls, chain: Chain) -> Self | None:
        """Return those of pressures, else of another type that a touch only raises, else of vectors; None: of none."""
        rising = [name for name in chain.baseline_stages if not name.startswith(SIGNED_TYPES)]
        if rising:
            return cls(chain, ("pressure" if "pressure" in rising else rising[0],))
        vectors = [names for names in chain.vectors if set(names) <= set(chain.baseline_stages)]
        return cls(chain, vectors[0]) if vectors else None

    def usable(self, status: npt.NDArray[np.uint8]) -> npt.NDArray[np.bool_]:
        """Return (n,) bool, which taxels have values of this frame, of (n_sensors,) status."""
        usable: npt.NDArray[np.bool_] = (status[self._indexes[0]] & UNUSABLE) == 0
        for index in self._indexes[1:]:
            usable &= (status[index] & UNUSABLE) == 0
        return usable

    def values(self, values: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """Return (n,) loads of (n_sensors,) values."""
        return _length([values[index] for index in self._indexes])

    @property
    def touched(self) -> npt.NDArray[np.bool_]:
        """(n,) bool, which taxels are touched in the newest frame."""
        touched: npt.NDArray[np.bool_] = np.logical_or.reduce([stage.touched for stage in self._stages])
        return touched

    def more(self, usable: npt.NDArray[np.bool_], unit: str) -> More:
        """Return onsets, clipped taxels and (in the same unit) uncertainties, as far as they are known."""
        calms = [(stage.given, stage.calm) for stage in self._stages if stage.calm is not None]
        if not calms:
            return {}
        deviation = _length([given - calm.baseline for given, calm in calms])
        doubt = _length([np.hypot(calm.noise, calm.uncertainty) for _, calm in calms]) / np.sqrt(np.float32(len(calms)))
        known = np.logical_and.reduce([usable, *(calm.usable for _, calm in calms)])
        clipped = np.logical_or.reduce([given >= self._before.type.maximum for given, _ in calms])
        return {
            "onset": self._onsets.update(deviation, doubt, known),
            "clipped": clipped,
            "uncertainty": doubt if unit == self._before.type.unit else None,
        }


def _length(axes: list[npt.NDArray[np.float32]]) -> npt.NDArray[np.float32]:
    """Return (n,) lengths of vectors, by their axes (n,) each; one axis is its own length, with its sign."""
    length: npt.NDArray[np.float32] = axes[0] if len(axes) == 1 else np.sqrt(sum(axis**2 for axis in axes))
    return length
