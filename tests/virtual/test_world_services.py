"""The services of a world: what is true in it, and commands to its joints."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="needs the extra mujoco")

from skinware import Namespace
from skinware.errors import RequestFailed
from skinware.realtime import now_ns
from skinware.service import ServiceReader
from skinware.tactile.calibration.sources import POINT, PoseSource
from skinware_drivers.virtual.physics.binding import find_binding
from skinware_drivers.virtual.physics.world import PhysicsWorld
from tests.commands import running

from .rig import MS
from .scenes import on_the_pad

MODULE = "rows = 4\ncolumns = 4"


@pytest.fixture
def world(tmp_path: Path, namespace: Namespace) -> Iterator[PhysicsWorld]:
    world = PhysicsWorld(find_binding(on_the_pad(tmp_path, MODULE), "xela"), has_services=True)
    yield world
    world.close()


def run(world: PhysicsWorld, duration_ms: int) -> None:
    """Let the world run; its time begins 20 s ago, so that none of its samples is of the future."""
    begun_ns = world.origin_ns or now_ns() - 20_000 * MS
    at_ns = begun_ns + round(world.scene.time_s * 1e9)
    for step in range(0, duration_ms + 1, 10):
        world.advance(at_ns + step * MS)


def newest(name: str) -> Any:
    with ServiceReader(name, timeout_s=5) as reader:
        return reader.read(timeout_s=5)


def test_truth_has_the_contact_its_force_and_its_place(world: PhysicsWorld) -> None:
    run(world, 800)
    truth = newest("truth")
    [touch] = world.scene.touching()
    assert truth.column("count")[0] == 1
    assert truth.column("normal_n")[0] == pytest.approx(touch.normal_n)
    assert truth.column("force_n")[0] == pytest.approx(touch.normal_n) == truth.column("module_n")[0]
    assert truth.column("point_m")[0] == pytest.approx(touch.point_m)
    assert truth.column("scene_s")[0] == pytest.approx(world.scene.time_s)
    with ServiceReader("truth", timeout_s=5) as reader:
        assert reader.static()["module_name"].tolist() == [b"pad"]
        found = PoseSource(reader, POINT, (3,)).newest()
    assert found == pytest.approx(touch.point_m), "calibration by touch reads it"


def asked(world: PhysicsWorld, question: Callable[[ServiceReader[Any]], object]) -> BaseException | object:
    """Ask the service ``joints`` in a thread, while the world looks at requests and stands still."""
    answers: list[BaseException | object] = []

    def ask() -> None:
        try:
            with ServiceReader("joints", timeout_s=5) as reader:
                answers.append(question(reader))
        except RequestFailed as error:
            answers.append(error)

    run(world, 10)
    thread = threading.Thread(target=ask)
    thread.start()
    while not answers:
        run(world, 0)
    thread.join()
    return answers[0]


def test_joints_obey_poses_targets_and_hold(world: PhysicsWorld) -> None:
    run(world, 20)
    with ServiceReader("joints", timeout_s=5) as reader:
        assert reader.static()["actuator_name"].tolist() == [b"x", b"y", b"press"]
        assert reader.static()["pose_name"].tolist() == [b"press"]
    asked(world, lambda joints: joints.call("move", targets={"x": 0.004}))
    run(world, 500)
    row = world.scene.joints.index("ball_x")
    assert newest("joints").column("position")[row] == pytest.approx(0.004, abs=0.0005)
    asked(world, lambda joints: joints.call("move", targets={"x": -0.004}, seconds=2.0))
    run(world, 500)
    asked(world, lambda joints: joints.call("hold"))
    held = float(world.scene.data.ctrl[0])
    assert -0.003 < held < 0.004
    run(world, 500)
    assert world.scene.data.ctrl[0] == held
    asked(world, lambda joints: joints.call("move", pose="press", seconds=0.1))
    run(world, 400)
    assert newest("joints").column("target").tolist() == pytest.approx([held, 0, 2])


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"pose": "fist"}, "no pose 'fist'; there are press"),
        ({"targets": {"lift": 1.0}}, "no actuator 'lift'"),
        ({"targets": {"x": float("nan")}}, "no number"),
        ({"targets": {"x": "far"}}, "no number"),
        ({"pose": "press", "seconds": -1.0}, "give 0 to 3600"),
    ],
)
def test_a_command_that_makes_no_sense_is_refused(world: PhysicsWorld, arguments: dict[str, Any], says: str) -> None:
    error = asked(world, lambda joints: joints.call("move", **arguments))
    assert isinstance(error, RequestFailed)
    assert says in str(error)


@pytest.mark.thorough
def test_the_command_runs_a_world_and_a_driver_reads_it(tmp_path: Path, namespace: Namespace) -> None:
    port = tmp_path / "port"
    device = ("--driver", "robotiq_tsf", "--bus", f"pty:{port}", "--world", "mujoco:gripper")
    with running("skin-emulate", *device) as emulator:
        emulator.wait_for("ready")
        with running("skin-driver", "--driver", "robotiq_tsf", "--bus", f"{port}") as driver:
            driver.wait_for("status", lambda event: event["buses"][0]["state"] == "live")
            with ServiceReader("truth", timeout_s=10) as truth:
                for sample in truth.samples(timeout_s=20):
                    if sample.column("count")[0]:
                        break
            assert np.isfinite(sample.column("force_n")[0])
            assert np.isfinite(sample.column("lag_s")[0])
