"""A MuJoCo scene whose contacts press the taxels of emulated devices, in the time of their emulator."""

from __future__ import annotations

import math
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt

from skinware.errors import ConfigurationError, PlatformError
from skinware_drivers.virtual.physics.actuators import Actuators, names_of
from skinware_drivers.virtual.physics.binding import Bound
from skinware_drivers.virtual.physics.contacts import SceneContacts, Touching
from skinware_drivers.virtual.physics.taxels import BoundTaxels, add_sensors, place, place_sensors

ArrayF = npt.NDArray[np.float64]

_NO_SENSORS = int(mujoco.mjtDisableBit.mjDSBL_SENSOR)


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
        self._contacts = SceneContacts(self.model, self.data, self.modules, self._sensors)
        covered = np.concatenate([module.geoms for module in self.modules])
        self._covered: frozenset[int] = frozenset(covered.tolist())
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
            self._touching = self._contacts.touches()
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
        return self._contacts.spread(len(self.touching()))

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
