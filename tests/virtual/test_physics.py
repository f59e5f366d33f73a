"""Physics under emulated devices: places, forces, the transfer, time, and what is refused."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

pytest.importorskip("mujoco", reason="needs the extra mujoco")

from skinware.errors import ConfigurationError, MissingExtra
from skinware.geometry import GeometryGroup, geometry_to_toml, read_geometry
from skinware_drivers.virtual.devices.xela import EmulatedXela, EmulatedXelaOptions
from skinware_drivers.virtual.physics.binding import find_binding
from skinware_drivers.virtual.physics.scene import PhysicsScene
from skinware_drivers.virtual.physics.transfer import Transfer, TransferSettings
from skinware_drivers.virtual.physics.world import PhysicsWorld
from tests.specification import touching as specified

from .rig import MS, START_NS
from .scenes import PAD, hardware_in, on_the_pad

GRID = "rows = 4\ncolumns = 4"


def pad(folder: Path, *modules: str) -> PhysicsScene:
    return PhysicsScene(find_binding(on_the_pad(folder, *(modules or (GRID,))), "xela"))


def pressed(scene: PhysicsScene, force_n: float = 3.0, x: float = 0.0, y: float = 0.0) -> PhysicsScene:
    scene.actuators.move({"press": -1.0, "x": x, "y": y})
    scene.step_to(scene.time_s + 0.3)
    scene.actuators.move({"press": force_n})
    scene.step_to(scene.time_s + 0.5)
    return scene


def test_a_geometry_file_becomes_taxels_and_comes_back(tmp_path: Path) -> None:
    random = np.random.default_rng(3)
    places = [(x, y, 0.0) for x, y in random.uniform(-0.015, 0.015, (7, 2)).tolist()]
    group = GeometryGroup("pressure", "pad", tuple(range(100, 107)), tuple(places), ((0.0, 0.0, 1.0),) * 7)
    (tmp_path / "places.toml").write_text(geometry_to_toml([group]))
    scene = pad(tmp_path, 'geometry = "places.toml"')
    [module] = scene.modules
    mesh, geom = scene.model.mesh(f"taxels 0 on {module.geoms[0]}"), scene.data.geom(module.geoms[0])
    vertices = scene.model.mesh_vert[mesh.vertadr[0] : mesh.vertadr[0] + 7]
    back = vertices @ geom.xmat.reshape(3, 3).T + geom.xpos - scene.data.body("pad").xpos
    assert np.abs(back - places).max() < 1e-8  # MuJoCo keeps vertices as float32
    (tmp_path / "back.toml").write_text(geometry_to_toml([module.group("pressure", np.arange(100, 107))]))
    known, found = read_geometry(tmp_path / "places.toml"), read_geometry(tmp_path / "back.toml")
    assert np.array_equal(found.position_m, known.position_m)
    assert np.array_equal(found.normal, known.normal)
    assert (found.frame == "pad").all()


def test_some_sensors_of_a_geometry_file(tmp_path: Path) -> None:
    group = GeometryGroup("pressure", "pad", (9, 7, 8), ((0.0, 0.0, 0.0), (0.003, 0.0, 0.0), (0.006, 0.0, 0.0)))
    elsewhere = GeometryGroup("pressure", "chest", (6,), ((0.0, 0.0, 0.0),))
    (tmp_path / "places.toml").write_text(geometry_to_toml([elsewhere, group]))
    scene = pad(tmp_path, 'geometry = "places.toml"\nuid = [6, 8]')
    assert scene.modules[0].position_m.tolist() == [[0.003, 0, 0], [0.006, 0, 0]], "in the order of their uid"


def test_a_grid_is_let_down_onto_a_round_body(tmp_path: Path) -> None:
    binding = find_binding(on_the_pad(tmp_path, GRID), "xela")
    ball = msgspec.structs.replace(binding.binding.module[0], body="ball", rows=5, columns=5)
    scene = PhysicsScene(
        msgspec.structs.replace(binding, binding=msgspec.structs.replace(binding.binding, module=(ball,)))
    )
    [module] = scene.modules
    assert np.linalg.norm(module.position_m, axis=1) == pytest.approx(0.012)
    assert module.axes[:, 2] == pytest.approx(module.position_m / 0.012, abs=1e-6)
    assert module.axes @ module.axes.transpose(0, 2, 1) == pytest.approx(np.broadcast_to(np.eye(3), (25, 3, 3)))


def test_the_forces_on_taxels_are_those_of_the_solver(tmp_path: Path) -> None:
    """The sum of MuJoCo's own tactile values is no force: it is a length."""
    scene = pressed(pad(tmp_path), 3.0)
    [touch] = scene.touching()
    [forces] = scene.newtons()
    weight_n = 0.05 * 9.81
    assert touch.normal_n == pytest.approx(3 + weight_n, rel=0.02)
    assert forces[:, 2].sum() == pytest.approx(touch.normal_n, rel=1e-9)
    assert forces[:, 2].sum() != pytest.approx(specified.depths(scene, 0).sum(), rel=0.5)
    assert forces[:, :2].sum(axis=0) == pytest.approx(touch.shear_n[:2], abs=1e-9)


