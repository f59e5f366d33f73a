"""Take a uniform field off the values of arrays of three-axis taxels: what ``skinware/native/field.c`` does, in numpy.

A value is level + response * field + load + noise. The field is where most taxels of an array agree: those at rest, or
else those whose loads stay as they are.
"""

from __future__ import annotations

import math
from enum import IntEnum

import numpy as np
import numpy.typing as npt

Doubles = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

LEAST_ARRAY = 4
FAR = 16.0  # square of the standard deviations beyond which something else moves a taxel
LOADED = 4.0  # the same, by which a load has to explain a value better than rest does
SURE = 4.0  # variances of the noise beyond which a taxel at rest says nothing
ENOUGH = 0.4  # share of the taxels that have to agree on a field that was searched
ROUNDS, MOST_STARTS = 4, 8
BEGIN_FRAMES, BEGIN_S = 20, 5.0
MOVED = 25.0  # variances of the noise by which a field has to move to teach
LOAD_S, SPEED_S, MEAN_S, COAST_S, LASTS_S = 1.0, 0.1, 10.0, 0.3, 3600.0
NOISE_S = 60.0
DRIFTS = 5e-5  # variances of the noise that a level gains in a second
FORGET_AFTER_S = 600.0
TINY = float(np.float32(1e-12))


class State(IntEnum):
    """The explanation of a taxel's value in a frame: rest, a steady load, or something else."""

    NONE, REST, STEADY, ELSE = range(4)


def passed_share(passed_s: float, constant_s: float) -> float:
    return -math.expm1(-passed_s / constant_s)


def squares(vectors: Doubles) -> Doubles:
    found: Doubles = (vectors**2).sum(axis=-1)
    return found


