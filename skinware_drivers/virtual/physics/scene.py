"""A MuJoCo scene in the time of an emulator: what moves it, and its contacts as the taxels of devices feel them."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np
import numpy.typing as npt

from skinware.errors import ConfigurationError, PlatformError
from skinware.native import give_arrays
from skinware_drivers import native
from skinware_drivers.native import structs
from skinware_drivers.virtual.physics.binding import Bound
from skinware_drivers.virtual.physics.taxels import BoundTaxels, add_sensors, place, place_sensors

ArrayF = npt.NDArray[np.float64]

_EPSILON_S = 1e-9
_NO_SENSORS = int(mujoco.mjtDisableBit.mjDSBL_SENSOR)
_FEWEST = 64
_WIDTHS = {"geom": 2, "place": 3, "frame": 9, "force": 6}
_FOUND = {"module": 1, "point_m": 3, "normal": 3, "normal_n": 1, "shear_n": 3, "slip_m_s": 1}


def names_of(model: Any, kind: Any, count: int) -> list[str]:
    """Return the names of MuJoCo's objects of a kind; the number of one that has no name."""
    names = [mujoco.mj_id2name(model, kind, number) for number in range(count)]
    return [str(number) if name is None else name for number, name in enumerate(names)]


class Actuators:
    """The targets of a scene's actuators.

    Attributes:
        poses: targets of actuators, by name of the pose.
        commanded_s: time of the scene at the newest command from outside; NaN: there was none.
    """

    def __init__(self, bound: Bound, model: Any, data: Any) -> None:
        self.names: list[str] = names_of(model, mujoco.mjtObj.mjOBJ_ACTUATOR, model.nu)
        self.poses: Mapping[str, Mapping[str, float]] = bound.binding.pose
        self._data, self._ctrl = data, data.ctrl
        self._moves, self._repeat_s = bound.binding.move, bound.binding.repeat_s
        self._ramps: dict[int, tuple[float, float, float, float]] = {}  # actuator -> begin, end, from, to
        self.reset()
        for name, pose in self.poses.items():
            self.check(pose, f"{bound.file}: pose {name!r}")

    def reset(self) -> None:
        self.commanded_s = math.nan
        self._next_move = self._round = 0
        self._ramps.clear()

    def move(self, targets: Mapping[str, float], seconds: float = 0.0) -> None:
        self.check(targets, "move")
        if not 0 <= seconds <= 3600:
            raise ConfigurationError(f"move: {seconds} s: give 0 to 3600")
        now_s = float(self._data.time)
        for name, target in targets.items():
            actuator = self.names.index(name)
            self._ramps[actuator] = now_s, now_s + seconds, float(self._ctrl[actuator]), float(target)

    def hold(self) -> None:
        """Stop every movement: the actuators keep the targets that they have."""
        self._ramps.clear()

    def drive(self) -> None:
        """Set the targets of the step that begins now."""
        now_s, ctrl = self._data.time, self._ctrl
        if self._next_move < len(self._moves):
            self._begin_moves(now_s)
        for actuator, (begin_s, end_s, start, target) in list(self._ramps.items()):
            if now_s >= end_s:
                ctrl[actuator] = target
                del self._ramps[actuator]
            else:
                ctrl[actuator] = start + (now_s - begin_s) / (end_s - begin_s) * (target - start)

    def _begin_moves(self, now_s: float) -> None:
        while self._next_move < len(self._moves):
            move = self._moves[self._next_move]
            if now_s + _EPSILON_S < move.at_s + self._round * (self._repeat_s or 0.0):
                return
            self.move(self.poses[move.pose], move.seconds)
            self._next_move += 1
            if self._next_move == len(self._moves) and self._repeat_s is not None:
                self._next_move = 0
                self._round += 1

    def check(self, targets: Mapping[str, Any], where: str) -> None:
        for name, target in targets.items():
            if name not in self.names:
                raise ConfigurationError(f"{where}: there is no actuator {name!r}; there are {', '.join(self.names)}")
            if isinstance(target, bool) or not isinstance(target, int | float) or not math.isfinite(target):
                raise ConfigurationError(f"{where}: {name}={target!r} is no number")


class Touching(NamedTuple):
    """One contact of a module in the newest step.

    Attributes:
        point_m: (3,) in the frame of its body, m.
        normal: (3,) outwards, in the same frame.
        shear_n: (3,) in the same frame, on the module, N.
        slip_m_s: speed of the other body along the surface, m/s.
    """

    module: int
    point_m: ArrayF
    normal: ArrayF
    normal_n: float
    shear_n: ArrayF
    slip_m_s: float


