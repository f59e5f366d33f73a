"""A simulated hand whose finger touches its own skin: taxels are placed by its joints, judged by the scene."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="needs the extra mujoco")

from skinware import Namespace
from skinware.errors import ConfigurationError
from skinware.service import ServiceReader
from skinware.tactile.calibration.sources import PoseSource
from skinware_drivers.virtual.physics.binding import find_binding
from skinware_drivers.virtual.physics.world import PhysicsWorld

from .self_touch import RADIUS_M, TIP_M, gathered, placed, self_touch

PRESSES = 60


@pytest.mark.thorough
def test_a_finger_places_the_taxels_of_its_own_hand(tmp_path: Path, namespace: Namespace) -> None:
    world = PhysicsWorld(find_binding(self_touch(tmp_path, PRESSES, seed=1), "xela"), has_services=True)
    world.advance(0)
    with ServiceReader("joints") as reader:
        session = gathered(world, PRESSES, PoseSource(reader, "pose", (4, 4)).newest)
    world.close()
    assert len(session.presses) == PRESSES
    found, off_m = placed(world, session, RADIUS_M)
    assert np.median(np.linalg.norm(off_m, axis=1)) < 0.001
    assert np.linalg.norm(found.tip_m - TIP_M) < 0.001
    _, of_the_middle = placed(world, session, 0.0)
    assert np.median(of_the_middle[:, 2]) > 0.75 * RADIUS_M


def test_the_service_has_the_pose_of_the_finger(tmp_path: Path, namespace: Namespace) -> None:
    world = PhysicsWorld(find_binding(self_touch(tmp_path, 1, seed=1), "xela"), has_services=True)
    for time_ns in (0, 200_000_000):
        world.advance(time_ns)
    with ServiceReader("joints") as reader:
        pose = PoseSource(reader, "pose", (4, 4)).newest()
    data = world.scene.data
    palm, site = data.body("palm"), data.site("tip")
    in_palm = palm.xmat.reshape(3, 3).T @ (site.xpos - palm.xpos)
    assert pose is not None
    assert pose @ [*TIP_M, 1] == pytest.approx([*in_palm, 1])
    assert np.abs(in_palm).max() > 0.01
    world.close()


def test_a_carrier_that_the_scene_does_not_have(tmp_path: Path) -> None:
    world = self_touch(tmp_path, 1, seed=1)
    file = tmp_path / "self.toml"
    file.write_text(file.read_text().replace('carrier = "tip"', 'carrier = "tipp"'))
    with pytest.raises(ConfigurationError, match="tipp"):
        PhysicsWorld(find_binding(world, "xela"))
