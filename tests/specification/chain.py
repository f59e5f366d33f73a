"""Take frames through baselines, and find loads and onsets: what ``skinware/native/chain.c`` does, in numpy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from skinware import Status
from skinware.tactile.baseline import UNUSABLE, Baseline, Calm

Floats = npt.NDArray[np.float32]
Flags = npt.NDArray[np.bool_]
Bytes = npt.NDArray[np.uint8]

ABOVE_SIGMA, ENOUGH, FRAMES = 5.0, 2, 3


class SpecifiedCalm:
    """A chain of baselines, of some types at these positions of a snapshot."""

    def __init__(self, baselines: Sequence[Baseline], indexes: Sequence[npt.NDArray[np.int64]]) -> None:
        self._types = list(zip(baselines, indexes, strict=True))
        self._suspect: Flags | None = None
        self.given: list[Floats] = []
        self.calms: list[Calm] = []

    def step(self, time_ns: int, given: Floats, status: Bytes) -> tuple[Floats, Bytes]:
        """Return what comes out of the chain: values and status."""
        usable = ((status & UNUSABLE) == 0) & np.isfinite(given)
        suspect = (status & Status.SUSPECT) != 0
        jumped = np.zeros_like(suspect) if self._suspect is None else suspect & ~self._suspect
        self._suspect = suspect
        self.given = [given[at] for _, at in self._types]
        self.calms = [
            baseline.update(time_ns, given[at], usable[at], jumped=jumped[at]) for baseline, at in self._types
        ]
        values, found = given.copy(), status.copy()
        for (_, at), calm in zip(self._types, self.calms, strict=True):
            values[at] = calm.value
            found[at] |= calm.forced * np.uint8(Status.SUSPECT)
            found[at] |= np.isnan(calm.baseline) * np.uint8(Status.NEVER_SEEN)
        return values, found


class Onsets:
    """Finds which of n taxels have risen beyond their own noise in two of the last three frames.

    Nothing is smoothed: a spike of one frame is none, and a touch is found in its second frame, at any rate.
    """

    def __init__(self, n: int, resolution: float = 0.0) -> None:
        self._least = ENOUGH * resolution
        self._were: list[Flags] = [np.zeros(n, bool) for _ in range(FRAMES - 1)]

    def update(self, above: Floats, noise: Floats, usable: Flags) -> Flags:
        """Return (n,) bool, which taxels are touched, as far as the newest frames say."""
        is_above = usable & (above > np.maximum(ABOVE_SIGMA * noise, self._least))
        count = np.sum([is_above, *self._were], axis=0, dtype=np.int8)
        self._were = [*self._were[1:], is_above]
        onset: Flags = is_above & (count >= ENOUGH)
        return onset


@dataclass
class SpecifiedLoads:
    """The loads of taxels of one axis or three, as their chain gives them."""

    indexes: Sequence[npt.NDArray[np.int64]]
    maximum: float
    onsets: Onsets

    def find(self, chain: SpecifiedCalm, values: Floats, status: Bytes) -> tuple[npt.NDArray[Any], ...]:
        """Return loads, touched, onsets, clipped, uncertainties, and the last axis over its noise."""
        calms = list(zip(chain.given, chain.calms, strict=True))
        usable = np.logical_and.reduce([(status[at] & UNUSABLE) == 0 for at in self.indexes])
        touched = np.logical_or.reduce([calm.touched for _, calm in calms])
        deviation = _length([given - calm.baseline for given, calm in calms])
        doubt = _length([np.hypot(calm.noise, calm.uncertainty) for _, calm in calms]) / np.sqrt(np.float32(len(calms)))
        known = np.logical_and.reduce([usable, *(calm.usable for _, calm in calms)])
        clipped = np.logical_or.reduce([given >= self.maximum for given, _ in calms])
        given, calm = calms[-1]
        sigmas = (given - calm.baseline) / np.where(known & (calm.noise > 0), calm.noise, np.float32(np.nan))
        onset = self.onsets.update(deviation, doubt, known)
        return _length([values[at] for at in self.indexes]), touched & usable, onset, clipped, doubt, sigmas


def _length(axes: list[Floats]) -> Floats:
    length: Floats = axes[0] if len(axes) == 1 else np.sqrt(sum(axis**2 for axis in axes))
    return length
