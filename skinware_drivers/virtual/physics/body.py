"""A MuJoCo scene whose contacts press the taxels of emulated devices, in the time of their emulator."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np
import numpy.typing as npt

from skinware.errors import ConfigurationError, PlatformError
from skinware_drivers.virtual.physics.actuators import Actuators, names_of
from skinware_drivers.virtual.physics.binding import Bound
from skinware_drivers.virtual.physics.taxels import BoundTaxels, add_sensors, place, place_sensors

ArrayF = npt.NDArray[np.float64]

_NEAREST = 4
"""Taxels that share the force of a contact which none of them reaches into."""
_SAME_WAY = 0.5
"""Cosine of the largest angle between a contact's normal and that of a taxel which feels it."""
_EPSILON = 1e-9
_NO_SENSORS = int(mujoco.mjtDisableBit.mjDSBL_SENSOR)
_NEXT, _AFTER = np.array([1, 2, 0]), np.array([2, 0, 1])


class Touching(NamedTuple):
    """One contact of a module in the newest step.

    Attributes:
        point_m: (3,) in the frame of its body, m.
        normal: (3,) outwards, in the same frame.
        shear_n: (3,) in the same frame, on the module, N.
        slip_m_s: speed of the other body along the surface, m/s.
        distance_m: (n,) of the module's taxels from it, m; infinite for those that face another way.
    """

    module: int
    point_m: ArrayF
    normal: ArrayF
    normal_n: float
    shear_n: ArrayF
    slip_m_s: float
    distance_m: ArrayF