class _Array:
    """A rigid array of n taxels, and all that is known of it."""

    def __init__(self, n: int, spread: float) -> None:
        self.n, self.spread2 = n, spread**2
        self.field, self.speed, self.taught_at = np.zeros((3, 3))
        self.speed2 = self.jump2 = self.doubt2 = self.lost_s = 0.0
        self.frames = 0
        self.response, self.covariance = np.zeros((n, 4, 3)), np.zeros((n, 4, 4))
        self.noise2, self.age_s, self.variance, self.known2, self.cost = np.zeros((5, n))
        self.away_s = np.full(n, np.inf)
        self.taken, self.load_frames = np.zeros((2, n), int)
        self.load, self.rest = np.zeros((2, n, 3))
        self.state = np.zeros(n, int)

    @property
    def live(self) -> Flags:
        live: Flags = self.state != State.NONE
        return live

    @property
    def explained(self) -> Flags:
        explained: Flags = (self.state == State.REST) | (self.state == State.STEADY)
        return explained

    def at_rest(self) -> int:
        return int((self.state == State.REST).sum())

    def agree(self) -> int:
        return int(self.explained.sum())

    def update(self, values: Doubles, usable: Flags, passed_s: float) -> None:
        if passed_s >= 1:
            self.speed[:] = 0
        self.away_s += passed_s
        self.state[:] = np.where(usable, State.ELSE, State.NONE)
        self._begin(np.flatnonzero(usable & ~(self.away_s < FORGET_AFTER_S)), values)
        self.away_s[usable] = 0
        self.frames += 1
        typical2 = float(self.noise2.mean())
        self.known2 = np.maximum(self.noise2, typical2)
        if self.live.any():
            self._step(values, passed_s, typical2)

    def bears(self) -> tuple[Flags, Flags]:
        """Which taxels bear a load, and which values are sure."""
        doubt2 = self.variance + self.doubt2
        is_far, has_begun = squares(self.rest) > FAR * (doubt2 + self.known2), self.taken > BEGIN_FRAMES
        sure = self.live & has_begun
        sure &= (is_far & (self.age_s > BEGIN_S)) | (doubt2 < SURE * self.known2)
        return is_far & has_begun & self.live, sure

    def _begin(self, rows: npt.NDArray[np.intp], values: Doubles) -> None:
        self.response[rows], self.covariance[rows], self.load[rows] = np.eye(4, 3), 0, 0
        self.covariance[rows[:, None], range(3), range(3)] = self.spread2
        self.noise2[rows] = TINY**2
        self.taken[rows] = self.age_s[rows] = self.load_frames[rows] = 0
        self._set_level(rows, values, self.field)

    def _compare(self, values: Doubles, field: Doubles, rows: npt.NDArray[np.intp] | None = None) -> None:
        """Find what is left of values without level and field, and how uncertain that is beside the noise."""
        at = np.arange(self.n)[self.live] if rows is None else rows
        u = np.append(field, 1)
        self.rest[at] = values[at] - u @ self.response[at]
        self.variance[at] = self.covariance[at] @ u @ u

    def _set_level(self, rows: npt.NDArray[np.intp], values: Doubles, field: Doubles) -> None:
        """Take present values for levels; the error of a response is also in its level."""
        self._compare(values, field, rows)
        self.response[rows, 3] += self.rest[rows]
        p = self.covariance
        towards = -p[rows, :3, :3] @ field
        p[rows, :3, 3] = p[rows, 3, :3] = towards
        p[rows, 3, 3] = self.noise2[rows] - towards @ field

    def _judge(self, values: Doubles, field: Doubles) -> float:
        """Compare all taxels with a field, and return how badly it explains them."""
        self._compare(values, field)
        rows = np.flatnonzero(self.live)
        rest, count, noise2 = self.rest[rows], self.load_frames[rows], self.known2[rows]
        known2 = noise2 + self.variance[rows]
        of_rest = np.where(self.taken[rows] < BEGIN_FRAMES, 0, squares(rest) / known2)
        steady = LOADED + squares(rest - self.load[rows]) / (known2 + noise2 / (count + 1))
        of_steady = np.where(count > 0, steady, np.inf)
        self.cost[rows] = cost = np.minimum(of_rest, of_steady)
        explained = np.where(of_rest <= of_steady, State.REST, State.STEADY)
        self.state[rows] = np.where(cost >= FAR, State.ELSE, explained)
        return float(np.minimum(cost, FAR).sum())

    def _fit(self, values: Doubles, field: Doubles) -> Doubles:
        """Improve a field by the taxels that it explains."""
        self._judge(values, field)
        for _ in range(ROUNDS):
            rows = np.flatnonzero(self.explained)
            weight = (1 - self.cost[rows] / FAR) ** 2 / (self.known2[rows] + self.variance[rows])
            off = self.rest[rows] - self.load[rows] * (self.state[rows] == State.STEADY)[:, None]
            if weight.sum() > 0:
                field = field + weight @ off / weight.sum()
            self._judge(values, field)
        return field

    def _search(self, values: Doubles, field: Doubles) -> Doubles:
        """Search a field that explains more than one nearby does: one of those that explain a single taxel."""
        step = 1 + (self.n - 1) // MOST_STARTS
        best, least = field, self._judge(values, field)
        for one in range(self.frames % step, self.n, step):
            for load in (np.zeros(3), self.load[one]) if self.live[one] else ():
                start = field
                for _ in range(2):
                    self._compare(values, start, np.array([one]))
                    start = start + self.rest[one] - load
                total = self._judge(values, start)
                if total < least:
                    best, least = start, total
        return self._fit(values, best)

    def _find(self, values: Doubles, passed_s: float) -> tuple[bool, Doubles]:
        """Find the field of this frame; where too few taxels agree, it goes on as before. Return whether they do."""
        live, late = int(self.live.sum()), 1 + self.lost_s / COAST_S
        expected = self.field + self.speed * passed_s
        field = self._fit(values, expected)
        found = self.agree() >= 2 and 2 * self.agree() >= live
        if (not found or 2 * self.at_rest() < live) and live > 2:
            field = self._search(values, field)
            found = self.agree() >= 3 and self.agree() >= ENOUGH * live
        jump2 = float(squares(field - expected))
        if found and 2 * self.at_rest() < live:  # loads that grow alike look like a field, but for its inertia
            found = jump2 < FAR * self.jump2 * late**2
        elif found:
            least2 = float(self.noise2.mean())
            share = passed_share(passed_s, MEAN_S)
            self.jump2 += (min(jump2, FAR * self.jump2 + least2) - self.jump2) * share
        if found:
            return True, field
        self._judge(values, expected)
        self.state[self.live] = State.ELSE
        return False, expected

    def _follow_field(self, field: Doubles, found: bool, passed_s: float, typical2: float) -> bool:
        """Go on to the field of this frame; return whether it is far enough from where responses were learned last."""
        share, keep = (passed_share(passed_s, SPEED_S), 1.0) if found else (0.0, math.exp(-passed_s / COAST_S))
        speed = (field - self.field) / passed_s if passed_s > 0 else np.zeros(3)
        self.speed = keep * (self.speed + share * (speed - self.speed))
        self.field = field.copy()
        if found:
            self.speed2 += (float(squares(self.speed)) / 3 - self.speed2) * passed_share(passed_s, MEAN_S)
        else:
            self.doubt2 += self.speed2 * (2 * self.lost_s + passed_s) * passed_s
        self.lost_s = 0.0 if found else self.lost_s + passed_s
        at_rest = self.at_rest()
        if at_rest >= 2 and 2 * at_rest >= self.live.sum():
            self.doubt2 = 0.0
        if not found or squares(field - self.taught_at) < MOVED * typical2:
            return False
        self.taught_at = field.copy()
        return True

    def _step(self, values: Doubles, passed_s: float, typical2: float) -> None:
        found, field = self._find(values, passed_s)
        has_moved = self._follow_field(field, found, passed_s, typical2)
        doubt2 = float(self.variance[self.live].mean())
        live = np.flatnonzero(self.live)
        most_rest = 2 * self.at_rest() >= len(live)
        change = self.rest - self.load
        self.age_s[live] += passed_s
        self.taken[live] += 1
        beginning = live[self.taken[live] <= BEGIN_FRAMES]
        later = beginning[self.taken[beginning] > 1]
        self._follow_noise(later, squares(change[later]) / 2, 1 / np.maximum(self.taken[later] - 1, 1))
        at_rest = live[(self.taken[live] > BEGIN_FRAMES) & (self.state[live] == State.REST) & most_rest]
        of_noise = self.known2[at_rest] / (self.known2[at_rest] + self.variance[at_rest])
        share = min(passed_s / NOISE_S, 1)
        self._follow_noise(at_rest, squares(self.rest[at_rest]) * of_noise, np.full(len(at_rest), share))
        self._teach(at_rest, field, doubt2, has_moved)
        self._set_level(live[self.taken[live] == BEGIN_FRAMES], values, field)
        covered = live[(self.state[live] == State.STEADY) & most_rest & (self.age_s[live] < BEGIN_S)]
        self._set_level(covered, values, field)
        self._follow_load(np.setdiff1d(live, covered), passed_s)
        diagonal = self.covariance[live[:, None], range(3), range(3)]
        diagonal += np.maximum(self.spread2 - diagonal, 0) * passed_s / LASTS_S
        self.covariance[live[:, None], range(3), range(3)] = diagonal
        self.covariance[live, 3, 3] += DRIFTS * self.noise2[live] * passed_s

    def _follow_noise(self, rows: npt.NDArray[np.intp], squares_of_all: Doubles, share: Doubles) -> None:
        live = int(self.live.sum())
        others = max(live - 1, 1) / max(live, 1)  # a taxel pulls the field to itself
        self.noise2[rows] += (squares_of_all / 3 / others - self.noise2[rows]) * share

    def _teach(self, rows: npt.NDArray[np.intp], field: Doubles, doubt2: float, has_moved: bool) -> None:
        """Learn levels of taxels at rest, and responses while the field moves, by recursive least squares."""
        u, p = np.append(field, 1), self.covariance[rows]
        total = self.known2[rows] + self.variance[rows] + doubt2
        towards = p @ u
        learned = np.arange(4) >= (0 if has_moved else 3)
        gain = towards / total[:, None] * learned
        self.response[rows] += gain[:, :, None] * self.rest[rows][:, None]
        either = learned[:, None] | learned
        self.covariance[rows] -= either * towards[:, :, None] * towards[:, None] / total[:, None, None]

    def _follow_load(self, rows: npt.NDArray[np.intp], passed_s: float) -> None:
        """Follow what else is in a value: steady loads are averaged, others are new in each frame."""
        steady = self.state[rows] == State.STEADY
        share = np.maximum(1 / (self.load_frames[rows] + 1), min(passed_s / LOAD_S, 1))
        share = np.where(steady, share, 1.0)
        self.load[rows] += (self.rest[rows] - self.load[rows]) * share[:, None]
        self.load_frames[rows] = np.where(steady, self.load_frames[rows] + 1, self.state[rows] == State.ELSE)


class SpecifiedField:
    """The specification of :class:`skinware.tactile.vectors.ArrayField`."""

    def __init__(self, patch: npt.NDArray[np.integer], spread: float) -> None:
        starts = np.flatnonzero(np.diff(patch, prepend=-1))
        ends = np.append(starts[1:], len(patch))
        self._runs = [slice(a, b) for a, b in zip(starts, ends, strict=True) if b - a >= LEAST_ARRAY]
        self._arrays = [_Array(run.stop - run.start, spread) for run in self._runs]
        self.bears: Flags = np.zeros(len(patch), bool)

    @property
    def now(self) -> Doubles:
        return np.array([array.field for array in self._arrays]).reshape(-1, 3)

    def update(
        self, values: npt.NDArray[np.float32], usable: Flags, passed_s: float
    ) -> tuple[npt.NDArray[np.float32], Flags]:
        rest, sure = values.copy(), usable.copy()
        for run, array in zip(self._runs, self._arrays, strict=True):
            array.update(values[:, run].T.astype(np.float64), usable[run], passed_s)
            self.bears[run], sure[run] = array.bears()
            rest[:, run] = np.where(array.live[:, None], array.rest, 0).T
        return rest, sure
