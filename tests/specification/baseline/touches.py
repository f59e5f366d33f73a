"""Compare deviations with what drift could be: which taxels are touched, and when a touch is over."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from tests.specification.baseline.numbers import (
    ALIKE,
    AT_ONCE,
    DRIFT_SIGMA,
    FALLEN,
    LOOK_AT_S,
    MOST_ALIKE,
    OFF_TO_ON,
    PEAK_S,
    QUICK_S,
    STEP_OVER_ON,
    USED_S,
)
from tests.specification.baseline.offsets import Grouping, Offsets
from tests.specification.baseline.remainders import Remainders

Floats = npt.NDArray[np.float32]
Flags = npt.NDArray[np.bool_]
Rows = npt.NDArray[np.intp]


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
        contact_s: (n,) float32, how long each has been touched.
        onset: (n,) float32, deviation in the first frame above the threshold at which a touch ends.
        noise_share: share of the noise that smoothing leaves; at least a half.
        remainders: what covers keep of loads.
    """

    def __init__(self, module: Rows, patch: Rows, *, signed: bool) -> None:
        n = len(module)
        self.signed = signed
        self.touched: Flags = np.zeros(n, bool)
        self._high: Flags = np.zeros(n, bool)
        self.smooth, self.peak, self.contact_s, self.onset = (np.zeros(n, np.float32) for _ in range(4))
        self._modules = Grouping(module)
        self.noise_share = 0.5
        self.remainders = Remainders(self._modules, patch)

    def load(self, deviation: Floats) -> Floats:
        return np.abs(deviation) if self.signed else deviation

    def follow(self, deviation: Floats, live: Flags, on: Floats, passed_s: float, smooth_s: float) -> None:
        """Smooth the deviations (n,); a rise above ``on`` begins at 0, however far the taxel had sunk before."""
        if not self.signed:
            np.maximum(self.smooth, 0, out=self.smooth, where=live & (deviation > on))
        share = -math.expm1(-passed_s / smooth_s) if smooth_s else 1.0
        self.noise_share = max(0.5, math.sqrt(share / (2 - share)))
        self.smooth += (deviation - self.smooth) * (np.float32(share) * live)
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
        self.remainders.begun_s += passed_s
        smooth, now = self.load(self.smooth), self.load(deviation)
        high = (now > off) & live
        begins = high & (smooth > on) & ~self.touched
        if passed_s < QUICK_S:
            begins &= self._high
        np.copyto(self.onset, deviation, where=high & ~self._high)
        np.copyto(self._high, high, where=live)
        begun = np.flatnonzero(begins)
        if len(begun):
            self.touched[begun] = True
            self.peak[begun] = smooth[begun]
            self.remainders.begin(begun, smooth[begun])
            self.contact_s[begun] = 0
        active = np.flatnonzero(self.touched & live)
        if not len(active):
            return active
        load = smooth[active]
        self.contact_s[active] += np.float32(passed_s)
        peak = self.peak[active]
        rises, eases = (np.float32(-math.expm1(-passed_s / constant_s)) for constant_s in (PEAK_S, USED_S))
        self.peak[active] = peak + (load - peak) * np.where(load > peak, rises, eases)
        variance = offsets.total()[active] + (0.3 * self.remainders.left[active]) ** 2
        is_over = load < off[active]
        is_over |= (load < FALLEN * self.peak[active]) & (load * load < DRIFT_SIGMA**2 * variance)
        fades = self.remainders.fade(active, load, off[active], passed_s)
        is_over |= fades
        is_over |= self.contact_s[active] > most_s
        return active[is_over]

    def shown(self, deviation: Floats, off: Floats) -> Flags:
        """Return (n,) the touched taxels, without those whose present load is gone while the smoothed one is not."""
        shown: Flags = self.touched & (self.load(deviation) >= np.minimum(off, FALLEN * self.load(self.smooth)))
        return shown

    def looked(self, passed_s: float) -> tuple[Flags, Flags]:
        """Return (n,) the touches that are looked at again in this frame, and (n,) those that were."""
        old = self.touched & (self.contact_s - np.float32(passed_s) >= LOOK_AT_S)
        return self.touched & (self.contact_s >= LOOK_AT_S) & ~old, old

    def module_steps(
        self, deviation: Floats, live: Flags, on: Floats, off: Floats, offsets: Offsets, passed_s: float
    ) -> tuple[Rows, Floats]:
        """Return the k taxels of modules that rose alike, at once and by little, and (k,) by how much."""
        later, _ = self.looked(passed_s)
        new = later | (self.touched & (self.contact_s <= np.float32(passed_s)))
        if self.signed or not new.any():
            return np.zeros(0, np.intp), self.smooth[:0]
        modules = self._modules
        looked, is_later = np.zeros(modules.n, bool), np.zeros(modules.n, bool)
        looked[modules.group[new]] = True
        is_later[modules.group[later]] = True
        here = live & looked[modules.group] & (~self.touched | (self.contact_s < 2 * LOOK_AT_S))
        median = modules.median(deviation, here)
        onset = modules.median(self.onset, here & self._high)
        at_once = np.abs(onset - median) < AT_ONCE * median
        at_once &= is_later | (onset > modules.median(on, here))
        sudden = modules.median(offsets.slow, here) < 0.3 * median
        around = np.maximum(ALIKE * modules.spread(median), 0.5 * on)
        near = here & (np.abs(deviation - modules.spread(median)) < around)
        number = modules.sum(here)
        alike = (number >= 4) & (modules.sum(near) >= MOST_ALIKE * number) & sudden & looked & at_once
        alike &= median > OFF_TO_ON * modules.median(on, here)
        alike &= median < np.float32(STEP_OVER_ON / OFF_TO_ON) * modules.median(off, here)
        typical = modules.spread(median)
        stepped = np.flatnonzero(live & alike[modules.group] & (deviation >= np.float32(0.5) * typical))
        return stepped, median[modules.group[stepped]].astype(np.float32)

    def forget(self, taxels: Rows) -> None:
        """Drop what is known of some taxels."""
        self.end(taxels)
        self.smooth[taxels] = 0
        self.remainders.forget(taxels)

    def end(self, taxels: Rows) -> None:
        """Drop the touches of some taxels."""
        self.touched[taxels] = False
        if not self.signed:
            self.remainders.since_end_s[taxels] = 0
        for of_contact in (self.peak, self.contact_s):
            of_contact[taxels] = 0
