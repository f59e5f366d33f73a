"""Compare deviations with what drift could be: which taxels are touched, and when a touch is over."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from skinware.tactile.offsets import Groups, Offsets
from skinware.tactile.rule import (
    ALIKE,
    DRIFT_SIGMA,
    FADED,
    FALLEN,
    LOOK_AT_S,
    MOST_ALIKE,
    MOST_REMAINDER,
    OFF_TO_ON,
    PEAK_S,
    STEP_OVER_ON,
    USED_S,
)

Floats = npt.NDArray[np.float32]
Flags = npt.NDArray[np.bool_]
Rows = npt.NDArray[np.intp]

_LEFT_AT_S = 3.0
"""Seconds after a sudden fall at which it is noted what is left."""
_QUICK_S = 0.12
"""Seconds: with frames more apart, one high value is a touch; with more frames it takes two."""


class Touches:
    """Follows touches of n taxels.

    Args:
        module: (n,) int, the module of each taxel.
        patch: (n,) int, the patch of each.
        signed: a touch may move a value to both sides.

    Attributes:
        touched: (n,) bool.
        smooth: (n,) float32, deviation from the offset, smoothed.
        peak: (n,) float32, the highest load of the touch, slowly followed.
        used: (n,) float32, the load that the material is used to.
        contact_s: (n,) float32, how long each has been touched.
        remainder: (n_patches,) share of the load that a cover keeps for a while after it.
    """

    def __init__(self, module: Rows, patch: Rows, *, signed: bool) -> None:
        n = len(module)
        self.signed = signed
        self.touched: Flags = np.zeros(n, bool)
        self._high: Flags = np.zeros(n, bool)
        self.smooth, self.peak, self.used, self.contact_s = (np.zeros(n, np.float32) for _ in range(4))
        self._steady: Floats = np.zeros(n, np.float32)
        self._since_fall_s: Floats = np.full(n, np.inf, np.float32)
        self._left: Floats = np.full(n, np.nan, np.float32)
        self._used_then: Floats = np.zeros(n, np.float32)
        self._modules, self._patch = Groups(module), patch
        self.remainder: Floats = np.zeros(int(patch.max(initial=-1)) + 1, np.float32)
        self._since_end_s: Floats = np.full(n, np.inf, np.float32)
        self._remains: Floats = np.zeros(n, np.float32)

    @property
    def remains(self) -> Floats:
        """(n,) what is left of loads that are over, by what the material is used to."""
        return self._remains

    def load(self, deviation: Floats) -> Floats:
        return np.abs(deviation) if self.signed else deviation

    def follow(self, deviation: Floats, live: Flags, on: Floats, passed_s: float, smooth_s: float) -> None:
        """Smooth the deviations (n,)."""
        share = np.float32(-math.expm1(-passed_s / smooth_s)) if smooth_s else np.float32(1)
        self.smooth += (deviation - self.smooth) * (share * live)
        if not self.signed:
            np.minimum(self.smooth, deviation + on, out=self.smooth, where=live)

    def judge(
        self, deviation: Floats, live: Flags, on: Floats, off: Floats, offsets: Offsets, passed_s: float, most_s: float
    ) -> Rows:
        """Find touches and their ends.

        Args:
            deviation: (n,) of the values.
            live: (n,) which taxels have values and offsets.
            on: (n,) a touch begins above it.
            off: (n,) and ends below it, drift or not.
            offsets: what drift could be.
            passed_s: since the last frame.
            most_s: a touch ends after this time.

        Returns:
            The taxels whose touch is over.
        """
        smooth, now = self.load(self.smooth), self.load(deviation)
        high = (now > off) & live
        begins = high & (smooth > on) & ~self.touched
        if passed_s < _QUICK_S:
            begins &= self._high
        np.copyto(self._high, high, where=live)
        begun = np.flatnonzero(begins)
        if len(begun):
            self.touched[begun] = True
            self.peak[begun] = smooth[begun]
            self._steady[begun] = smooth[begun]
            self.contact_s[begun] = 0
            self._since_fall_s[begun] = np.inf
            self._left[begun] = np.nan
        active = np.flatnonzero(self.touched & live)
        if not len(active):
            return active
        load = smooth[active]
        self.contact_s[active] += np.float32(passed_s)
        peak = self.peak[active]
        self.peak[active] = peak + np.maximum(load - peak, 0) * np.float32(-math.expm1(-passed_s / PEAK_S))
        variance = offsets.variance[active] + offsets.noise2[active] + (0.3 * self._remains[active]) ** 2
        variance += offsets.gain[active] ** 2 * offsets.common.variance[self._patch[active]].astype(np.float32)
        is_over = load < off[active]
        is_over |= (load < FALLEN * self.peak[active]) & (load * load < DRIFT_SIGMA**2 * variance)
        fades = self._fades(active, load, off[active], passed_s)
        is_over |= fades
        is_over |= self.contact_s[active] > most_s
        return active[is_over]

    def shown(self, deviation: Floats, off: Floats) -> Flags:
        """Return (n,) the touched taxels, without those whose present load is gone while the smoothed one is not."""
        shown: Flags = self.touched & (self.load(deviation) >= np.minimum(off, FALLEN * self.load(self.smooth)))
        return shown

    def _fades(self, active: Rows, load: Floats, off: Floats, passed_s: float) -> Flags:
        """Return (k,) where what was left after a sudden fall faded by itself, and learn how much remains."""
        steady = self._steady[active]
        fell = (load < FALLEN * steady) & (steady > 2 * off)
        moved = fell | (np.abs(load - steady) > off)
        steady = np.where(fell, load, steady + (load - steady) * np.float32(-math.expm1(-passed_s)))
        left = np.where(moved, np.nan, self._left[active])
        since = np.where(fell, 0, np.where(moved & np.isfinite(self._left[active]), np.inf, self._since_fall_s[active]))
        since = since + np.float32(passed_s)
        notes = np.isnan(left) & (since >= _LEFT_AT_S) & (since < 2 * _LEFT_AT_S)
        left = np.where(notes, steady, left)
        then = np.where(notes, self.used[active], self._used_then[active])
        self._steady[active], self._left[active] = steady, left
        self._since_fall_s[active], self._used_then[active] = since, then
        faded: Flags = (steady < np.minimum(FADED * left, left - 0.5 * off)) & (left < MOST_REMAINDER * then)
        faded &= since < 2 * USED_S
        if faded.any():
            self._learn_remainder(active[faded], left[faded], then[faded], 1.0)
        return faded

    def _learn_remainder(self, taxels: Rows, left: Floats, used: Floats, weight: float) -> None:
        patch = self._patch[taxels]
        power = np.bincount(patch, used * used, len(self.remainder))
        found = np.bincount(patch, left * used, len(self.remainder)) / np.maximum(power, 1e-12)
        change = np.float32(weight) * (found.astype(np.float32) - self.remainder)
        self.remainder += np.where(power > 0, change, 0)
        np.clip(self.remainder, 0, MOST_REMAINDER, out=self.remainder)

    def remember(self, deviation: Floats, on: Floats, passed_s: float) -> None:
        """Follow what the material is used to, and predict what remains of it."""
        rows = np.flatnonzero(self.touched | (self.used > 0) | (self._since_end_s < 1))
        if not len(rows):
            return
        load = np.where(self.touched[rows], np.maximum(self.load(deviation[rows]), 0), np.float32(0))
        used = self.used[rows]
        used += (load - used) * np.float32(-math.expm1(-passed_s / USED_S))
        used[(used < 0.5 * on[rows]) & ~self.touched[rows]] = 0
        self.used[rows] = used
        after = self._since_end_s[rows]
        self._since_end_s += np.float32(passed_s)
        due = (after < 1) & (after + passed_s >= 1) & ~self.touched[rows] & (used > 5 * on[rows])
        if due.any():
            due &= self._modules.sum(self.touched)[self._modules.group[rows]] == 0  # else a weaker grip may be left
            taxels = rows[due]
            self._learn_remainder(taxels, self.load(self.smooth[taxels]) + self._remains[taxels], used[due], 0.5)
        self._remains[rows] = self.remainder[self._patch[rows]] * np.maximum(used - load, 0)

    def looked(self, passed_s: float) -> tuple[Flags, Flags]:
        """Return (n,) the touches that are looked at again in this frame, and (n,) those that were."""
        old = self.touched & (self.contact_s - np.float32(passed_s) >= LOOK_AT_S)
        return self.touched & (self.contact_s >= LOOK_AT_S) & ~old, old

    def module_steps(self, live: Flags, on: Floats, offsets: Offsets, passed_s: float) -> tuple[Rows, Floats]:
        """Return the k taxels of modules that rose alike, suddenly and by little, and (k,) by how much."""
        new, _ = self.looked(passed_s)
        if self.signed or not new.any():
            return np.zeros(0, np.intp), self.smooth[:0]
        modules = self._modules
        looked = np.zeros(modules.n, bool)
        looked[modules.group[new]] = True
        here = live & looked[modules.group]
        median = modules.median(self.smooth, here)
        sudden = modules.median(offsets.slow, here) < 0.3 * median
        threshold = modules.median(on, here)
        around = np.maximum(ALIKE * modules.spread(median), 0.5 * on)
        near = here & (np.abs(self.smooth - modules.spread(median)) < around)
        number = modules.sum(here)
        alike = (number >= 4) & (modules.sum(near) >= MOST_ALIKE * number) & sudden & looked
        alike &= (median > OFF_TO_ON * threshold) & (median < STEP_OVER_ON * threshold)
        stepped = np.flatnonzero(here & alike[modules.group])
        return stepped, median[modules.group[stepped]]

    @property
    def has_settled(self) -> Flags:
        """(n,) which taxels' last touch has been over for a second: what is left of it is known now."""
        settled: Flags = self._since_end_s >= 1
        return settled

    def forget(self, taxels: Rows) -> None:
        """Drop what is known of some taxels."""
        self.end(taxels)
        for array in (self.smooth, self.used, self._remains):
            array[taxels] = 0
        self._since_end_s[taxels] = np.inf

    def end(self, taxels: Rows) -> None:
        """Drop the touches of some taxels."""
        self.touched[taxels] = False
        self._since_end_s[taxels] = 0
        for of_contact in (self.peak, self.contact_s):
            of_contact[taxels] = 0
