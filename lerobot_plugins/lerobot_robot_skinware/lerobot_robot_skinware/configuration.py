"""Options of the robot, as a command line or a YAML file gives them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, cast

import draccus
from lerobot.cameras.configs import CameraConfig
from lerobot.robots.config import RobotConfig

from skinware.learning.live import TouchOptions


@RobotConfig.register_subclass("skinware")
@dataclass(kw_only=True)
class SkinwareConfig(TouchOptions, RobotConfig):
    """A robot and the skin on it: options of :class:`skinware.learning.live.TouchOptions`, and these.

    Attributes:
        robot: options of the robot that moves, its ``type`` among them: ``{type: so101_follower, port: /dev/ttyACM0}``.
            (Not a nested configuration: a robot in a robot would have options without end.)
        cameras: further cameras, beside those of the robot; those of touch are of the type ``skinware``.
        numbers: ``module``: the sum and the largest value of each module; ``taxel``: each value; ``point``: place and
            force of each taxel, six numbers, in the order of LeRobot's proposed point sets; ``none``.
        contacts: number of contacts, the largest first, each with load and place; from the service ``contacts``.
        when_stale: with ``hold``, ``touch.held.vel`` says when the last touch is held.
    """

    robot: dict[str, Any] = field(default_factory=dict)
    cameras: dict[str, CameraConfig] = field(default_factory=dict)
    numbers: str = "module"
    contacts: int = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        if "type" not in self.robot:
            raise ValueError("robot: give the options of the robot that moves, as {type: so101_follower, ...}")
        self.check(numbers=("module", "taxel", "point", "none"))

    @property
    def of_robot(self) -> RobotConfig:
        """The configuration of the robot that moves."""
        return cast(RobotConfig, draccus.decode(RobotConfig, self.robot))
