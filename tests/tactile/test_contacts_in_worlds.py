"""From counts to contacts: fingers in worlds that drift and rustle, through a baseline."""

from __future__ import annotations

import numpy as np
import pytest

from skinware.tactile.baseline import Baseline, BaselineSettings
from skinware.tactile.contacts import Contacts, ContactSet
from skinware.tactile.neighbours import neighbours
from skinware.tactile.testing import Response, World, grid
from tests.tactile.skins import PITCH_M, placed

SURFACE = grid(1, 16, 24, pitch_m=PITCH_M)
GEOMETRY = placed(SURFACE.position_m, normal=SURFACE.normal)
NEIGHBOURS = neighbours(GEOMETRY)
LEFT_M, RIGHT_M = SURFACE.position_m.min(axis=0), SURFACE.position_m.max(axis=0)
LANES_M = LEFT_M[1] + PITCH_M * np.array([4.3, 10.1])
COLUMN, ROW = (np.round(SURFACE.position_m[:, axis] / PITCH_M).astype(int) for axis in (0, 1))
MODULE = COLUMN // 4 * 4 + ROW // 4  # of 16 taxels
FINGERS = (1, -1)
"""Along x: one to the right, one to the left."""
REST_S, BEGIN_S, END_S, MARGIN_M = 1.0, 1.5, 4.5, 0.02


def ends_m(finger: int) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    """(2, 3) m: where a finger begins and ends."""
    x = np.array([LEFT_M[0] + MARGIN_M, RIGHT_M[0] - MARGIN_M])[:: FINGERS[finger]]
    return np.column_stack([x, [LANES_M[finger]] * 2, [0.0, 0.0]])


def contacts_in(world: World, until_s: float) -> list[tuple[float, ContactSet]]:
    """Time and contacts of each frame; at first the rest is measured."""
    baseline = Baseline(MODULE, SURFACE.patch, BaselineSettings(calibrate_s=REST_S))
    contacts = Contacts(len(GEOMETRY), NEIGHBOURS, GEOMETRY)
    found = []
    first_ns = None
    for sample in world.samples(until_s=until_s):
        first_ns = sample.time_ns if first_ns is None else first_ns
        calm = baseline.update(sample.time_ns, sample.values.astype(np.float32), sample.usable)
        found.append(((sample.time_ns - first_ns) / 1e9, contacts.update(calm.value, calm.touched, sample.time_ns)))
    return found


@pytest.mark.thorough
@pytest.mark.parametrize("seed", range(20))
def test_two_fingers_pass_each_other_and_keep_their_identities(seed: int) -> None:
    response = Response(width_m=0.004, sag=0.2, remainder=0.2)
    world = World(SURFACE, seed=seed, noise=0.8, drift_per_min=3.0, drift_spread=0.3, response=response)
    for finger in range(2):
        world.stroke(ends_m(finger), 30, begin_s=BEGIN_S, end_s=END_S, radius_m=0.003)
    identities: list[set[int]] = [set(), set()]
    for time_s, contacts in contacts_in(world, END_S + 2.5):
        if not BEGIN_S + 0.3 < time_s < END_S - 0.2:
            continue
        share = (time_s - BEGIN_S) / (END_S - BEGIN_S)
        for finger in range(2):
            begin, end = ends_m(finger)
            away_m = np.linalg.norm(contacts.cop_m - (begin + share * (end - begin)), axis=1)
            nearest = int(away_m.argmin())
            assert away_m[nearest] < PITCH_M
            contact = contacts[nearest]
            identities[finger].add(contact.id)
            if time_s > BEGIN_S + 0.8:
                speed_m_s = np.linalg.norm(end - begin) / (END_S - BEGIN_S)
                assert contact.velocity_m_s[0] * FINGERS[finger] == pytest.approx(speed_m_s, rel=0.35)
            assert contact.normal.tolist() == [0, 0, 1]
    assert [len(found) for found in identities] == [1, 1]
    assert not identities[0] & identities[1]
    assert not set(contacts.id.tolist()) & (identities[0] | identities[1])  # 2.5 s after both were lifted


@pytest.mark.thorough
def test_an_idle_skin_has_no_contacts_of_more_than_a_taxel() -> None:
    world = World(SURFACE, seed=1, noise=0.8, drift_per_min=3.0)
    sizes = [contacts.n.max(initial=0) for _, contacts in contacts_in(world, 20.0)]
    assert np.mean(np.array(sizes) > 0) < 0.05
    assert max(sizes) <= 1