def test_many_steps_together_are_the_same_steps_one_by_one(tmp_path: Path) -> None:
    together, apart = (pressed(pad(tmp_path), 3.0) for _ in range(2))
    for scene, stops in ((together, 1), (apart, 10)):
        scene.actuators.move({"x": 0.004}, 0.1)
        begin_s = scene.time_s
        for stop in range(1, stops + 1):
            scene.step_to(begin_s + 0.1 * stop / stops)
    assert np.array_equal(together.data.sensordata, apart.data.sensordata)
    assert together.data.sensordata.any()
    assert np.array_equal(together.newtons(), apart.newtons())
    assert together.model.opt.disableflags == apart.model.opt.disableflags == 0


def test_a_ball_that_slides_drags_the_taxels_with_it(tmp_path: Path) -> None:
    scene = pressed(pad(tmp_path), 3.0)
    scene.actuators.move({"x": 0.006}, 0.3)
    scene.step_to(scene.time_s + 0.25)
    [touch] = scene.touching()
    [forces] = scene.newtons()
    assert touch.slip_m_s > 0.005
    assert 0.5 < forces[:, 0].sum() / forces[:, 2].sum() < 0.85, "friction 0.8, along x"
    assert abs(forces[:, 1].sum()) < 0.1


@pytest.mark.parametrize("seed", range(8))
def test_the_centre_of_pressure_is_that_of_the_contact(tmp_path: Path, seed: int) -> None:
    x, y = np.random.default_rng(seed).uniform(-0.004, 0.004, 2)
    scene = pressed(pad(tmp_path), 3.0, x, y)
    [touch], [forces] = scene.touching(), scene.newtons()
    share = forces[:, 2] / forces[:, 2].sum()
    centre = share @ scene.modules[0].position_m
    assert np.linalg.norm(centre[:2] - touch.point_m[:2]) < 0.0015


def test_a_contact_between_taxels_is_shared_by_the_nearest(tmp_path: Path) -> None:
    """A ball with a soft skin touches before any taxel is inside of it."""
    scene = pad(tmp_path)
    scene.model.geom_margin[:] = 0.002
    scene.model.geom_gap[:] = 0
    pressed(scene, 0.2)
    [touch], [forces] = scene.touching(), scene.newtons()
    assert not specified.depths(scene, 0).any()
    assert np.count_nonzero(forces[:, 2]) == 4
    assert forces.sum(axis=0) == pytest.approx([*touch.shear_n[:2], touch.normal_n])


@pytest.mark.parametrize(
    ("world", "driver", "at_s"),
    [("pad", "xela", (2.6, 4.5)), ("gripper", "robotiq_tsf", (3.6, 6.4)), ("hand", "inspire", (7.0, 9.0, 10.0))],
)
def test_touches_and_their_forces_are_as_specified(world: str, driver: str, at_s: tuple[float, ...]) -> None:
    scene = PhysicsScene(find_binding(f"mujoco:{world}", driver))
    for time_s in at_s:
        scene.step_to(time_s)
        found, wanted = scene.touching(), specified.touches(scene)
        assert found
        for one, other in zip(found, wanted, strict=True):
            numbers, expected = (np.hstack(list[Any](touch)) for touch in (one, other))
            np.testing.assert_allclose(numbers, expected, rtol=1e-9, atol=1e-12)
        for forces, expected_n in zip(scene.newtons(), specified.newtons(scene), strict=True):
            np.testing.assert_allclose(forces, expected_n, rtol=1e-9, atol=1e-12)


