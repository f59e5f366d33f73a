"""Contacts on a skin of two coordinate frames with poses are those of the same skin in one frame."""

from __future__ import annotations

import numpy as np
import pytest

from skinware.tactile.contacts import Contacts
from tests.tactile.passing import FLAT, GEOMETRY, MIDDLE_M, NEIGHBOURS, FingerPass, Way
from tests.tactile.skins import placed

LEFT = np.where(FLAT[:, 0] < MIDDLE_M[0], "left", "right") == "left"
TURN, SHIFT_M = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]]), np.array([0.05, 0.01, -0.2])
"""From the frame on the right to that on the left: a turn about all axes, and a shift, m."""
POSES = {
    "left": np.eye(4),
    "right": np.block([[TURN, SHIFT_M[:, None]], [np.zeros(3), np.ones(1)]]),
    "other": np.eye(4),
}


def apart() -> Contacts:
    position_m = np.where(LEFT[:, None], FLAT, (FLAT - SHIFT_M) @ TURN)
    normal = np.where(LEFT[:, None], [0, 0, 1], np.array([0, 0, 1]) @ TURN)
    geometry = placed(position_m, np.where(LEFT, "left", "right"), normal)
    return Contacts(len(FLAT), NEIGHBOURS, geometry, poses=POSES)


@pytest.mark.parametrize(("way", "speed_m_s"), [("cross", 0.2), ("cross", 2.0), ("meet", 0.5)])
@pytest.mark.parametrize("lane", [0, 3])
def test_the_border_of_two_frames_with_poses_changes_nothing(way: Way, speed_m_s: float, lane: float) -> None:
    whole, parted, frames = Contacts(len(FLAT), NEIGHBOURS, placed(FLAT, normal=[0, 0, 1])), apart(), set()
    for time_ns, value, touched, _ in FingerPass(way, speed_m_s, lane, 0.004, seed=3).samples():
        wanted, found = (contacts.update(value, touched, time_ns) for contacts in (whole, parted))
        assert found.id.tolist() == wanted.id.tolist()
        assert np.array_equal(found.contact_of, wanted.contact_of)
        for row, contact in enumerate(found):
            turn, shift_m = (np.eye(3), np.zeros(3)) if contact.frame == "left" else (TURN, SHIFT_M)
            assert np.allclose(turn @ contact.cop_m + shift_m, wanted.cop_m[row], atol=1e-6)
            assert np.allclose(turn @ contact.normal, wanted.normal[row], atol=1e-6)
            assert np.allclose(turn @ contact.velocity_m_s, wanted.velocity_m_s[row], atol=1e-5)
            highest = contact.taxels[value[contact.taxels] == contact.peak]
            assert contact.frame in {"left" if one else "right" for one in LEFT[highest]}
            frames.add(contact.frame)
    assert frames == {"left", "right"}


def test_frames_without_a_pose_stay_as_they_are() -> None:
    alone = Contacts(len(FLAT), NEIGHBOURS, GEOMETRY, poses={"left": np.diag([-1.0, -1, 1, 1])})
    plain, value = Contacts(len(FLAT), NEIGHBOURS, GEOMETRY), np.zeros(len(FLAT))
    value[[5, 6]] = 9.0
    for number in range(3):
        found, wanted = (contacts.update(value, value > 0, number * 20_000_000) for contacts in (alone, plain))
    assert (found.frames, found.frame.tolist()) == (wanted.frames, [0])
    assert np.array_equal(found.cop_m, wanted.cop_m)


def test_taxels_without_places_belong_to_contacts_across_the_border() -> None:
    position_m = np.where(LEFT[:, None], FLAT, np.nan)
    geometry = placed(position_m, np.where(LEFT, "left", ""))
    contacts, value = Contacts(len(FLAT), NEIGHBOURS, geometry, poses=POSES), np.zeros(len(FLAT))
    value[2000:2064] = 5.0
    value[2063] = 50.0  # the highest has no place
    for number in range(3):
        (*_, contact) = [None, *contacts.update(value, value > 0, number * 20_000_000)]
    assert contact is not None
    assert (contact.frame, contact.n) == ("left", 64)
    assert np.isfinite(contact.cop_m).all()