class SceneContacts:
    """Finds which contacts of a scene its modules feel, and spreads their forces over taxels; ``native/touching.c``.

    Args:
        sensors: where the data of each module's tactile sensors begin.
    """

    def __init__(self, model: Any, data: Any, modules: Sequence[BoundTaxels], sensors: Sequence[Sequence[int]]) -> None:
        library = native.library().quick
        self._find, self._spread = library.skinware_touching_find, library.skinware_touching_spread
        self._find.restype = ctypes.c_int64
        self._model, self._data = model, data
        counts = [len(module.position_m) for module in modules]
        self._first = np.cumsum([0, *counts])
        feels = np.zeros((len(modules), model.ngeom), bool)
        for number, module in enumerate(modules):
            feels[number, module.geoms] = True
        sensor_module = np.repeat(np.arange(len(modules)), [len(of_module) for of_module in sensors])
        own: dict[str, npt.NDArray[Any]] = {
            "feels": feels,
            "first": self._first,
            "body": model.geom_bodyid.astype(np.int64),
            "root": model.body_rootid.astype(np.int64),
            "sensor_module": sensor_module,
            "sensor_at": np.concatenate(sensors).astype(np.int64),
            "reach_m": np.array([module.reach_m for module in modules]),
            "position_m": np.concatenate([module.position_m for module in modules]),
            "axes": np.concatenate([module.axes for module in modules]),
            "xpos": data.xpos,
            "xmat": data.xmat,
            "cvel": data.cvel,
            "com": data.subtree_com,
            "sensordata": data.sensordata,
        }
        n = int(self._first[-1])
        self._words = structs.Touching(
            n_modules=len(modules), n_geoms=model.ngeom, n_taxels=n, n_sensors=len(sensor_module)
        )
        self._at = ctypes.byref(self._words)
        self._most = 0
        self._kept = give_arrays(self._words, n, {"felt_n": 3 * n}, own)
        self._make_room(_FEWEST)

    def touches(self) -> list[Touching]:
        """Return what the modules feel of the contacts of the newest step."""
        n = int(self._data.ncon)
        if not n:
            return []
        if n > self._most:
            self._make_room(2 * n)
        contact, kept = self._data.contact, self._kept
        kept["geom"][:n], kept["place"][:n], kept["frame"][:n] = contact.geom, contact.pos, contact.frame
        for number, force in enumerate(kept["force"][:n]):
            mujoco.mj_contactForce(self._model, self._data, number, force)
        found = self._find(self._at, ctypes.c_int64(n))
        module, point_m, normal, normal_n, shear_n, slip_m_s = (kept[name][:found].copy() for name in _FOUND)
        rows = zip(module.tolist(), point_m, normal, normal_n.tolist(), shear_n, slip_m_s.tolist(), strict=True)
        return [Touching(*row) for row in rows]

    def spread(self, n: int) -> list[ArrayF]:
        """Return (taxels, 3) the forces of ``n`` touches, which ``touches`` found last, on each module's taxels, N."""
        self._spread(self._at, ctypes.c_int64(n))
        felt_n = self._kept["felt_n"].reshape(-1, 3).copy()
        return [felt_n[first:end] for first, end in zip(self._first, self._first[1:], strict=False)]

    def _make_room(self, most: int) -> None:
        """Make memory for so many contacts, each of which may be felt at both of its sides."""
        self._most = most
        for name, width in _WIDTHS.items():
            self._kept[name] = np.zeros((most, width), np.int64 if name == "geom" else np.float64)
        for name, width in _FOUND.items():
            shape = (2 * most + 1,) if width == 1 else (2 * most + 1, width)
            self._kept[name] = np.zeros(shape, np.int64 if name == "module" else np.float64)
        for name in (*_WIDTHS, *_FOUND):
            setattr(self._words, name, self._kept[name].ctypes.data)


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
        sensors = place_sensors(self.model, self.modules)
        self._contacts = SceneContacts(self.model, self.data, self.modules, sensors)
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
        step_s, flags = option.timestep, option.disableflags
        steps = max(0, int((time_s - self.data.time) / step_s + 1e-6))
        if steps:
            self._touching = None
            option.disableflags = flags | _NO_SENSORS
        for left in reversed(range(steps)):
            if not left:
                option.disableflags = flags
            self.actuators.drive()
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
