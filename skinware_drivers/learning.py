"""Simulated bodies with touch as environments of Gymnasium. Needs the extra ``mujoco``."""

from __future__ import annotations

import asyncio
import atexit
import os
import secrets
import shutil
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

import msgspec
import numpy as np
import numpy.typing as npt

from skinware.errors import BusNotAvailable, ConfigurationError, MissingExtra
from skinware.memory.namespace import Namespace
from skinware_drivers.adapter import AnyAdapter
from skinware_drivers.options import options_of
from skinware_drivers.registry import load_driver
from skinware_drivers.running.runner import Runner
from skinware_drivers.virtual.bus import BUSES
from skinware_drivers.virtual.emulator import Emulator, each_value
from skinware_drivers.virtual.hand_clock import HandClock, HandLoop, package_on
from skinware_drivers.virtual.hardware import load_emulator
from skinware_drivers.virtual.snapshot_log import SnapshotLog

try:
    import gymnasium

    from skinware_drivers.virtual.physics.binding import find_binding
    from skinware_drivers.virtual.physics.world import PhysicsWorld
except ModuleNotFoundError as error:
    if error.name not in ("gymnasium", "mujoco"):
        raise
    raise MissingExtra.of("learning in a simulated body", "skinware[mujoco]") from None

T = TypeVar("T")
Observation = dict[str, npt.NDArray[np.float32]]
Action = npt.NDArray[np.float32]

_LONGEST_START_S = 30.0
_PICTURE = (480, 360)
_ONE_TIME = threading.Lock()  # the package has one clock


