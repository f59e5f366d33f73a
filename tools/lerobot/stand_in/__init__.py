"""A robot and a teleoperator without hardware, for lerobot-record: two joints that follow a sine.

The robot appends the time of each observation, CLOCK_MONOTONIC ns, to its file.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from lerobot.robots.config import RobotConfig
from lerobot.robots.robot import Robot
from lerobot.teleoperators.config import TeleoperatorConfig
from lerobot.teleoperators.teleoperator import Teleoperator

JOINTS = dict.fromkeys(("shoulder.pos", "elbow.pos"), float)


@RobotConfig.register_subclass("stand_in")
@dataclass(kw_only=True)
class StandInConfig(RobotConfig):
    log: str = "/dev/null"


class StandIn(Robot):
    config_class, name = StandInConfig, "stand_in"
    observation_features = action_features = JOINTS
    is_connected = is_calibrated = False

    def __init__(self, config: StandInConfig) -> None:
        super().__init__(config)
        self._log = Path(config.log)
        self._last = dict.fromkeys(JOINTS, 0.0)
        self.cameras: dict[str, Any] = {}

    def connect(self, _calibrate: bool = True) -> None:
        self.is_connected = self.is_calibrated = True

    def calibrate(self) -> None: ...

    def configure(self) -> None: ...

    def get_observation(self) -> dict[str, Any]:
        with self._log.open("a") as log:
            log.write(f"{time.monotonic_ns()}\n")
        return dict(self._last)

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        self._last = dict(action)
        return action

    def disconnect(self) -> None:
        self.is_connected = False


@TeleoperatorConfig.register_subclass("stand_in")
@dataclass(kw_only=True)
class StandInLeaderConfig(TeleoperatorConfig):
    pass


class StandInLeader(Teleoperator):
    config_class, name = StandInLeaderConfig, "stand_in"
    action_features = JOINTS
    feedback_features: ClassVar[dict[str, Any]] = {}
    is_connected = is_calibrated = False

    def connect(self, _calibrate: bool = True) -> None:
        self.is_connected = self.is_calibrated = True

    def calibrate(self) -> None: ...

    def configure(self) -> None: ...

    def get_action(self) -> dict[str, Any]:
        return {name: math.sin(time.monotonic() + number) for number, name in enumerate(JOINTS)}

    def send_feedback(self, feedback: dict[str, Any]) -> None: ...

    def disconnect(self) -> None:
        self.is_connected = False
