"""A body that presses its own skin with its own finger, where it wants to by its joints."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt

from skinware.tactile import Baseline
from skinware.tactile.calibration.finger import place_finger
from skinware.tactile.calibration.placing import Placement
from skinware.tactile.calibration.shapes import shapes_of
from skinware.tactile.calibration.state import PressSession
from skinware_drivers.virtual.physics.world import PhysicsWorld

ArrayF = npt.NDArray[np.float64]

RADIUS_M, TIP_M = 0.004, (0.002, 0.022, -0.001)
RESTS_S, PRESS_S = 8.0, 1.0
"""Time without touch, in which baselines begin; and from press to press."""
_FRAME_NS = 20_000_000
_LOW = (-0.011, -0.0045, 0.01)
_HIGH = (0.011, 0.0045, 0.01)
_START = (0.0, 0.0, 0.8, -0.8, -0.3)
_UP = np.array([0.0, 0.0, 1.0])
_ABOVE_M, _INTO_M = 0.006, 0.0015

SCENE = f"""
<mujoco model="self">
  <compiler angle="radian"/>
  <option timestep="0.002" cone="elliptic" impratio="10"/>
  <default>
    <geom friction="0.8 0.005 0.0001" solref="-2500 -40" solimp="0.9 0.9 0.001" density="1500"/>
    <joint axis="1 0 0" damping="0.05" armature="0.002" range="-2.4 2.4" limited="true"/>
    <position kp="8" dampratio="1" ctrlrange="-2.4 2.4" forcerange="-3 3"/>
    <default class="bone">
      <geom type="capsule" size="0.004" contype="0" conaffinity="0"/>
    </default>
  </default>
  <worldbody>
    <body name="palm" pos="0.1 0.2 0.3" euler="0.4 -0.3 0.7">
      <geom name="palm" type="box" size="0.03 0.03 0.01"/>
      <body name="base" pos="0 -0.05 0.02">
        <joint name="yaw" axis="0 0 1"/>
        <joint name="turn" axis="0 1 0" range="-0.8 0.8"/>
        <joint name="lift"/>
        <geom class="bone" fromto="0 0 0 0 0.045 0"/>
        <body name="middle" pos="0 0.045 0">
          <joint name="bend"/>
          <geom class="bone" fromto="0 0 0 0 0.035 0"/>
          <body name="tip" pos="0 0.035 0">
            <joint name="curl"/>
            <geom class="bone" fromto="0 0 0 0 0.02 0"/>
            <geom type="sphere" size="{RADIUS_M}" pos="{TIP_M[0]} {TIP_M[1]} {TIP_M[2]}"/>
            <site name="tip" pos="{TIP_M[0]} {TIP_M[1]} {TIP_M[2]}"/>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="yaw" joint="yaw"/>
    <position name="turn" joint="turn"/>
    <position name="lift" joint="lift"/>
    <position name="bend" joint="bend"/>
    <position name="curl" joint="curl"/>
  </actuator>