class PhysicsScene:
    """The physics of a scene and the forces on its taxels.

    Attributes:
        model: MuJoCo's model, with a tactile sensor for each geom under taxels.
        modules: the taxels, in the order of the binding.
        carrier: the body of the binding's ``carrier``; None: it has none.
        notes_touch: keep ``touched_s``, which costs a look at the contacts of each step.
        touched_s: time of the scene when the present touch of modules began; NaN: nothing touches them.
    """

    def __init__(self, bound: Bound) -> None:
        try:
            spec = mujoco.MjSpec.from_file(str(bound.scene))
            bare = spec.compile()
            self.modules: list[BoundTaxels] = [place(bare, module, bound) for module in bound.binding.module]
            add_sensors(spec, self.modules)
            self.model: Any = spec.compile()
            carrier = bound.binding.carrier
            self.carrier: int | None = self.model.body(carrier).id if carrier else None
        except (KeyError, ValueError) as error:
            raise ConfigurationError(f"{bound.scene}: MuJoCo: {error}") from None
        self.data: Any = mujoco.MjData(self.model)
        self._sensors = place_sensors(self.model, self.modules)
        self._feels = np.zeros((len(self.modules), self.model.ngeom), bool)
        for number, module in enumerate(self.modules):
            self._feels[number, module.geoms] = True
        self._is_covered: npt.NDArray[np.bool_] = np.logical_or.reduce(self._feels)
        self._covered: frozenset[int] = frozenset(np.flatnonzero(self._is_covered).tolist())
        self.actuators = Actuators(bound, self.model, self.data)
        self.joints: list[str] = names_of(self.model, mujoco.mjtObj.mjOBJ_JOINT, self.model.njnt)
        self._renderer: Any = None
        self.notes_touch = False
        self.reset()

    def reset(self) -> None:
        """Begin at 0 s: the first key frame of the scene, or else its zero."""
        if self.model.nkey:
            mujoco.mj_resetDataKeyframe(self.model, self.data, 0)
        else:
            mujoco.mj_resetData(self.model, self.data)
        self.actuators.reset()
        self.touched_s = math.nan
        self.settle()

    def settle(self) -> None:
        """Let MuJoCo compute everything that follows from changed positions."""
        self._touching: list[Touching] | None = None
        mujoco.mj_forward(self.model, self.data)

    @property
    def time_s(self) -> float:
        return float(self.data.time)

    def step_to(self, time_s: float) -> int:
        """Step the physics to the last multiple of its time step by then; return the number of steps.

        MuJoCo computes its sensors in the last step alone.
        """
        option = self.model.opt
        step_s, flags, ctrl = option.timestep, option.disableflags, self.data.ctrl
        steps = left = max(0, int((time_s - self.data.time) / step_s + 1e-6))
        if steps:
            self._touching = None
            option.disableflags = flags | _NO_SENSORS
        while left:
            for targets in self.actuators.course(left, step_s):
                left -= 1
                if not left:
                    option.disableflags = flags
                ctrl[:] = targets
                mujoco.mj_step(self.model, self.data)
                if self.notes_touch:
                    self._note_touch(step_s)
        return steps

    def _note_touch(self, step_s: float) -> None:
        if not self.data.ncon or self._covered.isdisjoint(self.data.contact.geom.ravel().tolist()):
            self.touched_s = math.nan
        elif math.isnan(self.touched_s):
            self.touched_s = float(self.data.time) - step_s

    def carried(self) -> ArrayF:
        """Return (4, 4) the pose of the carrier, in the frame of the first module's body, m."""
        pose, here = np.eye(4), self.modules[0].body
        to_here = self.data.xmat[here].reshape(3, 3).T
        pose[:3, :3] = to_here @ self.data.xmat[self.carrier].reshape(3, 3)
        pose[:3, 3] = to_here @ (self.data.xpos[self.carrier] - self.data.xpos[here])
        return pose

    def raw(self, module: int) -> ArrayF:
        """Return (3, n) MuJoCo's own sensor data of a module: depth, m, and its products with two speeds of slip."""
        n = len(self.modules[module].position_m)
        found = np.zeros((3, n))
        for values in self._sensors[module]:
            found += self.data.sensordata[values].reshape(3, -1)[:, :n]
        return found

    def touching(self) -> list[Touching]:
        if self._touching is None:
            self._touching = []
            if self.data.ncon:
                numbers, sides = np.nonzero(self._is_covered[self.data.contact.geom])
                self._touching = self._touches(numbers, sides) if len(numbers) else []
        return self._touching

    def pressed_n(self) -> ArrayF:
        """Return (modules,) the normal force on each module in the newest step, N."""
        touches = self.touching()
        modules, forces = [touch.module for touch in touches], [touch.normal_n for touch in touches]
        return np.bincount(modules, forces, len(self.modules)).astype(np.float64)

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

    def picture(self, width: int, height: int) -> npt.NDArray[np.uint8]:
        """Return (height, width, 3) RGB of the scene, from its first camera.

        Raises:
            PlatformError: MuJoCo draws nothing here.
        """
        try:
            if self._renderer is None:
                self._renderer = mujoco.Renderer(self.model, height, width)
            self._renderer.update_scene(self.data, 0 if self.model.ncam else -1)
            drawn: npt.NDArray[np.uint8] = self._renderer.render()
        except Exception as error:
            raise PlatformError(f"no picture ({error}): start Python with MUJOCO_GL=egl or osmesa") from error
        return drawn

    def close(self) -> None:
        """Give up what pictures need. Idempotent."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def _touches(self, numbers: npt.NDArray[np.intp], sides: npt.NDArray[np.intp]) -> list[Touching]:
        """Return the contacts of these numbers, each felt at one of its two sides, that are near a module's taxels."""
        contact, every = self.data.contact, np.arange(len(numbers))
        pair = contact.geom[numbers]
        geom, body = pair[every, sides], self.model.geom_bodyid[pair]
        place, frame = contact.pos[numbers], contact.frame[numbers].reshape(-1, 3, 3)
        own = body[every, sides]
        sign = np.where(sides == 0, -1.0, 1.0)[:, np.newaxis]
        force = np.zeros((len(numbers), 6))
        for row, number in enumerate(numbers.tolist()):
            mujoco.mj_contactForce(self.model, self.data, number, force[row])
        shear = force[:, 1:2] * frame[:, 1] + force[:, 2:3] * frame[:, 2]
        vectors = np.stack([place - self.data.xpos[own], -sign * frame[:, 0], sign * shear], axis=1)
        point, outward, shear = (vectors @ self.data.xmat[own].reshape(-1, 3, 3)).transpose(1, 0, 2)
        first, second = self._velocities(body, place[:, np.newaxis]).transpose(1, 0, 2)
        slip = _turned(frame[:, 1:], first - second)
        nearest, modules, rows = np.full(len(numbers), np.inf), [-1] * len(numbers), [np.empty(0)] * len(numbers)
        for number, (module, feels) in enumerate(zip(self.modules, self._feels[:, geom], strict=True)):
            felt = np.flatnonzero(feels)
            if not len(felt):
                continue
            distance = distances(module, point[felt], outward[felt])
            for row, of_row, reach in zip(felt.tolist(), distance, distance.min(axis=1).tolist(), strict=True):
                if reach <= module.reach_m and reach < nearest[row]:
                    nearest[row], modules[row], rows[row] = reach, number, of_row
        slip = np.sqrt((slip * slip).sum(axis=1))
        return [
            Touching(module, point[row], outward[row], float(force[row, 0]), shear[row], float(slip[row]), rows[row])
            for row, module in enumerate(modules)
            if module >= 0
        ]

    def _velocities(self, body: npt.NDArray[np.intp], place: ArrayF) -> ArrayF:
        """Return (..., 3) velocities of bodies at places, m/s; all in the world's frame."""
        turning, moving = self.data.cvel[body, :3], self.data.cvel[body, 3:]
        arm = place - self.data.subtree_com[self.model.body_rootid[body]]
        velocities: ArrayF = moving + _crossed(turning, arm)
        return velocities


