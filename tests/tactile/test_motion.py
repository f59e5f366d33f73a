"""Motion of regions: as fast and in the direction of what moves over them."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from skinware._columns import Index
from skinware.tactile.baseline import Baseline, BaselineSettings
from skinware.tactile.contacts import Contacts
from skinware.tactile.motion import MotionSet, motion_of
from skinware.tactile.neighbours import neighbours
from skinware.tactile.testing import Response, World, grid
from tests.tactile.skins import AT_ONCE, PITCH_M, placed

SIDE = 20
SURFACE = grid(1, SIDE, SIDE, pitch_m=PITCH_M)
GEOMETRY = placed(SURFACE.position_m, normal=SURFACE.normal)
TABLE = neighbours(GEOMETRY)
ROW, COLUMN = np.divmod(np.arange(SIDE * SIDE), SIDE)
REGIONS: dict[str, Index] = {
    "low": np.flatnonzero(ROW < SIDE // 2),
    "high": slice(SIDE * SIDE // 2, SIDE * SIDE),
    "none": slice(0, 0),
}
LOW_M, HIGH_M = SURFACE.position_m.min(axis=0), SURFACE.position_m.max(axis=0)
PERIOD_NS = 20_000_000


def slid(rows: dict[int, float], frames: int = 40, load: float = 10.0) -> MotionSet:
    """Smooth contacts that slide along rows of taxels, at so many m/s along x; what is known at the end."""
    contacts = Contacts(SIDE * SIDE, TABLE, GEOMETRY)
    for frame in range(frames):
        value = np.zeros(SIDE * SIDE)
        for row, speed_m_s in rows.items():
            x = (LOW_M[0] if speed_m_s >= 0 else HIGH_M[0]) + speed_m_s * frame * PERIOD_NS / 1e9
            away_m = np.hypot(SURFACE.position_m[:, 0] - x, (ROW - row) * PITCH_M)
            value += load * np.exp(-((away_m / PITCH_M) ** 2))
        found = contacts.update(value, value > 0.1, frame * PERIOD_NS)
    return motion_of(REGIONS, found, value)


def test_each_region_has_the_motion_of_what_touches_it() -> None:
    found = slid({3: 0.05, 15: -0.1})
    low, high, nothing = found
    assert (low.name, low.contacts, low.frame) == ("low", 1, "chest")
    assert low.velocity_m_s == pytest.approx([0.05, 0, 0], abs=0.004)
    assert high.velocity_m_s == pytest.approx([-0.1, 0, 0], abs=0.008)
    assert high.speed_m_s == pytest.approx(0.1, abs=0.008)
    assert high.direction == pytest.approx([-1, 0, 0], abs=0.05)
    assert (nothing.contacts, nothing.load, nothing.frame) == (0, 0, "")
    assert np.isnan([*nothing.velocity_m_s, nothing.speed_m_s, *nothing.direction]).all()


def test_several_contacts_are_weighted_by_their_load() -> None:
    found = slid({2: 0.1, 7: 0.0})[0]
    assert found.contacts == 2
    assert found.velocity_m_s == pytest.approx([0.05, 0, 0], abs=0.01)


def test_a_contact_on_a_border_moves_both_regions() -> None:
    low, high, _ = slid({SIDE // 2: 0.05})
    assert low.load < high.load
    assert low.velocity_m_s == pytest.approx(high.velocity_m_s)
    assert (low.contacts, high.contacts) == (1, 1)


def test_who_rests_has_no_direction() -> None:
    low, *_ = slid({3: 0.0})
    assert low.speed_m_s == 0
    assert np.isnan(low.direction).all()


def test_without_places_there_is_no_motion() -> None:
    contacts = Contacts(4, None, None, module=np.zeros(4, int), tracking=AT_ONCE)
    value = np.array([0.0, 3, 4, np.nan])
    found = motion_of({"all": slice(0, 4)}, contacts.update(value, value > 0, 0), value)
    assert (found[0].load, found[0].contacts, found[0].frame) == (7, 1, "")
    assert np.isnan(found[0].velocity_m_s).all()


def test_another_frame_is_left_out_of_the_velocity() -> None:
    frames = np.where(ROW < SIDE // 2, "chest", "arm")
    geometry = placed(SURFACE.position_m, frames)
    contacts = Contacts(SIDE * SIDE, neighbours(geometry), geometry)
    for frame in range(30):
        value = np.zeros(SIDE * SIDE)
        for row, speed_m_s, load in ((3, 0.05, 20.0), (15, -0.05, 10.0)):
            x = (LOW_M[0] if speed_m_s > 0 else HIGH_M[0]) + speed_m_s * frame * PERIOD_NS / 1e9
            away_m = np.hypot(SURFACE.position_m[:, 0] - x, (ROW - row) * PITCH_M)
            value += load * np.exp(-((away_m / PITCH_M) ** 2))
        found = contacts.update(value, value > 0.1, frame * PERIOD_NS)
    (everything,) = motion_of({"all": slice(0, SIDE * SIDE)}, found, value)
    assert (everything.frame, everything.contacts) == ("chest", 2)
    assert everything.velocity_m_s[0] == pytest.approx(0.05, abs=0.006)


def strokes(seed: int) -> tuple[World, npt.NDArray[np.float64], float]:
    """A stroke at 50 mm/s, its velocity, and when it ends."""
    random = np.random.default_rng(seed)
    response = Response(width_m=0.004, sag=0.2, remainder=0.2)
    world = World(SURFACE, seed=seed, rate_hz=50, noise=0.8, drift_per_min=1.0, gain_spread=0.2, response=response)
    velocity = 0.05 * np.array([np.cos(angle := random.uniform(0, 2 * np.pi)), np.sin(angle), 0])
    middle = (LOW_M + HIGH_M) / 2
    world.stroke([middle - velocity * 0.7, middle + velocity * 0.7], 30, 1.5, 2.9, radius_m=0.003)
    return world, velocity, 2.9


@pytest.mark.thorough
@pytest.mark.parametrize("seed", range(20))
def test_a_stroke_through_noise_is_told(seed: int) -> None:
    world, velocity, end_s = strokes(seed)
    baseline = Baseline(ROW // 4 * 5 + COLUMN // 4, SURFACE.patch, BaselineSettings(calibrate_s=1.0))
    contacts = Contacts(SIDE * SIDE, TABLE, GEOMETRY)
    told = []
    for number, sample in enumerate(world.samples(end_s)):
        calm = baseline.update(sample.time_ns, sample.values.astype(np.float32), sample.usable)
        found = contacts.update(calm.value, calm.touched, sample.time_ns)
        if 2.0 < number / 50 < end_s - 0.1:
            told.append(motion_of({"all": slice(0, SIDE * SIDE)}, found, calm.value)[0])
    speed = np.median([region.speed_m_s for region in told])
    turned = [np.degrees(np.arccos(np.clip(region.direction @ velocity / 0.05, -1, 1))) for region in told]
    assert speed == pytest.approx(0.05, rel=0.25)
    assert np.median(turned) < 15
