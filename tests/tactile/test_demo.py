"""The skin that everybody sees first: fingers wander over it from the beginning, and each is a contact."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from skinware import Namespace
from skinware.tactile import Baseline, Contacts, ContactsReader
from skinware.tactile.neighbours import neighbours
from skinware.tactile.testing import Wander, World, arm, arm_path
from tests.commands import running

BOARDS = (2, 3)
NEAR_M = 0.012


def fingers(random: np.random.Generator) -> list[Wander]:
    """One on each board, as the emulated boards are pressed."""
    paths = [np.roll(arm_path(board), -int(random.integers(16)), axis=0) for board in BOARDS]
    return [
        Wander(
            path_m=tuple((x, y, z) for x, y, z in path.tolist()),
            force=5,
            radius_m=0.006,
            begin_s=float(random.uniform(0, 1.4)),
            end_s=1e6,
            rise_s=0.5,
            speed_m_s=0.02,
            press_s=4.6,
        )
        for path in paths
    ]


@pytest.mark.thorough
@pytest.mark.parametrize("seed", range(3))
def test_a_skin_that_is_touched_from_the_start_begins_and_shows_every_finger(seed: int) -> None:
    world = World(arm(BOARDS), seed=seed, rate_hz=20, sensitivity=24)
    world.gestures += fingers(np.random.default_rng(seed))
    places = world.surface.geometry("arm")
    baseline = Baseline(world.surface.module, world.surface.patch)
    contacts = Contacts(len(places), neighbours(places), places)
    frames = world.samples(until_s=40)
    for _ in range(round(5.2 * world.rate_hz)):
        sample = next(frames)
        calm = baseline.update(sample.time_ns, sample.values, sample.usable)
    assert calm.usable.mean() > 0.25, "those that rested begin"
    assert not calm.usable.all(), "those that were just stroked wait"
    near = there = 0
    for sample in frames:
        time_s = (sample.time_ns - 1_000_000_000) / 1e9
        calm = baseline.update(sample.time_ns, sample.values, sample.usable)
        found = contacts.update(calm.value, calm.touched, sample.time_ns)
        firm = np.array([at for _, at, force in world.pressing(time_s) if force > 2.5]).reshape(-1, 1, 3)
        if time_s > 20:
            assert baseline.ready.all()
            near += int((np.linalg.norm(found.cop_m - firm, axis=2).min(axis=1, initial=1.0) < NEAR_M).sum())
            there += len(firm)
    assert there > 300
    assert near / there > 0.98


@pytest.mark.thorough
def test_from_the_bus_to_a_contact_that_follows_a_finger(calm_namespace: Namespace, tmp_path: Path) -> None:
    state = ["--state", str(tmp_path / "state.npz")]
    with (
        running("skin-driver", "--bus", "virtual?boards=10"),
        running("skin-calm", "roboskin", "--into", calm_namespace.name, *state) as calm,
    ):
        calm.wait_for("ready")
        places: dict[int, list[list[float]]] = {}
        with ContactsReader(namespace=calm_namespace, timeout_s=60) as contacts:
            for frame in contacts.samples(timeout_s=60):
                for contact in frame:
                    places.setdefault(contact.id, []).append(contact.cop_m.tolist())
                    assert contact.frame == "arm"
                    assert contact.cop_m[0] > 0.15, "the hand is beyond the wrist"
                if any(np.ptp(np.array(way), axis=0).max() > 0.02 for way in places.values()):
                    break