def _crossed(one: ArrayF, other: ArrayF) -> ArrayF:
    """Return (..., 3) the cross products of vectors; numpy's own takes four times as long for a few."""
    crossed: ArrayF = one[..., _NEXT] * other[..., _AFTER] - one[..., _AFTER] * other[..., _NEXT]
    return crossed


def _turned(rotations: ArrayF, vectors: ArrayF) -> ArrayF:
    turned: ArrayF = (rotations @ vectors[:, :, np.newaxis])[:, :, 0]
    return turned


def distances(taxels: BoundTaxels, point_m: ArrayF, normal: ArrayF) -> ArrayF:
    """Return (k, n) distances of n taxels from k contacts, m; infinite for taxels that face another way.

    Args:
        point_m: (k, 3) of the contacts.
        normal: (k, 3) of them.
    """
    between = taxels.position_m - point_m[:, np.newaxis]
    distance: ArrayF = np.sqrt((between * between).sum(axis=2))
    distance[normal @ taxels.axes[:, 2].T < _SAME_WAY + _EPSILON] = np.inf
    return distance


def spread(taxels: BoundTaxels, depth_m: ArrayF, touches: Sequence[Touching]) -> ArrayF:
    """Return (n, 3) forces on taxels, N: shear along x and y, and normal force.

    The force of a contact is spread over the taxels that are nearest to it, in proportion to their depth. Where none
    of them is inside the other body, the nearest few share it.

    Args:
        depth_m: (n,) by which the other bodies reach beyond each taxel.
    """
    distance = np.array([touch.distance_m for touch in touches])
    nearest = distance.argmin(axis=0)
    every = np.arange(len(nearest))
    weight = np.zeros_like(distance)
    weight[nearest, every] = np.where(np.isfinite(distance[nearest, every]), np.maximum(0.0, depth_m), 0.0)
    for number in np.flatnonzero(weight.sum(axis=1) == 0).tolist():
        rows = np.argsort(distance[number])[:_NEAREST]
        weight[number, rows] = 1 / (distance[number, rows] + 1e-6)
    share = (weight / weight.sum(axis=1)[:, np.newaxis]).T
    force_n = _turned(taxels.axes, share @ np.array([touch.shear_n for touch in touches]))
    force_n[:, 2] = share @ np.array([touch.normal_n for touch in touches])
    return force_n
