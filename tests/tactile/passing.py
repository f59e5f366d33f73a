"""Two fingers that cross, bounce off each other or meet on a flat skin, and what became of their identities."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from skinware.tactile.contacts import Contacts, ContactSet
from skinware.tactile.neighbours import neighbours
from tests.tactile.skins import PITCH_M, placed, triangles

Way = Literal["cross", "bounce", "meet"]
Outcome = Literal["kept", "swapped", "new"]

FLAT = triangles(64, 64)
GEOMETRY = placed(FLAT)
NEIGHBOURS = neighbours(GEOMETRY)
MIDDLE_M = FLAT.mean(axis=0)
ON, OFF, NOISE = 4.0, 2.4, 0.8
BRAKE_M_S2 = 20.0
"""Deceleration of a finger that meets another: two times gravity."""
REST_S = 0.3
"""For how long it stays there."""
WIDTHS_APART, FINGER_M = 3.0, 0.01
"""Sigmas, and m, between the centres of two fingers in one lane that meet: they touch, and cannot be nearer."""


@dataclass(frozen=True)
class FingerPass:
    """Two fingers that come from opposite sides.

    Attributes:
        way: both go on; turn round at once where they are nearest; or slow down, rest there, and go back.
        speed_m_s: of each.
        lane: distance of their lanes, in pitches.
        sigma_m: width of the response to each.
        seed: for direction, place, loads and noise.
        rate_hz: of the samples.
    """

    way: Way
    speed_m_s: float
    lane: float
    sigma_m: float
    seed: int
    rate_hz: float = 50.0

    def samples(self) -> Iterator[tuple[int, npt.NDArray[np.float64], npt.NDArray[np.bool_], npt.NDArray[np.float64]]]:
        """Time, values, touched taxels, and (2, 3) m, where the fingers are."""
        random = np.random.default_rng(
            [self.seed, round(1e4 * self.speed_m_s), round(self.lane), round(1e4 * self.sigma_m)]
        )
        angle = random.uniform(0, 2 * np.pi)
        along = np.array([np.cos(angle), np.sin(angle), 0.0])
        across = np.array([-along[1], along[0], 0.0]) * random.choice([-1, 1])
        middle_m = MIDDLE_M + random.uniform(-PITCH_M, PITCH_M, 3) * [1, 1, 0]
        peak = random.uniform(20, 40, 2)
        lane_m = self.lane * PITCH_M * across / 2
        touched = np.zeros(len(FLAT), bool)
        for number, away_m in enumerate(self._away_m(random.uniform())):
            at_m = np.array([middle_m - away_m * along + lane_m, middle_m + away_m * along - lane_m])
            squares = ((FLAT[None] - at_m[:, None]) ** 2).sum(axis=2)
            counts = np.round(
                peak @ np.exp(-squares / (2 * self.sigma_m**2)) + NOISE * random.standard_normal(len(FLAT))
            )
            touched = counts > np.where(touched, OFF, ON)
            yield 10**9 + round(number * 1e9 / self.rate_hz), np.where(touched, counts, 0.0), touched, at_m

    def _away_m(self, phase: float) -> npt.NDArray[np.float64]:
        """Half of the distance of both along their way, in each frame; below 0 after they have passed."""
        step_m = self.speed_m_s / self.rate_hz
        from_m = max(4 * step_m, 4 * self.sigma_m + 0.02) + phase * step_m
        if self.way != "meet":
            away_m = from_m - step_m * np.arange(round(2 * from_m / step_m) + 1)
            return (away_m if self.way == "cross" else np.abs(away_m)).astype(np.float64)
        brake_m = self.speed_m_s**2 / (2 * BRAKE_M_S2)
        nearest_m = 0.0 if self.lane else max(WIDTHS_APART * self.sigma_m, FINGER_M) / 2
        begin_s, brake_s = from_m / self.speed_m_s, self.speed_m_s / BRAKE_M_S2
        time_s = np.arange(0, begin_s + brake_s, 1 / self.rate_hz)
        braking_s = np.clip(time_s - begin_s, 0, brake_s)
        coming = nearest_m + from_m + brake_m - self.speed_m_s * time_s + BRAKE_M_S2 * braking_s**2 / 2
        return np.concatenate([coming, np.full(round(REST_S * self.rate_hz), nearest_m), coming[::-1]])


@dataclass(frozen=True)
class Verdict:
    """Result of a pass: the fate of both identities, and the number of identities."""

    outcome: Outcome
    identities: int


def told(one: FingerPass, contacts: Contacts | None = None) -> Verdict:
    """Take a pass through contacts."""
    contacts = contacts or Contacts(len(FLAT), NEIGHBOURS, GEOMETRY)
    seen: set[int] = set()
    first = last = (0, 0)
    for time_ns, value, touched, at_m in one.samples():
        found = contacts.update(value, touched, time_ns)
        seen |= set(found.id.tolist())
        now = _identities(found, at_m, one.sigma_m)
        if 0 not in now and now[0] != now[1]:
            first, last = first if first[0] else now, now
    fate: Outcome = "new" if not first[0] else "kept" if first == last else "swapped" if first == last[::-1] else "new"
    return Verdict(fate, len(seen))


def _identities(found: ContactSet, at_m: npt.NDArray[np.float64], sigma_m: float) -> tuple[int, int]:
    """The identity at each finger; 0: none."""
    away_m = np.linalg.norm(found.cop_m[None] - at_m[:, None], axis=2)
    if not len(found):
        return 0, 0
    near = away_m.min(axis=1) < max(PITCH_M, sigma_m)
    one, other = np.where(near, found.id[away_m.argmin(axis=1)], 0).tolist()
    return one, other