def test_there_is_room_for_any_number_of_contacts(tmp_path: Path) -> None:
    scene = pressed(pad(tmp_path), 3.0)
    scene._contacts._make_room(0)
    scene.settle()
    assert len(scene.touching()) == scene.data.ncon == 1


def test_what_no_taxel_is_near_is_not_felt(tmp_path: Path) -> None:
    scene = pressed(pad(tmp_path, "rows = 2\ncolumns = 2\nat_m = [-0.01, -0.01, 0.0]"), 3.0)
    assert scene.data.ncon == 1
    assert scene.touching() == []


ALL_ERRORS = TransferSettings(
    saturation_n=5, gain_spread=0.1, crosstalk=0.2, hysteresis=0.05, creep=0.1, remainder=0.2, creep_s=1.0,
    noise=2, drift=3, drift_s=4, warmth=1, warming_k=2, warming_s=3,
)  # fmt: skip
PLACES = np.column_stack([0.003 * (np.arange(16) % 4), 0.003 * (np.arange(16) // 4), np.zeros(16)])


def course(settings: TransferSettings, seed: int = 1) -> list[list[list[float]]]:
    random = np.random.default_rng(5)
    transfer = Transfer(settings, PLACES, (seed, 0, 0))
    return [transfer.counts(random.uniform(0, 2, (16, 3)), 0.01 * number).tolist() for number in range(50)]


def test_the_transfer_is_the_same_for_the_same_forces_times_and_seed() -> None:
    assert course(ALL_ERRORS) == course(ALL_ERRORS)
    assert course(ALL_ERRORS) != course(ALL_ERRORS, seed=2)


def test_a_plain_transfer_is_linear() -> None:
    force = np.random.default_rng(1).uniform(0, 3, (16, 3))
    counts = Transfer(TransferSettings(counts_per_n=50, shear_counts_per_n=20), PLACES, (0,)).counts(force, 0)
    assert counts == pytest.approx(force * [20, 20, 50])


def one(settings: TransferSettings, *forces: float, every_s: float = 1.0) -> list[float]:
    transfer = Transfer(settings, PLACES[:1], (0,))
    return [float(transfer.counts(np.array([[0, 0, force]]), every_s * k)[0, 2]) for k, force in enumerate(forces)]


def test_each_error_of_the_transfer() -> None:
    unit = {"counts_per_n": 100.0}
    assert one(TransferSettings(**unit, saturation_n=2.0), 2.0) == pytest.approx([100])
    assert one(TransferSettings(**unit, hysteresis=0.1), 1, 2, 1, 0) == pytest.approx([90, 180, 110, 0])
    crept = one(TransferSettings(**unit, creep=0.2, remainder=0.1, creep_s=1.0), *[1.0] * 20, 0.0)
    assert (crept[0], crept[19]) == pytest.approx((100, 120), abs=0.1)
    assert 3 < crept[20] < 10, "it remembers the load"
    warm = one(TransferSettings(**unit, warmth=2.0, warming_k=5.0, warming_s=1.0), *[0.0] * 20)
    assert (warm[0], warm[19]) == pytest.approx((0, 10), abs=0.01)
    wave = one(TransferSettings(**unit, drift=4.0, drift_s=10.0), *[0.0] * 10)
    assert sum(wave) == pytest.approx(0, abs=1e-9)
    assert 3 < max(wave) <= 4
    spread_out = Transfer(TransferSettings(**unit, crosstalk=0.3), PLACES, (0,)).counts(np.eye(16)[:, [0, 0, 5]], 0)
    assert spread_out[:, 2].sum() == pytest.approx(100), "no force is lost"
    assert spread_out[5, 2] == pytest.approx(70)
    noise = np.array(one(TransferSettings(**unit, noise=3.0), *[0.0] * 400))
    assert noise.std() == pytest.approx(3, rel=0.1)


def frames_of(world: str, duration_ms: int, **options: object) -> list[object]:
    hardware, _ = hardware_in(world, "xela", streaming=True, **options)
    hardware.skip(START_NS)
    return [frame for step in range(duration_ms) for frame in hardware.emit(START_NS + (step + 1) * MS)]


def test_a_run_is_repeated_exactly_and_only_the_seed_changes_it(tmp_path: Path) -> None:
    world = on_the_pad(tmp_path, GRID + '\naxes = "xyz"')
    first = frames_of(world, 400)
    assert first == frames_of(world, 400)
    assert first != frames_of(world, 400, seed=1)


def test_the_physics_runs_in_the_time_of_the_devices_or_n_times_as_fast(tmp_path: Path) -> None:
    world = on_the_pad(tmp_path, GRID)
    for speed in (0.25, 1.0, 4.0):
        hardware, _ = hardware_in(world, "xela", streaming=True, world_speed=speed)
        hardware.skip(START_NS)
        hardware.emit(START_NS + 500 * MS)
        assert hardware.world.scene.time_s == pytest.approx(0.5 * speed, abs=0.002 + 0.004 * speed)


def test_time_that_nobody_asked_for_is_left_out_and_said(tmp_path: Path) -> None:
    world = PhysicsWorld(find_binding(on_the_pad(tmp_path, GRID), "xela"))
    world.advance(START_NS)
    world.advance(START_NS + 3_000 * MS)
    assert world.scene.time_s == pytest.approx(1.0, abs=0.002)
    assert world.left_out_s == pytest.approx(2.0, abs=0.002)
    world.advance(START_NS + 3_500 * MS)
    assert world.scene.time_s == pytest.approx(1.5, abs=0.002)


def test_an_hour_without_a_listener_is_skipped_at_once(tmp_path: Path) -> None:
    hardware, _ = hardware_in(on_the_pad(tmp_path, GRID), "xela", streaming=True)
    hardware.skip(START_NS)
    hardware.skip(START_NS + 3_600_000 * MS)
    assert hardware.world.scene.time_s < 2.1
    assert hardware.emit(START_NS + 3_600_100 * MS)


@pytest.mark.parametrize(
    ("world", "says"),
    [
        ("bullet:pad", "give mujoco:"),
        ("mujoco:", "give mujoco:"),
        ("mujoco:nowhere", "there are"),
        ("mujoco:nowhere.xml", "no such scene"),
        ("mujoco:nowhere.toml", "nowhere.toml"),
    ],
)
def test_a_world_that_is_not_there_is_refused(world: str, says: str) -> None:
    with pytest.raises(ConfigurationError, match=says):
        EmulatedXela(EmulatedXelaOptions(world=world))


@pytest.mark.parametrize(
    ("module", "more", "says"),
    [
        ("rows = 4\ncolumns = 40", "", "is not above the body"),
        ("rows = 4\ncolumns = 5", "", "has 48 values, not 60"),
        ("rows = 4\ncolumns = 4\ndevice = 9", "", "there is no device 9; there are 1"),
        ("columns = 4", "", "either rows, a geometry or an arm_board"),
        ('rows = 4\naxes = "xq"', "", "axes"),
        ("rows = 4\ntransfer = {nois = 1}", "", "nois"),
        ('geometry = "nowhere.toml"', "", "nowhere.toml"),
        (GRID, "[pose.bad]\nlift = 1\n", "no actuator 'lift'; there are x, y, press"),
        (GRID, "[pose.bad]\npress = nan\n", "is no number"),
        (GRID, '[[move]]\nat_s = 1\npose = "up"\n', "there is no pose 'up'"),
    ],
)
def test_a_binding_that_does_not_fit_is_refused(tmp_path: Path, module: str, more: str, says: str) -> None:
    axes = "" if "axes" in module else '\naxes = "xyz"'
    world = on_the_pad(tmp_path, module + axes, more=more)
    with pytest.raises(ConfigurationError, match=says):
        EmulatedXela(EmulatedXelaOptions(world=world, world_services=False)).skip(START_NS)


def test_a_body_that_is_not_there_and_a_scene_that_is_none_are_refused(tmp_path: Path) -> None:
    world = on_the_pad(tmp_path, GRID)
    file = tmp_path / "binding.toml"
    text = file.read_text()
    file.write_text(text.replace('body = "pad"', 'body = "palm"'))
    with pytest.raises(ConfigurationError, match="has no body 'palm'"):
        PhysicsScene(find_binding(world, "xela"))
    (tmp_path / "bad.xml").write_text("<mujoco><worldbody><geom/></worldbody></mujoco>")
    file.write_text(text.replace(str(PAD), "bad.xml"))
    with pytest.raises(ConfigurationError, match="MuJoCo: "):
        PhysicsScene(find_binding(world, "xela"))


def test_without_mujoco_the_option_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in sys.modules if name.startswith("skinware_drivers.virtual.physics.")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(MissingExtra, match=r"pip install 'skinware\[mujoco\]'"):
        EmulatedXela(EmulatedXelaOptions(world="mujoco:pad"))
