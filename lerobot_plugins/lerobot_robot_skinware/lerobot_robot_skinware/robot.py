"""The robot: another robot of LeRobot, with numbers of touch beside its joints."""

from __future__ import annotations

from typing import Any

import numpy as np
from lerobot.cameras.utils import make_cameras_from_configs
from lerobot.robots.robot import Robot
from lerobot.robots.utils import make_robot_from_config
from lerobot.utils.errors import DeviceNotConnectedError

from lerobot_robot_skinware.configuration import SkinwareConfig
from skinware.errors import ServiceNotFound, ServiceTimeout
from skinware.learning.features import CONTACT_NUMBERS, Totals, contact_numbers, state_name
from skinware.learning.live import TouchSample
from skinware.realtime import now_ns

HELD, AGE = state_name("held"), state_name("age_s")


class Skinware(Robot):
    """A robot with touch in its state. All else is that robot.

    Its state has the numbers of touch, their age and, with ``when_stale: hold``, a flag; for their names see
    :func:`skinware.learning.features.state_name`.

    Attributes:
        robot: the robot that moves.
        cameras: its cameras, and those of the configuration.

    Raises:
        TimeoutError: from ``get_observation``: a driver died, is silent, or came back with other sensors.
    """

    config_class = SkinwareConfig
    name = "skinware"

    def __init__(self, config: SkinwareConfig) -> None:
        super().__init__(config)
        self.config = config
        self.robot: Robot = make_robot_from_config(config.of_robot)
        self._own_cameras = make_cameras_from_configs(config.cameras)
        self.cameras = {**getattr(self.robot, "cameras", {}), **self._own_cameras}
        self._touch = config.touch(with_contacts=config.contacts > 0)
        self._totals: Totals | None = None

    def __str__(self) -> str:
        return f"{self.robot} with touch"

    @property
    def _numbers(self) -> Totals:
        """Names come from the drivers, so that they must run before the robot connects."""
        if self._totals is None:
            was_open = self._touch.is_open
            if not was_open:
                self._open()
            each, positions = self.config.numbers, self._touch.positions
            if each == "none":
                each, positions = "module", positions[:0]
            self._totals = Totals(self._touch.layout, self.config.type_name, positions, each)  # type: ignore[arg-type]
            if not was_open:
                self._touch.close()
        return self._totals

    def _open(self) -> None:
        try:
            self._touch.open(timeout_s=self.config.timeout_s)
        except (ServiceNotFound, ServiceTimeout) as error:
            raise ConnectionError(f"{self}: {error}") from error

    @property
    def observation_features(self) -> dict[str, Any]:
        """The robot's features, then those of touch, then images of the further cameras."""
        names = [state_name(name) for name in self._numbers.names]
        rows = range(self.config.contacts)
        names += [state_name(f"contact_{row}.{name}") for row in rows for name in CONTACT_NUMBERS]
        names += [AGE, *([HELD] if self.config.when_stale == "hold" else [])]
        images = {name: (each.height, each.width, 3) for name, each in self._own_cameras.items()}
        return {**self.robot.observation_features, **dict.fromkeys(names, float), **images}

    @property
    def action_features(self) -> dict[str, Any]:
        return dict(self.robot.action_features)

    @property
    def is_connected(self) -> bool:
        return self.robot.is_connected and self._touch.is_open and all(c.is_connected for c in self.cameras.values())

    def connect(self, calibrate: bool = True) -> None:
        """Connect the skin first: a robot without touch shall not move.

        Raises:
            ConnectionError: the drivers do not run, or lack such sensors.
        """
        _ = self._numbers
        self._open()
        for camera in self._own_cameras.values():
            camera.connect()
        self.robot.connect(calibrate)

    @property
    def is_calibrated(self) -> bool:
        return bool(self.robot.is_calibrated)

    def calibrate(self) -> None:
        self.robot.calibrate()

    def configure(self) -> None:
        self.robot.configure()

    def get_observation(self) -> dict[str, Any]:
        """Return the robot's observation, and the touch nearest to the moment at which this was called."""
        if not self._touch.is_open:
            raise DeviceNotConnectedError(f"{self} is not connected")
        time_ns = now_ns()
        observation = dict(self.robot.get_observation())
        try:
            touch = self._touch.at(time_ns)
        except ServiceTimeout as error:
            raise TimeoutError(f"{self}: {error}") from error
        observation |= self._touch_numbers(touch, time_ns)
        images = {name: self._image(camera, time_ns) for name, camera in self._own_cameras.items()}
        return {**observation, **images}

    @staticmethod
    def _image(camera: Any, time_ns: int) -> Any:
        """Return the image of a camera of touch at a moment, the newest one of another."""
        return camera.read_at(time_ns) if hasattr(camera, "read_at") else camera.read_latest()

    def _touch_numbers(self, touch: TouchSample, time_ns: int) -> dict[str, float]:
        values = touch.values if self._numbers.names else touch.values[:0]
        numbers = dict(zip(self._numbers.names, self._numbers.of(values).tolist(), strict=True))
        for row, contact in enumerate(contact_numbers(touch.contacts, self.config.contacts).tolist()):
            numbers |= {f"contact_{row}.{name}": x for name, x in zip(CONTACT_NUMBERS, contact, strict=True)}
        named = {state_name(name): value for name, value in numbers.items()}
        age_s = (time_ns - int(np.min(touch.snapshot.acquired_ns))) / 1e9
        return {**named, AGE: age_s, **({HELD: float(touch.is_held)} if self.config.when_stale == "hold" else {})}

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        return dict(self.robot.send_action(action))

    def disconnect(self) -> None:
        """Disconnect the robot first, then the skin."""
        if self.robot.is_connected:
            self.robot.disconnect()
        for camera in self._own_cameras.values():
            if camera.is_connected:
                camera.disconnect()
        self._touch.close()
