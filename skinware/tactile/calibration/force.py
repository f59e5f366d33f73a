"""Fit the curves of taxels to a reference of the force on all of them: a load cell, or known weights.

The force of a taxel that shows x is f(x) + lag · (p - x) + creep · q + temperature · x · (T - at): f rises in straight
pieces, p follows x with play, which separates rising from falling loads, q is x through a low pass, for creep.
All of it is linear but play and time constant, which are tried; the reference is the sum over the taxels. Each taxel
has a gain, near 1 unless its own presses say otherwise.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from skinware.errors import ConfigurationError
from skinware.tactile.arrays import Doubles, Flags
from skinware.tactile.curves import MOST_KNOTS, Curve, LoadMemory

_PLAYS = (0.05, 0.1, 0.2, 0.4)  # shares of the range that are tried as play
_CREEPS_S = (3.0, 10.0, 30.0, 100.0)
_PARTS = 10  # parts of the frames that are left out in turn, for the uncertainty
_GAIN_SPREAD = 0.3
_LEAST_GAIN = 0.1  # taxels that are always pressed together may have any gains that fit, even below 0
_ROUNDS = 4
_LEAST_FRAMES = 200
_FEW_PRESSES, _APART_S = 8, 0.3  # presses that a fit needs to be trusted, and seconds without any load between two
_LEAST_WARMTH_K = 2.0  # kelvin by which the temperature must change, or its influence is not known
_LEAST_SHARE = 0.1
_POOR = 0.1  # share of the largest force: a larger residual makes a fit worth little


@dataclass(frozen=True)
class ForceData:
    """m samples of n taxels with a reference.

    Attributes:
        time_s: (m,) rising.
        load: (m, n) calmed values, 0: untouched.
        force_n, temperature_c: (m,) the reference, N, and the temperature of the skin; NaN: not known.
    """

    time_s: Doubles
    load: Doubles
    force_n: Doubles
    temperature_c: Doubles


@dataclass(frozen=True)
class ForceFit:
    """Fitted curves of n taxels.

    Attributes:
        curve: the curve of a taxel whose gain is 1.
        gain: (n,) of each; NaN: it was not pressed.
        residual_n: root of the mean square of the errors in samples that the fit had not seen, N.
        reach_n: the largest force of the reference, N.
        hysteresis: the largest part of the range by which rising and falling load differ.
        held: share of the samples, unseen by the fit, whose error is within 1.96 standard deviations.
        presses: number of presses that were apart in time.
    """

    curve: Curve
    gain: Doubles
    residual_n: float
    reach_n: float
    hysteresis: float
    held: float
    presses: int

    @property
    def doubts(self) -> list[str]:
        """Reasons why the fit is not trustworthy; none: it is."""
        doubts = []
        if self.residual_n > _POOR * self.reach_n:
            doubts.append(f"it misses the reference by {100 * self.residual_n / self.reach_n:.0f} % of its range")
        if not 0.9 <= self.held <= 0.98:
            doubts.append(f"its intervals hold {100 * self.held:.0f} % instead of 95 %")
        if self.presses < _FEW_PRESSES:
            doubts.append(f"{self.presses} presses do not show its errors, nor how they differ: give {_FEW_PRESSES}")
        return doubts

    def curves(self, uid: npt.NDArray[np.uint64]) -> tuple[Curve, ...]:
        """Return the curves of n taxels; those that were not pressed share the one with gain 1."""
        own = [self.curve.scaled(float(self.gain[k]), (int(uid[k]),)) for k in np.flatnonzero(np.isfinite(self.gain))]
        return (self.curve, *own)


def fit_force(data: ForceData, type_name: str = "pressure", from_unit: str = "counts") -> ForceFit:
    """Fit curves in N to samples with a reference: loads that rise, rest and fall, over the wanted range.

    Raises:
        ConfigurationError: too few samples with a load, or loads that do not vary.
    """
    pressed = np.flatnonzero((data.load > 0).any(axis=0))
    used = np.isfinite(data.force_n) & (data.load > 0).any(axis=1)
    if used.sum() < _LEAST_FRAMES or np.ptp(data.force_n[used]) <= 0:
        raise ConfigurationError(f"{used.sum()} frames with a load: give {_LEAST_FRAMES}, with forces that vary")
    load = data.load[:, pressed]
    knots = np.unique(np.append(0, np.quantile(load[load > 0], np.linspace(0, 1, MOST_KNOTS)[1:])))
    warm = np.ptp(data.temperature_c[used]) >= _LEAST_WARMTH_K  # NaN: not known
    at_c = float(np.mean(data.temperature_c[used])) if warm else 25.0
    plays = [play * float(knots[-1]) for play in _PLAYS]
    lags, slow = zip(
        *(_lived(data.time_s, load, *one)[:, used] for one in zip(plays, _CREEPS_S, strict=True)), strict=True
    )
    load = load[used]
    rising = [np.clip(load - low, 0, high - low) for low, high in itertools.pairwise(knots)]
    by_warmth = load * np.nan_to_num(data.temperature_c[used] - at_c)[:, None] * bool(warm)
    problems = [
        _Trial(data.force_n[used], np.array([*rising, lag * (load > 0), late * (load > 0), by_warmth]), play, creep_s)
        for (play, lag), (creep_s, late) in itertools.product(
            zip(plays, lags, strict=True), zip(_CREEPS_S, slow, strict=True)
        )
    ]
    ones = np.ones(len(pressed))
    best = min(problems, key=lambda problem: problem.cost(problem.weights(ones), ones))
    gain, weights = best.solve(best.every)
    presses = 1 + int((np.diff(data.time_s[used]) > _APART_S).sum())
    error, residual, held = _errors(best, presses)
    reach, y = float(data.force_n[used].max()), np.append(0, np.cumsum(weights[: len(knots) - 1] * np.diff(knots)))
    lag, creep, warmth = weights[len(knots) - 1 :]
    curve = Curve(
        type=type_name,
        from_unit=from_unit,
        unit="N",
        x=tuple(knots.tolist()),
        y=tuple(y.tolist()),
        play=best.play,
        lag=float(lag),
        creep_s=best.creep_s,
        creep=float(creep),
        temperature=float(warmth),
        at_c=at_c,
        error=error,
        hysteresis=min(2 * best.play * abs(float(lag)) / float(y[-1]), 1.0) if y[-1] > 0 else None,
    )
    of_all = np.full(data.load.shape[1], np.nan)
    of_all[pressed] = gain
    return ForceFit(curve, of_all, residual, reach, curve.hysteresis or 0.0, held, presses)


def _lived(time_s: Doubles, load: Doubles, play: float, creep_s: float) -> Doubles:
    """(2, m, n): the past of taxels, as a curve needs it."""
    memory, lived = LoadMemory(load.shape[1]), np.zeros((2, *load.shape))
    for row, passed_s in enumerate(np.diff(time_s, prepend=time_s[0]).tolist()):
        lived[:, row] = memory.step(load[row], passed_s, play, creep_s)
    return lived


@dataclass(frozen=True, eq=False)
class _Trial:
    """Linear terms (terms, samples, taxels) of the samples that count, for one play and one time constant."""

    force_n: Doubles
    terms: Doubles
    play: float
    creep_s: float

    @property
    def every(self) -> Flags:
        return np.ones(len(self.force_n), bool)

    def weights(self, gain: Doubles, rows: Flags | None = None) -> Doubles:
        """The weights of the terms, those of the curve at least 0, by least squares."""
        rows = self.every if rows is None else rows
        matrix = (self.terms[:, rows] @ gain).T
        free = np.linalg.norm(matrix, axis=0) > 0
        while True:
            found = np.zeros(len(free))
            found[free] = np.linalg.lstsq(matrix[:, free], self.force_n[rows], rcond=None)[0]
            falling = (found < 0) & (np.arange(len(free)) < len(free) - 3)
            if not falling.any():
                return found
            free &= ~falling

    def cost(self, weights: Doubles, gain: Doubles) -> float:
        return float(((self.force_n - self.forces(weights, gain)) ** 2).sum())

    def forces(self, weights: Doubles, gain: Doubles) -> Doubles:
        forces: Doubles = np.tensordot(weights, self.terms, 1) @ gain
        return forces

    def solve(self, rows: Flags) -> tuple[Doubles, Doubles]:
        """Gains of the taxels, and weights, by turns."""
        gain = np.ones(self.terms.shape[2])
        weights = self.weights(gain, rows)
        for _ in range(_ROUNDS if len(gain) > 1 else 0):
            each = np.tensordot(weights, self.terms[:, rows], 1)
            left = self.force_n[rows] - each @ gain
            ridge = float((left**2).mean()) / _GAIN_SPREAD**2 * np.eye(len(gain))
            gain = np.linalg.solve(each.T @ each + ridge, each.T @ self.force_n[rows] + ridge.sum(axis=1))
            gain = np.clip(gain, _LEAST_GAIN, 1 / _LEAST_GAIN)
            weights = self.weights(gain, rows)
        return gain, weights


def _errors(problem: _Trial, presses: int) -> tuple[tuple[float, float], float, float]:
    """Standard deviation of a taxel at 0 N and its growth with the force; the whole residual; the share that it holds.

    All is of samples that the fit had not seen: each tenth of them in turn, half of which scale the deviations.
    Deviations of the taxels of a contact add up to the deviation of its force.
    """
    left, expected = (np.zeros_like(problem.force_n) for _ in range(2))
    part = np.arange(len(left)) * _PARTS // len(left)
    for number in range(_PARTS):
        rows = part == number
        gain, weights = problem.solve(~rows)
        expected[rows] = np.maximum(problem.forces(weights, gain)[rows], 0)
    left = np.abs(problem.force_n - expected)
    number = (problem.terms[0] > 0).sum(axis=1)
    terms = np.column_stack([number, expected])
    slopes = np.maximum(np.linalg.lstsq(terms, left, rcond=None)[0], 0)
    slopes[0] = max(slopes[0], _LEAST_SHARE * float(left.mean() / number.mean()))
    deviation = terms @ slopes
    level = min(0.95 + math.sqrt(0.05 * 0.95 / presses) / 2, 0.99)  # the fewer presses, the less sure is a quantile
    scale = float(np.quantile(left[::2] / deviation[::2], level)) / 1.96
    held = float((left[1::2] <= 1.96 * scale * deviation[1::2]).mean())
    return (scale * float(slopes[0]), scale * float(slopes[1])), float(np.sqrt((left**2).mean())), held
