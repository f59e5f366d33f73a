"""Take off what the temperature of its module does to each taxel, as far as sensors of the module measure it.

The stage works before the baselines. It follows the temperature also where a grip covers a whole patch, and no taxel is
left to measure a common drift. docs/tactile/baselines.md has the formulas.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from skinware.errors import ConfigurationError
from skinware.tactile.arrays import Doubles, check_state
from skinware.tactile.curves import TEMPERATURE
from skinware.tactile.stages import Positive, Signal, Stage, StageSettings, Taxels

WINDOW_S = 5.0
"""Seconds over which values and temperatures are averaged: drift of that time counts, noise and touches hardly do."""
SMOOTH_S = 0.5
"""Time constant of the temperatures in seconds: skins do not warm up faster."""
GAIN_LASTS_S = 604800.0
"""Seconds, a week, in which a known gain becomes as uncertain as at the start: skins age."""
_MEDIAN2 = 0.455  # median of the square of a standard normal deviate


class ThermalSettings(StageSettings, frozen=True, kw_only=True, tag="thermal"):
    """Settings of the influence of the temperature that sensors of type ``temperature`` measure in the same modules.

    Attributes:
        spread: largest usual change of a taxel with a unit of the temperature, in the unit of the taxel.
    """

    spread: Positive = 1.0

    def stage(self, taxels: Taxels, pads: Taxels) -> Stage:
        if not np.isin(taxels.module, pads.module).any():
            raise ConfigurationError(f"no module with {taxels.type.name} has a sensor of type {TEMPERATURE}")
        return ThermalStage(taxels, pads, self.spread)


class ThermalGains:
    """Learns by how much each of n taxels changes with its temperature, from one window of time to the next.

    The taxels of a patch are alike as long as nothing is known of one; before anything is known, gains have the
    standard deviation ``spread``. ``own`` is the gain by what is known of each taxel alone, ``variance`` that of it.
    """

    def __init__(self, patch: npt.NDArray[np.integer], spread: float) -> None:
        n = len(patch)
        self.gain: Doubles = np.zeros(n)
        self._patch, self._spread2 = patch, spread**2
        self.own: Doubles = np.zeros(n)
        self.variance: Doubles = np.full(n, self._spread2)
        self._noise2 = np.full(int(patch.max(initial=-1)) + 1, np.nan)
        self._noisier = np.ones(n)
        self._means = np.full((2, n), np.nan)

    def learn(self, values: Doubles, warmth: Doubles) -> None:
        """Take in the means of the next window: (n,) values and temperatures of their modules; NaN: not known."""
        means = np.array([values, warmth])
        change, warmed = means - self._means
        self._means = np.where(np.isnan(means), self._means, means)
        known = np.isfinite(change) & np.isfinite(warmed)
        self.variance = np.minimum(self.variance + self._spread2 * WINDOW_S / GAIN_LASTS_S, self._spread2)
        found = np.where(known, change - self.own * warmed, 0.0)
        warmed = np.where(known, warmed, 0.0)
        for patch in np.unique(self._patch[known]).tolist():  # surprises of most taxels of a patch show its noise
            noise2 = np.median(found[known & (self._patch == patch)] ** 2) / _MEDIAN2
            before = noise2 if np.isnan(self._noise2[patch]) else self._noise2[patch]
            self._noise2[patch] = before + 0.3 * (noise2 - before)
        noise2 = self._noise2[self._patch] * self._noisier + 1e-12
        total = self.variance * warmed**2 + np.where(known, noise2, 1.0)
        share = self.variance * warmed / total
        self.own += share * np.clip(found, -3 * np.sqrt(total), 3 * np.sqrt(total))
        self.variance *= 1 - share * warmed
        self._noisier *= np.where(known, np.where(found**2 > _MEDIAN2 * total, 1.3, 1 / 1.3), 1.0)
        self._noisier = np.maximum(self._noisier, 1.0)
        self.share_known()

    def share_known(self) -> None:
        """Find the gains again, of all that is known of taxels and of their patches."""
        unknown = self.variance / self._spread2
        certain = np.bincount(self._patch, 1 - unknown)
        typical = np.bincount(self._patch, self.own) / np.maximum(certain, 1e-9)
        self.gain = self.own + unknown * typical[self._patch]


class ThermalStage(Stage):
    """Takes what temperatures have changed since its first sample off the values of n taxels."""

    name = "thermal"

    def __init__(self, taxels: Taxels, pads: Taxels, spread: float) -> None:
        super().__init__(taxels, pads)
        self._pads = pads
        self.gains = ThermalGains(taxels.patch, spread)
        self._n_modules = int(max(taxels.module.max(initial=-1), pads.module.max(initial=-1))) + 1
        self._warmth = np.full(self._n_modules, np.nan)
        self._drift = np.zeros(len(taxels))
        self._sums, self._warmth_sums = np.zeros((2, len(taxels))), np.zeros(self._n_modules)
        """Over a window of time: of the values of taxels and their numbers, and of the temperatures of modules."""
        self._frames, self._window_s = 0, 0.0

    def state(self) -> dict[str, Doubles]:
        warmth = self._warmth[self.taxels.module]
        own, variance = self.gains.own.copy(), self.gains.variance.copy()
        return {"drift": self._drift.copy(), "warmth": warmth, "own": own, "variance": variance}

    def restore(self, state: Mapping[str, Doubles], rows: npt.NDArray[np.integer]) -> None:
        check_state("the stage thermal", state, self.state(), rows)
        here = np.flatnonzero(rows >= 0)
        self._drift[here] = state["drift"][rows[here]]
        self._warmth[self.taxels.module[here]] = state["warmth"][rows[here]]
        self.gains.own[here], self.gains.variance[here] = state["own"][rows[here]], state["variance"][rows[here]]
        self.gains.share_known()

    def step(self, signal: Signal, *others: Signal) -> None:
        (pads,) = others
        is_first, passed_s = self._time_ns is None, self._passed_s(signal)
        self._follow(pads, 1.0 if is_first else -math.expm1(-passed_s / SMOOTH_S))
        self._collect(signal, passed_s)
        limits = self.taxels.type
        is_inside = (signal.values > limits.minimum) & (signal.values < limits.maximum)
        corrected = (signal.values - self._drift).astype(np.float32)
        np.copyto(signal.values, corrected, where=is_inside)

    def _follow(self, pads: Signal, share: float) -> None:
        usable = pads.usable.astype(np.float64)
        numbers = np.bincount(self._pads.module, usable, self._n_modules)
        sums = np.bincount(self._pads.module, np.where(pads.usable, pads.values, np.float32(0)), self._n_modules)
        now = np.divide(sums, numbers, out=self._warmth.copy(), where=numbers > 0)
        change = np.where(np.isnan(self._warmth), 0.0, (now - self._warmth) * share)
        self._warmth = np.where(np.isnan(self._warmth), now, self._warmth + change)
        self._drift += self.gains.gain * np.nan_to_num(change)[self.taxels.module]

    def _collect(self, signal: Signal, passed_s: float) -> None:
        self._sums += np.where(signal.usable, signal.values, np.float32(0)), signal.usable
        self._warmth_sums += self._warmth
        self._frames += 1
        self._window_s += passed_s
        if self._window_s < WINDOW_S:
            return
        values, counts = self._sums
        means = np.divide(values, counts, out=np.full(len(values), np.nan), where=counts > 0)
        self.gains.learn(means, (self._warmth_sums / self._frames)[self.taxels.module])
        self._sums[:], self._warmth_sums[:] = 0, 0
        self._frames, self._window_s = 0, 0.0
