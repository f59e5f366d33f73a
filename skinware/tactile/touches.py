"""Judge which taxels are touched, which are held because they are near a contact, and when a contact is over."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from skinware.tactile.rest import Rest
from skinware.tactile.rule import (
    DRIFT_PER_MIN,
    ENDING_SHARE,
    EPSILON,
    JUST_TOUCHED,
    LEVEL_FALLS_S,
    LEVEL_RISES_S,
    OFF_TO_ON,
    QUIET_TO_TYPICAL,
    SAG_RETURNS_S,
    STEPS_OF_A_TOUCH,
    TINY,
    BaselineSettings,
)

Floats = npt.NDArray[np.float32]
Flags = npt.NDArray[np.bool_]


class Thresholds:
    """The levels at which touches of n taxels begin and end, in the unit of the values.

    Args:
        n: number of taxels.
        resolution: step of the values; 0 if they have none.

    Attributes:
        minimum_on: the least of ``on``.
        on: (n,) float32, a touch begins above it.
        off: (n,) float32, and ends below it.
    """

    def __init__(self, n: int, resolution: float) -> None:
        self._resolution = resolution
        self.minimum_on = 0.0
        self.on: Floats = np.zeros(n, np.float32)
        self.off: Floats = np.zeros(n, np.float32)

    def set(self, rest: Rest, settings: BaselineSettings) -> None:
        """Compute them from the noise of the taxels."""
        given = settings.minimum_on
        self.minimum_on = STEPS_OF_A_TOUCH * self._resolution if given is None else given
        known = rest.noise[rest.ready]
        typical = float(np.nanmedian(known)) if np.isfinite(known).any() else 0.0
        rounding = self._resolution / math.sqrt(12)
        least = np.maximum(rounding, QUIET_TO_TYPICAL * typical)
        noise = np.fmax(rest.noise, np.fmax(least, EPSILON * np.abs(rest.level)))
        self.on = np.fmax(self.minimum_on, settings.on_sigma * noise + TINY).astype(np.float32)
        self.off = np.fmax(OFF_TO_ON * self.minimum_on, settings.off_sigma * noise).astype(np.float32)


class Touches:
    """Follows touches of n taxels.

    Args:
        module: (n,) int, the module of each taxel: its taxels sag and settle together.
        neighbours: (n, k) int, the taxels near each, filled with -1: they are held with it, instead of its module.

    Attributes:
        touched: (n,) bool.
        level: (n,) float32, the load of each taxel during the contact of its module, slowly followed.
        contact_s: (n,) float32, how long each has been touched.
        sunk: (n,) float32, how far below its baseline each has been during the contact of its module: it comes back.
        settling_s: (n,) float32, for how long each is still held.
    """

    def __init__(self, module: npt.NDArray[np.intp], neighbours: npt.NDArray[np.integer] | None = None) -> None:
        n = len(module)
        self._module = module
        self._neighbours = neighbours
        self._n_modules = int(module.max(initial=-1)) + 1
        self.touched: Flags = np.zeros(n, bool)
        self.level: Floats = np.zeros(n, np.float32)
        self.contact_s: Floats = np.zeros(n, np.float32)
        self.sunk: Floats = np.zeros(n, np.float32)
        self.settling_s: Floats = np.zeros(n, np.float32)
        self._ending: Flags = np.zeros(n, bool)
        self._fading_s = np.zeros(self._n_modules)
        """For how long most of the load of each module has been gone."""
        self._ended_s = np.full(self._n_modules, np.inf)
        """For how long no taxel of each module has been touched."""

    def judge(self, load: Floats, usable: Flags, thresholds: Thresholds) -> None:
        """Find the touched taxels: above ``on``, or still above ``off``; unusable ones stay as they are."""
        above = load > np.where(self.touched, thresholds.off, thresholds.on)
        ended = self.touched & ~above & usable
        if ended.any():
            self.touched[ended] = False
            self.contact_s[ended] = 0
        self.touched |= above & usable

    def hold(self, usable: Flags, passed_s: float, settle_s: float) -> Flags:
        """Return (n,) the taxels that keep their own baselines: near a contact, and for ``settle_s`` after it."""
        np.maximum(self.settling_s - np.float32(passed_s), 0, out=self.settling_s)
        active = np.flatnonzero(self.touched & usable)
        if not len(active):
            held: Flags = self.settling_s > 0
            return held
        if self._neighbours is None:
            touched_modules = np.zeros(self._n_modules, bool)
            touched_modules[self._module[active]] = True
            near = touched_modules[self._module]
        else:
            around = self._neighbours[active].ravel()
            near = np.zeros(len(self.touched), bool)
            near[around[around >= 0]] = True
            near[active] = True
        self.settling_s[near] = settle_s
        return near | (self.settling_s > 0)

    def over(
        self, load: Floats, usable: Flags, on: Floats, passed_s: float, settings: BaselineSettings
    ) -> npt.NDArray[np.intp]:
        """Follow the load of contacts, and end those of which most is gone.

        Args:
            load: (n,) above the baselines.
            usable: (n,) which taxels have values.
            on: (n,) threshold of touch.
            passed_s: since the last frame.
            settings: for release and drift.

        Returns:
            The taxels whose remaining load counts as drift, in modules whose contact is over.
        """
        active = np.flatnonzero(usable & (self.touched | (self.level > 0)))
        if not len(active):
            return active
        touched, module = self.touched[active], self._module[active]
        self._ended_s += passed_s
        self._ended_s[module[touched]] = 0
        in_contact = self._ended_s < SAG_RETURNS_S
        self.contact_s[active] += np.float32(passed_s) * touched
        now, level = np.where(touched, load[active], np.float32(0)), self.level[active]
        rise, fall = (np.float32(-math.expm1(-passed_s / tau)) for tau in (LEVEL_RISES_S, LEVEL_FALLS_S))
        level = (level + (now - level) * np.where(now > level, rise, fall)) * in_contact[module]
        self.level[active] = level
        self.sunk = np.maximum(self.sunk, -load) * in_contact[self._module]
        left, whole = (np.bincount(module, level * of, self._n_modules) for of in (now, level))
        fading = left < settings.release * whole
        self._fading_s = np.where(fading, self._fading_s + passed_s, 0)
        released = self._fading_s >= settings.release_s
        too_long = self.touched & (self.contact_s > (settings.maximum_hold_s or math.inf))
        if not released.any() and not too_long.any():
            return active[:0]
        self._fading_s[released] = 0
        own = settings.drift_max_per_min
        per_min = DRIFT_PER_MIN * on if own is None else np.float32(own)
        is_drift = load < JUST_TOUCHED * on + per_min * (self.contact_s / 60) + self.sunk
        let_go = (released[self._module] & usable & is_drift) | (too_long & usable)
        self._end(let_go)
        return np.flatnonzero(let_go)

    def shown(self, load: Floats, smooth_load: Floats, off: Floats) -> Flags:
        """Return (n,) the touched taxels, without those whose present load is gone while the smoothed one is not."""
        ending = load < np.where(self._ending, off, np.minimum(off, ENDING_SHARE * smooth_load))
        self._ending = ending & self.touched
        return self.touched & ~self._ending

    def forget(self, taxels: Flags) -> None:
        """Drop the contacts of some taxels."""
        self._end(taxels)
        self.settling_s[taxels] = 0

    def _end(self, taxels: Flags) -> None:
        self.touched[taxels] = False
        for of_contact in (self.level, self.contact_s, self.sunk):
            of_contact[taxels] = 0
