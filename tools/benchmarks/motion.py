"""Motion: how well speed and direction of strokes are told, contact by contact and for a whole region.

Strokes of known paths and speeds over a flat skin of 24 x 24 taxels, with noise and drift, through a baseline. For the
region three other ways see the same frames: the way of its centre of load, tactile flow (the velocity that explains the
change of all values best), and the rule of Skinware 2.0: from the centre of what fell to that of what rose, at 5 Hz.
Where a second finger rests beside the stroke, that of the region should be their mean, weighted by force.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from skinware.tactile.baseline import Baseline, BaselineSettings
from skinware.tactile.contacts import Contacts
from skinware.tactile.motion import motion_of
from skinware.tactile.neighbours import NONE, neighbours
from skinware.tactile.testing import Gesture, Response, Stroke, World, grid
from tests.tactile.skins import placed

SIDE, RATE_HZ, TAU_S = 24, 50, 0.1
SPEEDS_M_S = (0.01, 0.02, 0.05, 0.1)
SURFACE = grid(1, SIDE, SIDE)
GEOMETRY = placed(SURFACE.position_m, normal=SURFACE.normal)
TABLE = neighbours(GEOMETRY)
ROW, COLUMN = np.divmod(np.arange(SIDE * SIDE), SIDE)
MODULE = ROW // 4 * (SIDE // 4) + COLUMN // 4
REST_S, SETTLED_S, LONGEST_S = 1.0, 0.4, 3.0
Floats = npt.NDArray[np.float64]


class Smoothed:
    """A velocity, smoothed as that of contacts is."""

    def __init__(self) -> None:
        self._velocity, self._steps = np.zeros(3), 0

    def add(self, velocity: Floats, passed_s: float) -> Floats:
        if np.isnan(velocity).any():
            self._velocity, self._steps = np.zeros(3), 0
            return velocity
        self._steps += 1
        self._velocity = self._velocity + max(1 - np.exp(-passed_s / TAU_S), 1 / self._steps) * (
            velocity - self._velocity
        )
        return self._velocity


class CentreOfLoad:
    """Where the centre of all load goes."""

    def __init__(self) -> None:
        self._before, self._smoothed = np.full(3, np.nan), Smoothed()

    def __call__(self, value: Floats, passed_s: float) -> Floats:
        total = value.sum()
        centre = value @ SURFACE.position_m / total if total > 0 else np.full(3, np.nan)
        way, self._before = centre - self._before, centre
        return self._smoothed.add(way / passed_s, passed_s)


class Flow:
    """The velocity for which the change of values is best explained by their gradient, by least squares."""

    def __init__(self) -> None:
        self._before, self._smoothed = np.zeros(len(SURFACE)), Smoothed()
        way = np.where((TABLE == NONE)[:, :, None], 0, SURFACE.position_m[TABLE] - SURFACE.position_m[:, None])[..., :2]
        self._slope = np.einsum("nij,nkj->nik", np.linalg.inv(np.einsum("nki,nkj->nij", way, way)), way)

    def __call__(self, value: Floats, passed_s: float) -> Floats:
        change, between = (value - self._before) / passed_s, (value + self._before) / 2
        self._before = value
        slope = np.einsum("nik,nk->ni", self._slope, np.where(TABLE == NONE, 0, between[TABLE] - between[:, None]))
        square = slope.T @ slope
        if np.linalg.matrix_rank(square) < 2:
            return self._smoothed.add(np.full(3, np.nan), passed_s)
        return self._smoothed.add(np.append(-np.linalg.solve(square, slope.T @ change), 0), passed_s)


class FellAndRose:
    """From the centre of what fell by more than a threshold to that of what rose, five times a second."""

    THRESHOLD, EVERY = 8.0, RATE_HZ // 5

    def __init__(self) -> None:
        self._before, self._frame, self._velocity = np.zeros(len(SURFACE)), 0, np.full(3, np.nan)

    def __call__(self, value: Floats, passed_s: float) -> Floats:
        self._frame += 1
        if self._frame % self.EVERY:
            return self._velocity
        change, self._before = value - self._before, value
        fell, rose = change < -self.THRESHOLD, change > self.THRESHOLD
        if fell.any() and rose.any():
            way = SURFACE.position_m[rose].mean(axis=0) - SURFACE.position_m[fell].mean(axis=0)
            self._velocity = way / (self.EVERY * passed_s)
        else:
            self._velocity = np.full(3, np.nan)
        return self._velocity


OTHERS: dict[str, Callable[[], Callable[[Floats, float], Floats]]] = {
    "centre of load": CentreOfLoad,
    "tactile flow": Flow,
    "fell and rose, 5 Hz": FellAndRose,
}


def strokes(seed: int, speed_m_s: float, fingers: int) -> tuple[World, list[tuple[float, float, Floats]]]:
    """A world with strokes, and when each begins and ends and its velocity."""
    random = np.random.default_rng([seed, fingers])
    response = Response(width_m=0.004, sag=0.2, remainder=0.2)
    world = World(SURFACE, seed=seed, rate_hz=RATE_HZ, noise=0.8, drift_per_min=1.0, gain_spread=0.2, response=response)
    low, high = SURFACE.position_m.min(axis=0)[:2] + 0.012, SURFACE.position_m.max(axis=0)[:2] - 0.012
    found, begin_s = [], REST_S + 0.5
    for _ in range(4):
        angle = random.uniform(0, 2 * np.pi)
        velocity = speed_m_s * np.array([np.cos(angle), np.sin(angle), 0])
        length_s = min(LONGEST_S, 0.09 / speed_m_s)
        reach = velocity[:2] * length_s
        first = random.uniform(np.maximum(low, low - reach), np.minimum(high, high - reach))
        path = np.array([[*first, 0], [*(first + reach), 0]])
        world.stroke(path, 30, begin_s, begin_s + length_s, radius_m=0.003)
        if fingers == 2:  # another one rests meanwhile, and comes and goes in between
            away = (low + high) - (first + reach / 2)
            world.push([*away, 0], 30, begin_s + 0.1, begin_s + 0.7 * length_s)
        found.append((begin_s, begin_s + length_s, velocity))
        begin_s += length_s + 1.5
    return world, found


def errors(seeds: range, speed_m_s: float, fingers: int) -> dict[str, Floats]:
    """By rule, (m, 2): error of the speed as a share of it, and of the direction in degrees; NaN: it said nothing."""
    found: dict[str, list[tuple[float, float]]] = {}
    for seed in seeds:
        world, done = strokes(seed, speed_m_s, fingers)
        baseline = Baseline(MODULE, SURFACE.patch, BaselineSettings(calibrate_s=REST_S))
        contacts = Contacts(len(SURFACE), TABLE, GEOMETRY)
        rules = {name: make() for name, make in OTHERS.items()}
        begun_ns = before_ns = 0
        for sample in world.samples(done[-1][1]):
            begun_ns = begun_ns or sample.time_ns
            time_s, passed_s = (sample.time_ns - begun_ns) / 1e9, (sample.time_ns - before_ns) / 1e9
            before_ns = sample.time_ns
            calm = baseline.update(sample.time_ns, sample.values.astype(np.float32), sample.usable)
            seen = contacts.update(calm.value, calm.touched, sample.time_ns)
            velocities = {name: rule(calm.value.astype(float), passed_s) for name, rule in rules.items()}
            velocities["region"] = motion_of({"all": slice(0, len(SURFACE))}, seen, calm.value).velocity_m_s[0]
            true = next((v for begin, end, v in done if begin + SETTLED_S < time_s < end - 0.06), None)
            if true is None:
                continue
            moving, all_of_it = (
                sum(float(one.forces(np.array([time_s]))[0]) for one in world.gestures if isinstance(one, kind))
                for kind in (Stroke, Gesture)
            )
            nearest = np.linalg.norm(seen.velocity_m_s - true, axis=1)
            velocities["contact"] = seen.velocity_m_s[nearest.argmin()] if len(nearest) else np.full(3, np.nan)
            for name, velocity in velocities.items():
                speed = float(np.linalg.norm(velocity)) * (all_of_it / moving if name != "contact" else 1.0)
                cosine = velocity @ true / max(float(np.linalg.norm(velocity)) * speed_m_s, 1e-12)
                found.setdefault(name, []).append(
                    (abs(speed / speed_m_s - 1), float(np.degrees(np.arccos(np.clip(cosine, -1, 1)))))
                )
    return {name: np.array(rows) for name, rows in found.items()}


def main(seeds: int = 10) -> None:
    for fingers in (1, 2):
        print(f"{'one finger' if fingers == 1 else 'one finger strokes, another comes and goes'}, {seeds} worlds")
        for speed_m_s in SPEEDS_M_S:
            for name, rows in errors(range(seeds), speed_m_s, fingers).items():
                said = np.isfinite(rows).all(axis=1)
                text = "says nothing"
                if said.any():
                    (speed, angle), (speed_90, angle_90) = np.percentile(rows[said], [50, 90], axis=0)
                    text = (
                        f"speed {100 * speed:.0f} % ({100 * speed_90:.0f}), direction {angle:.1f} ({angle_90:.1f}) deg"
                    )
                print(f"  {1e3 * speed_m_s:3.0f} mm/s  {name:<20} {text}; says something {100 * said.mean():.0f} %")


if __name__ == "__main__":
    main()
