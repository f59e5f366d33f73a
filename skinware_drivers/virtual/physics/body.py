"""A MuJoCo scene whose contacts press the taxels of emulated devices, in the time of their emulator."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np
import numpy.typing as npt

from skinware.errors import ConfigurationError
from skinware_drivers.virtual.physics.actuators import Actuators, names_of
from skinware_drivers.virtual.physics.binding import Bound
from skinware_drivers.virtual.physics.taxels import BoundTaxels, add_sensors, place, place_sensors

ArrayF = npt.NDArray[np.float64]

_NEAREST = 4
"""Taxels that share the force of a contact which none of them reaches into."""
_SAME_WAY = 0.5
"""Cosine of the largest angle between a contact's normal and that of a taxel which feels it."""
_EPSILON = 1e-9


class Touching(NamedTuple):
    """One contact of a module in the newest step.

    Attributes:
        module: number of the module.
        point_m: (3,) in the frame of its body, m.
        normal: (3,) outwards, in the same frame.
        normal_n: N.
        shear_n: (3,) in the same frame, on the module, N.
        slip_m_s: speed of the other body along the surface, m/s.
    """

    module: int
    point_m: ArrayF
    normal: ArrayF
    normal_n: float
    shear_n: ArrayF
    slip_m_s: float


class PhysicsScene:
    """The physics of a scene and the forces on its taxels.

    Attributes:
        model: MuJoCo's model, with a tactile sensor for each geom under taxels.
        data: MuJoCo's state.
        modules: the taxels, in the order of the binding.
        actuators: what moves in it.
        joints: names of its joints.
        touched_s: time of the scene when the present touch of modules began; NaN: nothing touches them.
    """

    def __init__(self, bound: Bound) -> None:
        try:
            spec = mujoco.MjSpec.from_file(str(bound.scene))
            bare = spec.compile()
            self.modules: list[BoundTaxels] = [place(bare, module, bound) for module in bound.binding.module]
            add_sensors(spec, self.modules)
            self.model: Any = spec.compile()
        except ValueError as error:
            raise ConfigurationError(f"{bound.scene}: MuJoCo: {error}") from None
        self.data: Any = mujoco.MjData(self.model)
        self._sensors = place_sensors(self.model, self.modules)
        self._module_of: dict[int, list[int]] = {}
        for number, module in enumerate(self.modules):
            for geom in module.geoms.tolist():
                self._module_of.setdefault(geom, []).append(number)
        self.actuators = Actuators(bound, self.model, self.data)
        self.joints: list[str] = names_of(self.model, mujoco.mjtObj.mjOBJ_JOINT, self.model.njnt)
        self._touching: list[Touching] | None = None
        self._is_covered = np.zeros(self.model.ngeom, bool)
        self._is_covered[list(self._module_of)] = True
        self.touched_s = math.nan
        if self.model.nkey:
            mujoco.mj_resetDataKeyframe(self.model, self.data, 0)
        mujoco.mj_forward(self.model, self.data)

    @property
    def time_s(self) -> float:
        """The time of the scene, s."""
        return float(self.data.time)

    def step_to(self, time_s: float) -> int:
        """Step the physics to the last multiple of its time step by then; return the number of steps."""
        step_s = self.model.opt.timestep
        steps = int((time_s - self.data.time) / step_s + 1e-6)
        for _ in range(steps):
            self.actuators.advance()
            mujoco.mj_step(self.model, self.data)
            self._touching = None
            if not self._is_covered[self.data.contact.geom].any():
                self.touched_s = math.nan
            elif math.isnan(self.touched_s):
                self.touched_s = float(self.data.time) - step_s
        return max(0, steps)

    def raw(self, module: int) -> ArrayF:
        """Return (3, n) MuJoCo's own sensor data of a module: depth, m, and its products with two speeds of slip."""
        n = len(self.modules[module].position_m)
        found = np.zeros((3, n))
        for values in self._sensors[module]:
            found += self.data.sensordata[values].reshape(3, -1)[:, :n]
        return found

    def touching(self) -> list[Touching]:
        """Return the contacts of all modules in the newest step."""
        if self._touching is not None:
            return self._touching
        found = self._touching = []
        for number in range(self.data.ncon):
            contact = self.data.contact[number]
            for side, sign in ((0, -1.0), (1, 1.0)):
                geom = int(contact.geom[side])
                if geom in self._module_of and (felt := self._touch(number, contact, geom, side, sign)) is not None:
                    found.append(felt)
        return found

    def newtons(self) -> list[ArrayF]:
        """Return (n, 3) the forces on each module's taxels in the newest step: shear along x and y, and normal, N.

        MuJoCo's depths say how a contact's force, which the solver knows, is spread over the taxels nearest to it.
        """
        forces = [np.zeros((len(module.position_m), 3)) for module in self.modules]
        by_module: dict[int, list[Touching]] = {}
        for touch in self.touching():
            by_module.setdefault(touch.module, []).append(touch)
        for number, touches in by_module.items():
            forces[number] = spread(self.modules[number], self.raw(number)[0], touches)
        return forces

    def _touch(self, number: int, contact: Any, geom: int, side: int, sign: float) -> Touching | None:
        force = np.zeros(6)
        mujoco.mj_contactForce(self.model, self.data, number, force)
        body = int(self.model.geom_bodyid[geom])
        rotation = self.data.xmat[body].reshape(3, 3)
        place = contact.pos
        point = rotation.T @ (place - self.data.xpos[body])
        frame = contact.frame.reshape(3, 3)
        outward = rotation.T @ (-sign * frame[0])
        reach = [distances(self.modules[m], point, outward).min() for m in self._module_of[geom]]
        module = self._module_of[geom][int(np.argmin(reach))]
        if min(reach) > self.modules[module].reach_m:
            return None
        shear = sign * (frame[1:].T @ force[1:3])
        speeds, turning = [], np.empty(3)
        for other in (geom, int(contact.geom[1 - side])):
            six = np.zeros(6)
            mujoco.mj_objectVelocity(self.model, self.data, mujoco.mjtObj.mjOBJ_GEOM, other, six, 0)
            mujoco.mju_cross(turning, six[:3], place - self.data.geom_xpos[other])
            speeds.append(six[3:] + turning)
        slip = frame[1:] @ (speeds[1] - speeds[0])
        return Touching(module, point, outward, float(force[0]), rotation.T @ shear, float(np.linalg.norm(slip)))