</mujoco>
"""
BINDING = """
format = "skinware-binding"
version = 1
scene = "self.xml"
carrier = "tip"
transfer = {counts_per_n = 3000, saturation_n = 6.0, gain_spread = 0.1, crosstalk = 0.2, hysteresis = 0.05, noise = 3.0}
module = [
    {body = "palm", name = "left", rows = 4, columns = 4, at_m = [-0.0065, 0.0, 0.01], axes = "xyz"},
    {body = "palm", name = "right", device = 2, rows = 4, columns = 4, at_m = [0.0065, 0.0, 0.01], axes = "xyz"},
]
"""


def self_touch(folder: Path, presses: int, seed: int) -> str:
    """Write a scene and a binding that presses its skin at random places; return the world."""
    model = mujoco.MjModel.from_xml_string(SCENE)
    random, text = np.random.default_rng(seed), [BINDING]
    names = [model.actuator(number).name for number in range(model.nu)]

    def pose(name: str, joints: ArrayF) -> None:
        text.append(f"[pose.{name}]\n" + "".join(f"{of} = {at:.6f}\n" for of, at in zip(names, joints, strict=True)))

    def move(at_s: float, name: str, seconds: float) -> None:
        text.append(f'[[move]]\nat_s = {at_s:.3f}\npose = "{name}"\nseconds = {seconds}\n')

    pose("start", np.array(_START))
    move(0, "start", 0.0)
    for number in range(presses):
        above, into = _reached(model, random)
        pose(f"above{number}", above)
        pose(f"into{number}", into)
        begin_s = RESTS_S + PRESS_S * number
        move(begin_s, f"above{number}", 0.3 * PRESS_S)
        move(begin_s + 0.35 * PRESS_S, f"into{number}", 0.15 * PRESS_S)
        move(begin_s + 0.9 * PRESS_S, f"above{number}", 0.1 * PRESS_S)
    (folder / "self.xml").write_text(SCENE)
    (folder / "self.toml").write_text("\n".join(text))
    return f"mujoco:{folder / 'self.toml'}"


def gathered(world: PhysicsWorld, presses: int, pose: Callable[[], ArrayF | None]) -> PressSession:
    """Let a world of :func:`self_touch` run, and gather what its devices feel and the poses of its finger."""
    n = sum(len(module.position_m) for module in world.scene.modules)
    baseline, session = Baseline(np.zeros(n, int), np.zeros(n, int)), PressSession(n, 5, (4, 4))
    world.advance(0)
    for time_ns in range(_FRAME_NS, round((RESTS_S + presses * PRESS_S) * 1e9), _FRAME_NS):
        world.advance(time_ns)
        felt = np.concatenate([world.added(device, time_ns, 3 * n // 2)[2::3] for device in (1, 2)])
        session.take(time_ns, baseline.update(time_ns, 1000 + np.rint(felt)).value, pose())
    return session


def placed(world: PhysicsWorld, session: PressSession, offset_m: float) -> tuple[Placement, ArrayF]:
    """Return the places by presses and a layout that knows shapes only, and (n, 3) m how far they are off."""
    modules = world.scene.modules
    place_m = np.concatenate([module.position_m for module in modules])
    normal = np.concatenate([module.axes[:, 2] for module in modules])
    turn = np.linalg.qr(np.random.default_rng(2).normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    of_taxel = np.repeat(range(len(modules)), [len(module.position_m) for module in modules])
    shapes = shapes_of(of_taxel, [""] * len(modules), place_m @ turn, normal @ turn)
    found = place_finger(session.presses, shapes, offset_m=offset_m)
    return found, found.position_m - place_m


def _reached(model: Any, random: np.random.Generator) -> tuple[ArrayF, ArrayF]:
    """Return joints with the tip above a random place of the palm, and with it a little within."""
    while True:
        place = random.uniform(_LOW, _HIGH)
        joints = _START + random.normal(0, 0.4, model.nv)
        above = _solved(model, place + (RADIUS_M + _ABOVE_M) * _UP, joints)
        into = None if above is None else _solved(model, place + (RADIUS_M - _INTO_M) * _UP, above)
        if above is not None and into is not None:
            return above, into


def _solved(model: Any, place: ArrayF, joints: ArrayF) -> ArrayF | None:
    """Return joints that bring the tip to a place in the frame of the palm, from others near them; None: not found."""
    data, jacobian = mujoco.MjData(model), np.zeros((3, model.nv))
    palm, site = model.body("palm").id, model.site("tip").id
    for _ in range(100):
        data.qpos[:] = joints
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        off = data.xpos[palm] + data.xmat[palm].reshape(3, 3) @ place - data.site_xpos[site]
        if np.linalg.norm(off) < 1e-5:
            return joints
        mujoco.mj_jacSite(model, data, jacobian, None, site)
        step = jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + 1e-7 * np.eye(3), off)
        joints = np.clip(joints + step, *model.jnt_range.T)
    return None
