"""Which taxels are touched, which are held because they are near a contact, and when a contact is over."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from skinware.tactile.calm import BaselineSettings

_LEVEL_RISES_S, _LEVEL_FALLS_S = 2.0, 20.0
"""Of the level that a contact is held at: a bump of a moment must not raise it, a weaker grip may become the rule."""
_COMES_BACK_S = 0.3
"""What sagged comes back a little after the touch has ended, and belongs to it."""
_DRIFT_PER_MIN = np.float32(0.25)
"""Of a threshold: as much as a baseline drifts on its own in a minute. More of it makes an eased grip vanish."""
_JUST_TOUCHED = np.float32(1.25)
"""Times the threshold: so much a taxel that drifted beyond it a moment ago may show."""


class Touches:
    """Follows touches of n taxels.

    Args:
        module: (n,) int, the module of each taxel: what sags and settles together.
        neighbours: (n, k) int, the taxels near each, filled with -1: they are held with it, instead of its module.

    Attributes:
        touched: (n,) bool.
        level: (n,) float32, what the load of each taxel has been in the contact that its module has.
        contact_s: (n,) float32, how long each has been touched.
        sunk: (n,) float32, how far below its baseline each has been during the contact of its module: what sags comes
            back.
        settling_s: (n,) float32, for how long each is still held.
        fading_s: (n_modules,) float64, for how long most of the load of each module has been gone.
        ended_s: (n_modules,) float64, for how long none of its taxels has been touched.
    """

    def __init__(self, module: npt.NDArray[np.intp], neighbours: npt.NDArray[np.integer] | None = None) -> None:
        n = len(module)
        self._module = module
        self._neighbours = neighbours
        self._n_modules = int(module.max(initial=-1)) + 1
        self.touched: npt.NDArray[np.bool_] = np.zeros(n, bool)
        self.level: npt.NDArray[np.float32] = np.zeros(n, np.float32)
        self.contact_s: npt.NDArray[np.float32] = np.zeros(n, np.float32)
        self.sunk: npt.NDArray[np.float32] = np.zeros(n, np.float32)
        self.settling_s: npt.NDArray[np.float32] = np.zeros(n, np.float32)
        self.fading_s: npt.NDArray[np.float64] = np.zeros(self._n_modules)
        self.ended_s: npt.NDArray[np.float64] = np.full(self._n_modules, np.inf)

    def judge(
        self,
        load: npt.NDArray[np.float32],
        usable: npt.NDArray[np.bool_],
        on: npt.NDArray[np.float32],
        off: npt.NDArray[np.float32],
    ) -> None:
        """Which are touched: above ``on``, or still above ``off``; unusable ones stay as they are."""
        above = load > np.where(self.touched, off, on)
        ended = self.touched & ~above & usable
        if ended.any():
            self.touched[ended] = False
            self.contact_s[ended] = 0
        self.touched |= above & usable

    def hold(self, usable: npt.NDArray[np.bool_], passed_s: float, settle_s: float) -> npt.NDArray[np.bool_]:
        """(n,) which taxels keep their own baselines: those near a contact, and for ``settle_s`` after it."""
        np.maximum(self.settling_s - np.float32(passed_s), 0, out=self.settling_s)
        active = np.flatnonzero(self.touched & usable)
        if not len(active):
            held: npt.NDArray[np.bool_] = self.settling_s > 0
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
        self,
        load: npt.NDArray[np.float32],
        usable: npt.NDArray[np.bool_],
        on: npt.NDArray[np.float32],
        passed_s: float,
        settings: BaselineSettings,
    ) -> npt.NDArray[np.intp]:
        """Follow the load of contacts; the taxels whose remainder is drift, in modules that are let go.

        Args:
            load: (n,) above the baselines.
            usable: (n,) which taxels have values.
            on: (n,) threshold of touch.
            passed_s: since the last frame.
            settings: for release and drift.
        """
        active = np.flatnonzero(usable & (self.touched | (self.level > 0)))
        if not len(active):
            return active
        touched, module = self.touched[active], self._module[active]
        self.ended_s += passed_s
        self.ended_s[module[touched]] = 0
        in_contact = self.ended_s < _COMES_BACK_S
        self.contact_s[active] += np.float32(passed_s) * touched
        now, level = np.where(touched, load[active], np.float32(0)), self.level[active]
        rise, fall = (np.float32(-math.expm1(-passed_s / tau)) for tau in (_LEVEL_RISES_S, _LEVEL_FALLS_S))
        level = (level + (now - level) * np.where(now > level, rise, fall)) * in_contact[module]
        self.level[active] = level
        self.sunk = np.maximum(self.sunk, -load) * in_contact[self._module]
        left, whole = (np.bincount(module, level * of, self._n_modules) for of in (now, level))
        fading = left < settings.release * whole
        self.fading_s = np.where(fading, self.fading_s + passed_s, 0)
        released = self.fading_s >= settings.release_s
        too_long = self.touched & (self.contact_s > (settings.maximum_hold_s or math.inf))
        if not released.any() and not too_long.any():
            return active[:0]
        self.fading_s[released] = 0
        own = settings.drift_max_per_min
        per_min = _DRIFT_PER_MIN * on if own is None else np.float32(own)
        is_drift = load < _JUST_TOUCHED * on + per_min * (self.contact_s / 60) + self.sunk
        let_go = (released[self._module] & usable & is_drift) | (too_long & usable)
        self._end(let_go)
        return np.flatnonzero(let_go)

    def forget(self, taxels: npt.NDArray[np.bool_]) -> None:
        """Their contacts have never been."""
        self._end(taxels)
        self.settling_s[taxels] = 0

    def _end(self, taxels: npt.NDArray[np.bool_]) -> None:
        self.touched[taxels] = False
        for of_contact in (self.level, self.contact_s, self.sunk):
            of_contact[taxels] = 0