def distances(taxels: BoundTaxels, point_m: ArrayF, normal: ArrayF) -> ArrayF:
    """Return (n,) distances of taxels from a contact, m; infinite for those that face another way."""
    distance: ArrayF = np.linalg.norm(taxels.position_m - point_m, axis=1)
    distance[taxels.axes[:, 2] @ normal < _SAME_WAY + _EPSILON] = np.inf
    return distance


def spread(taxels: BoundTaxels, depth_m: ArrayF, touches: Sequence[Touching]) -> ArrayF:
    """Return (n, 3) forces on taxels, N: shear along x and y, and normal force.

    The force of a contact is spread over the taxels that are nearest to it, in proportion to their depth. Where none
    of them is inside the other body, the nearest few share it.

    Args:
        depth_m: (n,) by which the other bodies reach beyond each taxel.
    """
    force_n = np.zeros((len(depth_m), 3))
    distance = np.stack([distances(taxels, touch.point_m, touch.normal) for touch in touches], axis=1)
    nearest = distance.argmin(axis=1)
    for number, touch in enumerate(touches):
        rows = np.flatnonzero((nearest == number) & (depth_m > 0) & np.isfinite(distance[:, number]))
        weight = depth_m[rows]
        if not len(rows):
            rows = np.argsort(distance[:, number])[:_NEAREST]
            weight = 1 / (distance[rows, number] + 1e-6)
        share = (weight / weight.sum())[:, np.newaxis]
        whole = taxels.axes[rows] @ touch.shear_n
        whole[:, 2] = touch.normal_n
        force_n[rows] += share * whole
    return force_n
