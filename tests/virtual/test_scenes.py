"""The scenes that are shipped do what the documentation says, by physics alone."""

from __future__ import annotations

import pytest

pytest.importorskip("mujoco", reason="needs the extra mujoco")

import numpy as np

from skinware_drivers.virtual.hardware import load_emulator
from skinware_drivers.virtual.physics.binding import SCENES, find_binding
from skinware_drivers.virtual.physics.body import PhysicsScene

from .rig import MS, START_NS
from .scenes import course_of

SHIPPED = sorted(path.name.removesuffix(".toml").split(".") for path in SCENES.glob("*.toml"))


def scene_of(name: str, driver: str) -> PhysicsScene:
    return PhysicsScene(find_binding(f"mujoco:{name}", driver))


def body_at(scene: PhysicsScene, name: str) -> list[float]:
    place: list[float] = scene.data.body(name).xpos.tolist()
    return place


@pytest.mark.parametrize(("name", "driver"), [names for names in SHIPPED if (SCENES / f"{names[0]}.xml").exists()])
def test_every_shipped_binding_fits_its_devices(name: str, driver: str) -> None:
    emulator = load_emulator(driver)
    hardware = emulator(emulator.Options(world=f"mujoco:{name}", world_services=False))
    hardware.skip(START_NS)
    hardware.emit(START_NS + 50 * MS)


def test_the_gripper_lifts_slips_drops_and_hands_over() -> None:
    scene = scene_of("gripper", "robotiq_tsf")
    height, slips, forces = {}, {}, {}
    for time_s, force_n, touches in course_of(scene, 21):
        height[round(time_s, 2)] = body_at(scene, "cup")[2]
        slips[round(time_s, 2)] = max((touch.slip_m_s for touch in touches), default=0.0)
        forces[round(time_s, 2)] = force_n
    assert height[3.9] == pytest.approx(0.05, abs=0.001)
    assert min(forces[3.9]) > 3
    assert height[5.8] > 0.15, "lifted"
    assert max(slips[time_s] for time_s in slips if 5.2 < time_s < 6) < 0.005
    assert max(slips[time_s] for time_s in slips if 6.2 < time_s < 6.8) > 0.05, "it slips"
    assert height[7.9] == pytest.approx(0.05, abs=0.002), "and drops"
    assert sum(forces[7.9]) == 0
    assert height[14] > 0.15, "lifted once more"
    _, y, z = body_at(scene, "cup")
    assert y == pytest.approx(0.2, abs=0.01), "the tray has it"
    assert z > 0.14


def test_the_hand_grasps_with_all_fingers_and_lets_go() -> None:
    scene = scene_of("hand", "inspire")
    assert sum(len(module.position_m) for module in scene.modules) == 1062
    by_time = {round(time_s, 2): force_n for time_s, force_n, _ in course_of(scene, 14.5)}
    names = [module.name for module in scene.modules]
    for finger in ("little", "ring", "middle", "index", "thumb"):
        assert sum(by_time[10][row] for row, name in enumerate(names) if name.startswith(finger)) > 1
        assert sum(by_time[14.4][row] for row, name in enumerate(names) if name.startswith(finger)) == 0
    palm = names.index("palm")
    assert by_time[7][palm] == pytest.approx(0.2 * 9.81, rel=0.02), "the weight of the bottle"
    assert by_time[10][palm] > 10


def test_the_forearm_is_stroked_bumped_and_held() -> None:
    scene = scene_of("forearm", "roboskin")
    x, slips, force = {}, {}, {}
    for time_s, force_n, touches in course_of(scene, 16):
        at = round(time_s, 2)
        force[at], slips[at] = force_n, max((touch.slip_m_s for touch in touches), default=0.0)
        x[at] = [touch.point_m[0] for touch in touches]
    assert slips[8] == pytest.approx(0.08 / 3, rel=0.05)
    assert np.ptp([x[at][0] for at in x if 7.2 < at < 9.8]) > 0.06
    bump = [sum(force[at]) for at in force if 12 <= at < 13]
    assert max(bump) > 4
    assert bump[-1] == 0
    assert force[15.5][:2] == pytest.approx([6, 6], rel=0.05), "held from both sides"


def test_roboskin_boards_show_where_physics_strokes_them() -> None:
    emulator = load_emulator("roboskin")
    options = emulator.Options(world="mujoco:forearm", world_services=False, streaming=True)
    hardware = emulator(options)
    hardware.skip(START_NS)
    pressed: dict[tuple[int, int], int] = {}
    for step in range(1, 2000):
        for frame in hardware.emit(START_NS + step * 5 * MS):
            board, triangle = frame.identifier >> 4 & 0xF, frame.identifier & 0xF
            if frame.identifier >> 8 == 4 and frame.payload[0] & 0x80 == 0 and step > 1300:
                least = min(frame.payload[1:8])
                pressed[board, triangle] = min(pressed.get((board, triangle), 255), least)
    touched = {place for place, least in pressed.items() if least < 215}
    assert touched, "a stroke"
    assert {board for board, _ in touched} == {7}
    assert len(touched) >= 4, "it crosses triangles"
    untouched = [least for (board, _), least in pressed.items() if board != 7]
    assert min(untouched) > 228, "no other board feels it"
