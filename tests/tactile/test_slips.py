"""Slip is found by how the pattern of a contact moves, not by its noise or its load."""

from __future__ import annotations

import numpy as np
import pytest

from skinware.tactile import Baseline
from skinware.tactile.arrays import Doubles
from skinware.tactile.contacts import Contacts
from skinware.tactile.neighbours import neighbours
from skinware.tactile.onsets import EventKind, Events
from skinware.tactile.testing import Response, World
from skinware.tactile.testing import triangles as strip
from tests.tactile.skins import placed, triangles

FLAT = placed(triangles(10, 12))
MIDDLE = FLAT.position_m[65]
RATE_HZ, PITCH_M = 100, 0.0065


class Pressed:
    """A skin that a bell of 6 mm presses, with noise of 1, watched for slip."""

    def __init__(self, seed: int = 1) -> None:
        self._random = np.random.default_rng(seed)
        self._contacts, self._events = Contacts(120, neighbours(FLAT), FLAT), Events()
        self._frames = 0
        self.counts: set[int] = set()

    def step(self, *bells: tuple[float, Doubles], unknown: tuple[int, ...] = ()) -> bool:
        """Take the next frame, of loads at places; return whether something has begun to slip."""
        self._frames += 1
        sigmas = self._random.standard_normal(120)
        for load, place in bells:
            sigmas += load * np.exp(-((FLAT.position_m - place) ** 2).sum(axis=1) / (2 * 0.006**2))
        sigmas[list(unknown)] = np.nan
        touched = sigmas > 5
        time_ns = round(self._frames * 1e9 / RATE_HZ)
        found = self._contacts.update(np.where(touched, sigmas, 0), touched, time_ns, sigmas=sigmas)
        self.counts.add(len(found))
        return any(event.kind is EventKind.SLIPPED for event in self._events.of(found, time_ns))

    def rest(self, frames: int, load: float = 200.0, place: Doubles = MIDDLE) -> bool:
        return any(self.step((load, place)) for _ in range(frames))


@pytest.mark.parametrize("speed_m_s", [0.01, 0.03, 0.1])
@pytest.mark.parametrize("angle", [0.0, 1.0, 2.5])
def test_a_slip_is_found_once_the_pattern_has_moved_by_its_noise(speed_m_s: float, angle: float) -> None:
    skin, way = Pressed(), np.array([np.cos(angle), np.sin(angle), 0.0])
    assert not skin.rest(100)
    found = [skin.step((200, MIDDLE + way * speed_m_s * frame / RATE_HZ)) for frame in range(1, 13)]
    assert sum(found) == 1
    sigma_m = 0.006 * 2**0.5 / (200 * (np.pi * 36 / 36) ** 0.5)
    assert found.index(True) + 1 <= max(2, 40 * sigma_m / (speed_m_s / RATE_HZ))


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.thorough)])
def test_a_contact_at_rest_does_not_slip(seed: int) -> None:
    assert not Pressed(seed).rest(1000)


@pytest.mark.parametrize("to", [20, 100, 400])
def test_a_change_of_the_load_is_no_slip(to: float) -> None:
    skin = Pressed()
    assert not skin.rest(100)
    assert not any(skin.step((200 + (to - 200) * min(1, frame / 20), MIDDLE)) for frame in range(60))


def test_contacts_that_merge_or_split_do_not_slip() -> None:
    skin, other = Pressed(), FLAT.position_m[np.argmax(np.linalg.norm(FLAT.position_m - MIDDLE, axis=1) < 0.032)]
    assert not any(skin.step((30, MIDDLE), (20, other)) for _ in range(60))
    loads = [*np.geomspace(1, 20, 100), *np.geomspace(20, 1, 100)]
    assert not any(skin.step((30 * load, MIDDLE), (20 * load, other)) for load in loads)
    assert {1, 2} <= skin.counts


def test_a_taxel_that_comes_and_goes_is_no_slip() -> None:
    skin = Pressed()
    assert not skin.rest(60)
    beside = int(np.argsort(np.linalg.norm(FLAT.position_m - MIDDLE, axis=1))[1])
    gaps = [() if frame % 20 < 10 else (beside,) for frame in range(200)]
    assert not any(skin.step((200, MIDDLE), unknown=gap) for gap in gaps)


def test_without_noise_nothing_slips() -> None:
    contacts = Contacts(120, neighbours(FLAT), FLAT)
    for frame in range(40):
        value = 200 * np.exp(-((FLAT.position_m - MIDDLE - [0.001 * frame, 0, 0]) ** 2).sum(axis=1) / 7.2e-5)
        found = contacts.update(value, value > 5, frame * 10_000_000)
        assert not found.slips.any()
        known = contacts.update(value, value > 5, frame * 10_000_000, sigmas=np.full(120, np.nan))
        assert not known.slips.any()


def test_contacts_without_places_do_not_slip() -> None:
    contacts = Contacts(4, module=np.zeros(4, int))
    for frame in range(40):
        value = np.roll(np.array([200.0, 100, 0, 0]), frame // 5)
        assert not contacts.update(value, value > 5, frame * 10_000_000, sigmas=value).slips.any()


@pytest.mark.parametrize("strokes", [True, False])
def test_strokes_of_a_drifting_skin_slip_and_pushes_do_not(strokes: bool) -> None:
    slow = Response(creep=0.1, remainder=0.1, sag=0.05)
    world = World(strip(modules=6), seed=4, noise=0.8, drift_per_min=5, walk=1.0, gain_spread=0.1, response=slow)
    places, n = world.surface.geometry("strip"), len(world.surface)
    for number in range(4):
        at, begin_s = places.position_m[11 + 7 * number], 8 + 2.0 * number
        if strokes:
            world.stroke(np.array([at, np.add(at, (0.03, 0, 0))]), 40, begin_s, begin_s + 1)
        else:
            world.push(at, 40, begin_s, begin_s + 1)
    baseline, contacts = Baseline(world.surface.module, world.surface.patch), Contacts(n, neighbours(places), places)
    slipped = set()
    for sample in world.samples(until_s=16):
        values = sample.values.astype("f4")
        calm = baseline.update(sample.time_ns, values, sample.usable)
        sigmas = (values - calm.baseline) / calm.noise
        found = contacts.update(calm.value, calm.touched, sample.time_ns, sigmas=sigmas)
        slipped |= {contact.id for contact in found if contact.slips}
    assert len(slipped) == (4 if strokes else 0)
