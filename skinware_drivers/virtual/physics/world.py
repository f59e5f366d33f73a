"""A scene as emulated devices feel it: its time, their values, and the services beside it."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from skinware.errors import ConfigurationError
from skinware.memory.schema import Column
from skinware.realtime import NS_PER_S, now_ns
from skinware.service import ServiceWriter
from skinware_drivers.virtual.physics.binding import Bound
from skinware_drivers.virtual.physics.scene import PhysicsScene
from skinware_drivers.virtual.physics.transfer import Transfer

TRUTH, JOINTS, POSE = "truth", "joints", "pose"
RATE_HZ = 100
_MOST = 32
_LONGEST_NAME = 64


class WorldServices:
    """Publish what is true in a scene and where its joints are, 100 times a second, and take commands.

    Raises:
        NameInUse: another world publishes here.
    """

    def __init__(self, scene: PhysicsScene) -> None:
        self._scene = scene
        scene.notes_touch = True
        self._due_ns = 0
        n, joints, actuators = len(scene.modules), len(scene.joints), len(scene.actuators.names)

        def floats(shape: tuple[int, ...], unit: str, description: str) -> Column:
            return Column(np.dtype("<f8"), shape, unit, description)

        self._truth = ServiceWriter(
            TRUTH,
            {
                "count": Column(np.dtype("<u4"), (1,), "", "number of contacts; later rows are old"),
                "point_m": floats((_MOST, 3), "m", "of each contact, in the frame of its module's body"),
                "normal_n": floats((_MOST,), "N", "of each"),
                "shear_n": floats((_MOST, 3), "N", "of each, on the module"),
                "slip_m_s": floats((_MOST,), "m/s", "speed of the other body along the surface"),
                "module": Column(np.dtype("<u4"), (_MOST,), "", "of each, a row of module_name"),
                "module_n": floats((n,), "N", "normal force on each module"),
                "force_n": floats((1,), "N", "normal force on all modules"),
                "touched_s": floats((1,), "s", "time of the scene when the present touch began; NaN: none"),
                "scene_s": floats((1,), "s", "time of the scene"),
                "lag_s": floats((1,), "s", "by which the physics is behind"),
            },
            {"module_name": _texts([module.name for module in scene.modules])},
            rate_hz=RATE_HZ,
            description="contacts of a simulated scene",
        )
        self._joints = ServiceWriter(
            JOINTS,
            {
                "position": floats((max(1, joints),), "", "of each joint, rad or m"),
                "velocity": floats((max(1, joints),), "", "of each joint, rad/s or m/s"),
                "target": floats((max(1, actuators),), "", "of each actuator"),
                "commanded_s": floats((1,), "s", "time of the scene at the newest command; NaN: none yet"),
                **({} if scene.carrier is None else {POSE: floats((4, 4), "m", "pose of the binding's carrier")}),
            },
            {
                "joint_name": _texts(scene.joints),
                "actuator_name": _texts(scene.actuators.names),
                "pose_name": _texts(list(scene.actuators.poses)),
            },
            rate_hz=RATE_HZ,
            description="joints of a simulated scene",
            operations={"move": self.move, "hold": self.hold},
        )

    def serve(self, time_ns: int) -> None:
        """Carry out commands, and publish what is due.

        Args:
            time_ns: of the physics, CLOCK_MONOTONIC ns.
        """
        waiting = [*self._truth.answer_requests(), *self._joints.answer_requests()]
        if waiting or time_ns >= self._due_ns:
            self._publish(time_ns)
            self._due_ns = time_ns + NS_PER_S // RATE_HZ
        for request in waiting:
            request.reply(position=self._truth.position)

    def move(self, pose: str = "", targets: dict[str, float] | None = None, seconds: float = 0.0) -> None:
        """Move to a pose, or actuators to targets, within a time.

        Raises:
            ValueError: there is no such pose.
            ConfigurationError: there is no such actuator, or a number is none.
        """
        if pose and pose not in self._scene.actuators.poses:
            raise ValueError(f"there is no pose {pose!r}; there are {', '.join(self._scene.actuators.poses)}")
        self._scene.actuators.commanded_s = self._scene.time_s
        self._scene.actuators.move({**(self._scene.actuators.poses[pose] if pose else {}), **(targets or {})}, seconds)

    def hold(self) -> None:
        """Stop every movement: actuators keep the targets that they have now."""
        self._scene.actuators.commanded_s = self._scene.time_s
        self._scene.actuators.hold()

    def close(self) -> None:
        self._truth.close()
        self._joints.close()

    def _publish(self, time_ns: int) -> None:
        scene = self._scene
        touches = scene.touching()
        columns = self._truth.begin(from_last=True)
        columns["module_n"][:] = scene.pressed_n()
        columns["force_n"][0] = columns["module_n"].sum()
        for name in ("point_m", "normal_n", "shear_n", "slip_m_s", "module") if touches else ():
            columns[name][: len(touches)] = [getattr(touch, name) for touch in touches[:_MOST]]
        columns["count"][0] = min(len(touches), _MOST)
        columns["touched_s"][0], columns["scene_s"][0] = scene.touched_s, scene.time_s
        columns["lag_s"][0] = (now_ns() - time_ns) / NS_PER_S
        self._truth.commit(time_ns)
        columns = self._joints.begin(from_last=True)
        columns["position"][: len(scene.joints)] = scene.data.qpos[scene.model.jnt_qposadr]
        columns["velocity"][: len(scene.joints)] = scene.data.qvel[scene.model.jnt_dofadr]
        columns["target"][: len(scene.actuators.names)] = scene.data.ctrl
        columns["commanded_s"][0] = scene.actuators.commanded_s
        if scene.carrier is not None:
            columns[POSE][:] = scene.carried()
        self._joints.commit(time_ns)


def _texts(names: list[str]) -> Any:
    return np.array([name.encode()[:_LONGEST_NAME] for name in names] or [b""], f"|S{_LONGEST_NAME}")


ArrayF = npt.NDArray[np.float64]
Rows = npt.NDArray[np.int64]

_LONGEST_CATCH_UP_S = 1.0
"""Time that the physics makes up for; it leaves out more."""
_AXES = "xyz"


class PhysicsWorld:
    """A scene that presses the devices of one emulator.

    Args:
        speed: seconds of the scene in a second of the devices.
        has_services: publish the services ``truth`` and ``joints``.

    Attributes:
        origin_ns: when the scene was at 0 s; later, once it has left time out.
        advanced_ns: time of the devices of the newest call of ``advance``.
        left_out_s: time of the scene that it left out because nothing called it.
    """

    def __init__(self, bound: Bound, *, seed: int = 0, speed: float = 1.0, has_services: bool = False) -> None:
        self.scene = PhysicsScene(bound)
        self._speed = speed
        self._bound = bound
        # device -> modules, which values of the device are theirs, and where in their counts those are
        self._of_device: dict[int, list[tuple[int, Rows, Rows]]] = {}
        next_value: dict[int, int] = {}
        for number, module in enumerate(self.scene.modules):
            device, axes = module.binding.device, module.binding.axes
            first = next_value.get(device, 0) if module.binding.first is None else module.binding.first
            next_value[device] = first + len(axes) * len(module.position_m)
            taxel, place = np.divmod(np.arange(next_value[device] - first), len(axes))
            axis = np.array([_AXES.find(axis) for axis in axes])[place]
            felt = np.flatnonzero(axis >= 0)
            self._of_device.setdefault(device, []).append((number, first + felt, (3 * taxel + axis)[felt]))
        self._ends = next_value
        self._has_services = has_services
        self._services: WorldServices | None = None
        self._at_end: Callable[[], object] | None = None
        self.reset(seed)

    def reset(self, seed: int) -> None:
        """Begin at 0 s of the scene, with elastomers that feel and remember nothing."""
        self.scene.reset()
        self.origin_ns: int | None = None
        self.left_out_s, self.advanced_ns = 0.0, -NS_PER_S
        self._forces: list[ArrayF] | None = None
        self._transfers = [
            Transfer(self._bound.settings(module.binding), module.position_m, (seed, module.binding.device, number))
            for number, module in enumerate(self.scene.modules)
        ]

    def fit(self, numbers: Sequence[int], n_values: int) -> None:
        for device, end in self._ends.items():
            if device not in numbers:
                known = ",".join(map(str, numbers))
                raise ConfigurationError(f"{self._bound.file}: there is no device {device}; there are {known}")
            if end > n_values:
                raise ConfigurationError(f"{self._bound.file}: device {device} has {n_values} values, not {end}")

    def advance(self, time_ns: int) -> None:
        """Let the physics run to a time of the devices; the first call is at 0 s of the scene."""
        if self.origin_ns is None:
            self.origin_ns = time_ns
        if self._has_services and self._services is None:
            self._services = WorldServices(self.scene)
            self._at_end = weakref.finalize(self, self._services.close)
        late_s = self.since_s(time_ns) - self.scene.time_s - _LONGEST_CATCH_UP_S * self._speed
        if late_s > 0:
            self.origin_ns += round(late_s / self._speed * NS_PER_S)
            self.left_out_s += late_s
        if self.scene.step_to(self.since_s(time_ns)):
            self._forces = None
        self.advanced_ns = time_ns
        if self._services is not None:
            self._services.serve(time_ns)

    def since_s(self, time_ns: int) -> float:
        return (time_ns - (self.origin_ns or 0)) / NS_PER_S * self._speed

    def forces(self) -> list[ArrayF]:
        """Return (n, 3) the forces on each module's taxels now: shear along x and y, and normal, N."""
        if self._forces is None:
            self._forces = self.scene.newtons()
        return self._forces

    def added(self, device: int, time_ns: int, n_values: int) -> ArrayF:
        """Return (n_values,) counts by which a device's values are above their rest, at a time never before the last.

        A device's values may be asked for once at a time: its elastomer remembers.
        """
        if time_ns != self.advanced_ns:
            self.advance(time_ns)
        values = np.zeros(n_values)
        for module, rows, counted in self._of_device.get(device, []):
            counts = self._transfers[module].counts(self.forces()[module], self.since_s(time_ns))
            values[rows] = counts.ravel()[counted]
        return values

    def rows(self, numbers: Sequence[int], n_values: int) -> Rows:
        """Return (n,) which values of all devices are those of taxels, ascending."""
        self.fit(numbers, n_values)
        of_modules = [(device, rows) for device, modules in self._of_device.items() for _, rows, _ in modules]
        return np.unique(np.concatenate([numbers.index(device) * n_values + rows for device, rows in of_modules]))

    def close(self) -> None:
        self.scene.close()
        self._services = None
        if self._at_end is not None:
            self._at_end()