class SkinEnv(gymnasium.Env[Observation, Action]):
    """A simulated body with touch; subclasses are tasks, which :meth:`begin` and :meth:`judge`.

    An action is the targets of actuators at the end of the step, in their units. An observation has

    * ``touch``: (taxels,) float32, values as the devices send them, device by device;
    * ``position``: (actuators,) float32, rad or m.

    ``info`` has what is true: ``force_n`` (modules,), the normal force on each, N, ``slip_m_s``, the fastest contact,
    and ``fresh``: no value is old or bad. Devices feel the end of a step; nothing depends on a clock of the machine.

    Args:
        world: as the option ``world``, such as ``mujoco:gripper``. Moves of the binding are left out.
        driver: the name of the driver whose devices the binding has.
        actuators: which ones an action moves; default: all. The others hold.
        rate_hz: steps a second of the scene.
        steps: of an episode, after which it is truncated.
        through_driver: observe through frames of the emulated devices and the driver, whose time passes as much in a
            step; ``skinware.realtime.now_ns`` of the process then returns it. False: the same values without a wire.
        options: of the emulated devices, such as faults of their frames.
        driver_options: of the driver.
        render_mode: ``rgb_array`` or None.

    Raises:
        MissingExtra: on import, without the extra ``mujoco``.
        ConfigurationError: no such world, actuator or option; or the driver shows other numbers than its devices feel.
        BusNotAvailable: the driver is not complete 30 s after its devices got power.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 50}  # noqa: RUF012 - as Gymnasium declares it

    def __init__(
        self,
        world: str,
        driver: str,
        *,
        actuators: Sequence[str] = (),
        rate_hz: float = 50.0,
        steps: int = 200,
        through_driver: bool = False,
        options: Mapping[str, Any] | None = None,
        driver_options: Mapping[str, Any] | None = None,
        render_mode: str | None = None,
    ) -> None:
        self.metadata = {**self.metadata, "render_fps": round(rate_hz)}
        if render_mode not in (None, "rgb_array"):
            raise ConfigurationError(f"render_mode {render_mode!r}: give None or rgb_array")
        if not rate_hz >= 2:
            raise ConfigurationError(f"rate_hz {rate_hz}: give at least 2")
        self.render_mode = render_mode
        bound = find_binding(world, driver)
        self.world = PhysicsWorld(
            msgspec.structs.replace(bound, binding=msgspec.structs.replace(bound.binding, move=()))
        )
        self.scene = self.world.scene
        known = self.scene.actuators.names
        self.scene.actuators.check(dict.fromkeys(actuators, 0.0), "actuators")
        self._actuators = [known.index(name) for name in actuators or known]
        self._devices = _Devices(self.world, driver, options or {})
        self._steps, self._count, self._period_ns = steps, 0, round(1e9 / rate_hz)
        self._wire: _SteppedDriver | None = None
        if through_driver:
            self._wire = _SteppedDriver(driver, driver_options or {}, self._devices, self._period_ns / 1e9)
        box, model = gymnasium.spaces.Box, self.scene.model
        is_limited = model.actuator_ctrllimited[self._actuators, np.newaxis] == 1
        limits = np.where(is_limited, model.actuator_ctrlrange[self._actuators], (-np.inf, np.inf)).astype(np.float32)
        self.action_space = box(*limits.T)
        touch = box(*self._devices.limits.astype(np.float32))
        position = box(-np.inf, np.inf, (len(limits),))
        self.observation_space = gymnasium.spaces.Dict({"touch": touch, "position": position})

    # A task defines these

    def begin(self, options: Mapping[str, Any]) -> None:
        """Change the scene at the beginning of an episode, at random by ``np_random``; by default nothing.

        Args:
            options: of :meth:`reset`.
        """

    def judge(self, action: Action) -> tuple[float, bool]:  # noqa: ARG002
        """Return the reward of a step, and whether the episode ends; by default 0 and never."""
        return 0.0, False

    # Gymnasium

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode; with the same seed, bit by bit as before."""
        super().reset(seed=seed)
        self.world.reset(int(self.np_random.integers(1 << 31)))
        self._count = 0
        self.begin(options or {})
        self.scene.settle()
        return self._observed()

    def step(self, action: Action) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Move for ``1 / rate_hz``.

        Raises:
            ConfigurationError: the action has another shape, or numbers that are not finite.
        """
        given = np.asarray(action, np.float64)
        if given.shape != self.action_space.shape:
            raise ConfigurationError(f"action of shape {given.shape}: give {self.action_space.shape}")
        names = (self.scene.actuators.names[row] for row in self._actuators)
        self.scene.actuators.move(dict(zip(names, given.tolist(), strict=True)), self._period_ns / 1e9)
        self._count += 1
        observation, info = self._observed()
        reward, terminated = self.judge(action)
        return observation, reward, terminated, self._count >= self._steps, info

    def render(self) -> npt.NDArray[np.uint8] | None:
        """Return (360, 480, 3) RGB from the first camera of the scene; None without a render mode.

        Raises:
            PlatformError: MuJoCo draws nothing here.
        """
        return None if self.render_mode is None else self.scene.picture(*_PICTURE)

    def close(self) -> None:
        """Stop the driver, if there is one. Idempotent."""
        if self._wire is not None:
            self._wire.close()
            self._wire = None
        self.world.close()

    def _observed(self) -> tuple[Observation, dict[str, Any]]:
        touch, fresh = self._devices.feel(self.world, self._count * self._period_ns), True
        if self._wire is not None:
            touch, fresh = self._wire.step()
        info = {
            "force_n": self.scene.pressed_n(),
            "slip_m_s": max((touch.slip_m_s for touch in self.scene.touching()), default=0.0),
            "fresh": fresh,
        }
        position = self.scene.data.actuator_length[self._actuators]
        return {"touch": touch.astype(np.float32), "position": position.astype(np.float32)}, info


class _Devices:
    """Emulated devices that feel what they are given.

    Attributes:
        values: (devices, n) int64, what all of them feel.
        rows: (taxels,) where the bound ones are in all values.
        limits: (2, taxels) lowest and highest of those.
    """

    def __init__(self, world: PhysicsWorld, driver: str, options: Mapping[str, Any]) -> None:
        emulator: Any = load_emulator(driver)
        if not issubclass(emulator, Emulator):
            raise ConfigurationError(f"{driver}: these emulated devices have a touch of their own")
        self.hardware = emulator(options_of(emulator, options), source=self._felt)
        self.numbers = list(self.hardware.numbers)
        n = len(self.hardware.places())
        self.rows = world.rows(self.numbers, n)
        self.values, *limits = (
            np.tile(each_value(name, getattr(self.hardware, name), n), (len(self.numbers), 1))
            for name in ("rest", "lowest", "full_scale")
        )
        self.limits = np.array([each.ravel()[self.rows] for each in limits])

    def feel(self, world: PhysicsWorld, time_ns: int) -> npt.NDArray[np.int64]:
        """Let the world run to a time; return (taxels,) values."""
        for place, number in enumerate(self.numbers):
            self.values[place] = self.hardware.pressed(world.added(number, time_ns, self.values.shape[1]))
        return self.values.ravel()[self.rows]

    def _felt(self, number: int, _burst: int) -> list[int]:
        values: list[int] = self.values[self.numbers.index(number)].tolist()
        return values


class _SteppedDriver:
    """A driver on emulated devices, in a thread, whose time passes only in :meth:`step`."""

    def __init__(self, driver: str, options: Mapping[str, Any], devices: _Devices, period_s: float) -> None:
        kind = load_driver(driver)
        adapter = kind(options_of(kind, options))
        adapter.check()
        self._devices, self._period_s, self._clock = devices, period_s, HandClock()
        self._namespace = Namespace(f"stepped-{os.getpid()}-{secrets.token_hex(4)}")
        self._thread = ThreadPoolExecutor(1, "stepped driver")
        self._loop = HandLoop(self._clock)
        self._log = SnapshotLog(self._clock)
        self._log.keep = False
        self._runner: Runner = self._now(lambda: self._make(driver, adapter))
        self._task = self._loop.create_task(self._runner.run())
        atexit.register(self.close)
        try:
            self._begin()
        except BaseException:
            self.close()
            raise

    def step(self) -> tuple[npt.NDArray[Any], bool]:
        """Let the time of a step pass; return (taxels,) values, and whether all are good and felt within it."""
        return self._now(self._step)

    def close(self) -> None:
        atexit.unregister(self.close)
        self._now(self._end)
        self._thread.shutdown()
        self._loop.close()
        shutil.rmtree(self._namespace.path, ignore_errors=True)

    def _now(self, action: Callable[[], T]) -> T:
        """Do something in the thread, and in its time."""

        def act() -> T:
            with _ONE_TIME, package_on(self._clock):
                return action()

        try:
            done = self._thread.submit(act)
        except RuntimeError:  # Python ends, and has ended all pools of threads before
            return act()
        return done.result()

    def _make(self, driver: str, adapter: AnyAdapter) -> Runner:
        hardware, size = self._devices.hardware, adapter.payload_size
        bus = BUSES[adapter.medium](driver, payload_size=size, hardware=hardware, clock=self._clock)
        return Runner(driver, [(driver, adapter, bus)], name=driver, namespace=self._namespace)

    def _begin(self) -> None:
        """Wait for all values, and compare those of taxels with what the devices felt."""
        lowest, highest = self._devices.limits
        felt = lowest + (37 * np.arange(len(lowest)) + 11) % (highest - lowest + 1)
        self._devices.values.ravel()[self._devices.rows] = felt
        for _ in range(round(_LONGEST_START_S / self._period_s)):
            values, fresh = self.step()
            if fresh:
                break
        else:
            raise BusNotAvailable(f"{self._runner.identity.name}: no values of all devices")
        if (values != felt).any():
            raise ConfigurationError(f"{self._runner.identity.name} shows other numbers than its devices feel")

    def _step(self) -> tuple[npt.NDArray[Any], bool]:
        begin_ns, rows = self._clock.now_ns, self._devices.rows
        self._loop.run_until_complete(asyncio.sleep(self._period_s))
        if self._task.done():
            self._task.result()
        self._log.look(self._runner)
        if not self._log.frames:
            return np.zeros(len(rows)), False
        snapshot, n = self._log.frames[-1], self._devices.values.size
        if len(snapshot.values) != n:
            raise ConfigurationError(f"the driver has {len(snapshot.values)} sensors, its devices feel {n}")
        times_ns = snapshot.module_time_ns[snapshot.structure.sensor_module][rows]
        return snapshot.values[rows], bool((times_ns >= begin_ns).all())

    def _end(self) -> None:
        self._runner.stop()
        self._loop.run_until_complete(asyncio.wait([self._task]))
        self._task.exception()
        self._log.close()
