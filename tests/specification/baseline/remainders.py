"""Learn what covers keep of loads that are over, and predict it: it fades by itself, and is no load."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from tests.specification.baseline.numbers import FADED, FALLEN, LEFT_AT_S, MOST_REMAINDER, SETTLED_S, USED_S
from tests.specification.baseline.offsets import Grouping

Floats = npt.NDArray[np.float32]
Flags = npt.NDArray[np.bool_]
Rows = npt.NDArray[np.intp]


class Remainders:
    """Follows the remainders of loads on n taxels.

    Args:
        modules: the modules of the taxels.
        patch: (n,) int, the patch of each: its cover keeps one share of all loads.

    Attributes:
        used: (n,) float32, the load that the material is used to.
        any_used: whether it is used to any.
        left: (n,) float32, what is left of loads that are over.
        share: (n_patches,) float32, share of a load that a cover keeps.
        since_end_s: (n,) float32, how long each has been free of touches.
        begun_s: (n_modules,) how long ago the newest touch began on each module.
    """

    def __init__(self, modules: Grouping, patch: Rows) -> None:
        n = len(patch)
        self._modules, self._patch = modules, patch
        self.used, self.left, self._steady, self._used_then = (np.zeros(n, np.float32) for _ in range(4))
        self._since_fall_s: Floats = np.full(n, np.inf, np.float32)
        self._noted: Floats = np.full(n, np.nan, np.float32)
        """How much was left some seconds after a fall."""
        self.since_end_s: Floats = np.full(n, np.inf, np.float32)
        self.begun_s: npt.NDArray[np.float64] = np.full(modules.n, np.inf)
        self.any_used = False
        self.share: Floats = np.zeros(int(patch.max(initial=-1)) + 1, np.float32)

    @property
    def has_settled(self) -> Flags:
        """(n,) which taxels' last touch has been over for a second: what is left of it is known now."""
        settled: Flags = self.since_end_s >= SETTLED_S
        return settled

    def begin(self, taxels: Rows, load: Floats) -> None:
        """Begin with touches of k taxels and their (k,) loads."""
        self._steady[taxels] = load
        self._since_fall_s[taxels] = np.inf
        self._noted[taxels] = np.nan
        self.begun_s[self._modules.group[taxels]] = 0

    def forget(self, taxels: Rows) -> None:
        """Drop what is known of some taxels."""
        for array in (self.used, self.left):
            array[taxels] = 0
        self.since_end_s[taxels] = np.inf

    def fade(self, active: Rows, load: Floats, off: Floats, passed_s: float) -> Flags:
        """Return (k,) where what was left after a sudden fall faded by itself, and learn how much remains."""
        steady = self._steady[active]
        fell = (load < FALLEN * steady) & (steady > 2 * off)
        moved = fell | (np.abs(load - steady) > off)
        steady = np.where(fell, load, steady + (load - steady) * np.float32(-math.expm1(-passed_s)))
        left = np.where(moved, np.nan, self._noted[active])
        goes_on = ~(moved & np.isfinite(self._noted[active]))
        since = np.where(fell, 0, np.where(goes_on, self._since_fall_s[active], np.inf)) + np.float32(passed_s)
        notes = np.isnan(left) & (since >= LEFT_AT_S) & (since < 2 * LEFT_AT_S)
        left = np.where(notes, steady, left)
        then = np.where(notes, self.used[active], self._used_then[active])
        self._steady[active], self._noted[active] = steady, left
        self._since_fall_s[active], self._used_then[active] = since, then
        faded: Flags = (steady < np.minimum(FADED * left, left - 0.5 * off)) & (left < MOST_REMAINDER * then)
        faded &= since < 2 * USED_S
        faded &= self.begun_s[self._modules.group[active]] >= since  # else the load may have moved to that touch
        if faded.any():
            self._learn(active[faded], left[faded], then[faded], 1.0)
        return faded

    def _learn(self, taxels: Rows, left: Floats, used: Floats, weight: float) -> None:
        patch = self._patch[taxels]
        power = np.bincount(patch, used * used, len(self.share))
        found = np.bincount(patch, left * used, len(self.share)) / np.maximum(power, 1e-12)
        change = np.float32(weight) * (found.astype(np.float32) - self.share)
        self.share += np.where(power > 0, change, 0)
        np.clip(self.share, 0, MOST_REMAINDER, out=self.share)

    def follow(self, load: Floats, smooth: Floats, touched: Flags, on: Floats, passed_s: float) -> None:
        """Follow what the material is used to, and predict what is left of it.

        Args:
            load: (n,) above the offsets.
            smooth: (n,) the same, smoothed.
            touched: (n,) which are touched.
            on: (n,) threshold of touch.
            passed_s: since the last frame.
        """
        self.any_used = bool(self.used.any())
        rows = np.flatnonzero(touched | (self.used > 0) | (self.since_end_s < SETTLED_S))
        if not len(rows):
            return
        now = np.where(touched[rows], np.maximum(load[rows], 0), np.float32(0))
        used = self.used[rows]
        used += (now - used) * np.float32(-math.expm1(-passed_s / USED_S))
        used[(used < 0.5 * on[rows]) & ~touched[rows]] = 0
        self.used[rows] = used
        after = self.since_end_s[rows]
        self.since_end_s += np.float32(passed_s)
        due = (after < SETTLED_S) & (after + passed_s >= SETTLED_S) & ~touched[rows] & (used > 5 * on[rows])
        if due.any():
            due &= self._modules.sum(touched)[self._modules.group[rows]] == 0  # else a weaker grip may be left
            taxels = rows[due]
            self._learn(taxels, smooth[taxels] + self.left[taxels], used[due], 0.5)
        self.any_used |= bool(used.any())
        self.left[rows] = self.share[self._patch[rows]] * np.maximum(used - now, 0)
