"""Gather the evidence of taxels' health that every frame gives: what ``skinware/native/health.c`` does, in numpy."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from skinware.tactile.baseline import Calm

Floats = npt.NDArray[np.float32]

CLEAR, HARD, PLAIN, KEPT, STILL_FRAMES = 8.0, 0.25, 24.0, 0.95, 5


class SpecifiedUse:
    """The evidence of n taxels; attributes have the names of ``struct health``."""

    def __init__(self, n: int, limits: tuple[float, float]) -> None:
        self._least, self._most = limits
        self.value: Floats = np.full(n, np.nan, np.float32)
        self.peak, self.usual, self.total = np.zeros((3, n), np.float32)
        self.sums: Floats = np.zeros((3, n), np.float32)
        self.changed_s = np.zeros(n)
        self.seen, self.touched, self.misled, self.was_free = np.zeros((4, n), bool)
        self.still = np.zeros(n, np.int64)

    def compare(self, given: Floats, calm: Calm, clear: float) -> None:
        self.far = np.fmax(np.float32(CLEAR) * calm.noise, np.float32(clear))
        free = calm.usable & ~calm.touched & (given <= calm.baseline + self.far)
        self.at_end = (given <= self._least) | (given >= self._most)
        both = free & self.was_free
        self.was_free = free
        difference = np.where(both, given - self.value, np.float32(0))
        self.sums += difference * difference, both, both & self.at_end
        self.jump = np.abs(given - self.value)
        self.was_still = self.still >= STILL_FRAMES
        self.still = np.where(self.jump <= self.far, self.still + 1, 0)
        self.moved = (self.jump > 2 * self.far) & calm.usable

    def take(self, given: Floats, calm: Calm, now_s: float, passed_s: float, clear: float) -> None:
        usable = calm.usable
        changed = usable & (given != self.value)
        np.copyto(self.changed_s, now_s, where=changed)
        self.changed_s += passed_s * ~usable
        np.copyto(self.value, given, where=changed)
        self.seen |= usable
        touched = calm.touched & usable
        self.begun = touched & ~self.touched
        self.touched = touched
        self.usual[self.begun] *= KEPT
        for most in (self.peak, self.usual):
            most[touched] = np.maximum(most[touched], calm.value[touched])
        self.hard = touched & (calm.value > np.maximum(clear, HARD * self.usual)) & ~self.misled
        self.above = given - calm.baseline
        self.plain = calm.touched & (self.above > PLAIN * (clear / CLEAR))
        self.total += np.where(usable, given, np.float32(np.nan))
