"""The scenes that are shipped do what the documentation says, by physics alone."""

from __future__ import annotations

import pytest

pytest.importorskip("mujoco", reason="needs the extra mujoco")

from pathlib import Path

import numpy as np

from skinware_drivers.virtual.hardware import load_emulator
from skinware_drivers.virtual.physics.binding import SCENES, find_binding
from skinware_drivers.virtual.physics.scene import PhysicsScene

from .rig import MS, START_NS
from .scenes import course_of, hardware_in

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


Triple = tuple[float, float, float]

FINGER_TIP, LINK = ((0, 0, 0.013), (0.008, 0.008, 0.0145)), ((0.02, -0.001, 0), (0.026, 0.0095, 0.012))
THUMB_LINK = ((0, 0.02, 0), (0.0095, 0.026, 0.012))
PALM = ((0.089, 0, 0), (0.0475, 0.0165, 0.041))
MENAGERIE: dict[str, dict[str, tuple[Triple, Triple, Triple]]] = {
    "shadow_hand": {f"rh_{finger}distal": (*FINGER_TIP, (0, -1, 0)) for finger in ("ff", "mf", "rf", "lf", "th")},
    "leap_hand": {
        **{
            f"{finger}_ds": ((-0.001, -0.035, 0.0145), (0.0105, 0.015, 0.012), (-1, 0, 0))
            for finger in ("if", "mf", "rf")
        },
        "th_ds": ((-0.001, -0.047, -0.0145), (0.0105, 0.015, 0.012), (-1, 0, 0)),
    },
    "unitree_g1": {
        **{
            f"{side}_hand_{finger}_{number}_link": (*LINK, (0, sign, 0))
            for side, sign in (("left", -1), ("right", 1))
            for finger in ("middle", "index")
            for number in (0, 1)
        },
        **{
            f"{side}_hand_thumb_{number}_link": ((0, sign * THUMB_LINK[0][1], 0), THUMB_LINK[1], (1, 0, 0))
            for side, sign in (("left", -1), ("right", 1))
            for number in (1, 2)
        },
        "left_wrist_yaw_link": (*PALM, (0, -1, 0)),
        "right_wrist_yaw_link": (*PALM, (0, 1, 0)),
    },
}
"""Bodies with taxels, as boxes: middle and half of the size in the frame of the body, m, and the way it bends.

Source: joints, boxes and .obj meshes of google-deepmind/mujoco_menagerie, 4035abd; the sizes of the G1's hands are
those of the meshes in mani_skill 3.0.1.
"""
NUMBERS: dict[str, dict[str, tuple[int, ...]]] = {
    "shadow_hand": {"boards": (1, 2, 3, 4, 5)},
    "leap_hand": {"boards": (1, 2, 3, 4)},
    "unitree_g1": {},
}


def texts(numbers: Triple) -> str:
    return " ".join(map(str, numbers))


@pytest.mark.parametrize("model", MENAGERIE)
def test_a_binding_of_menagerie_feels_on_the_side_to_which_each_finger_bends(model: str, tmp_path: Path) -> None:
    (driver,) = (driver for name, driver in SHIPPED if name == model)
    folder = tmp_path / model
    folder.mkdir()
    bodies = "".join(
        f'<body name="{name}" pos="{number} 0 0"><geom type="box" pos="{texts(place)}" size="{texts(size)}"/></body>'
        for number, (name, (place, size, _)) in enumerate(MENAGERIE[model].items())
    )
    ball = '<body name="ball" pos="0 9 0"><freejoint/><geom size="0.004" mass="0.01"/></body>'
    (folder / "scene.xml").write_text(
        f'<mujoco><option gravity="0 0 0"/><worldbody>{bodies}{ball}</worldbody></mujoco>'
    )
    world = f"mujoco:{folder / 'scene.xml'}"
    hardware_in(world, driver, **NUMBERS[model])[0].skip(START_NS)
    scene = PhysicsScene(find_binding(world, driver))
    assert {module.binding.body for module in scene.modules} == set(MENAGERIE[model])
    for number, module in enumerate(scene.modules):
        outward = np.array(MENAGERIE[model][module.binding.body][2])
        np.testing.assert_allclose(module.axes[:, 2], np.tile(outward, (len(module.axes), 1)), atol=1e-9)
        scene.reset()
        touched = scene.data.xpos[module.body] + module.position_m.mean(axis=0)
        scene.data.joint(0).qpos[:3] = touched + 0.0041 * outward
        scene.data.body("ball").xfrc_applied[:3] = -1.0 * outward
        scene.step_to(0.05)
        newtons = [forces[:, 2].sum() for forces in scene.newtons()]
        assert newtons[number] == pytest.approx(1.0, rel=0.05), module.name
        assert sum(newtons) == newtons[number]
