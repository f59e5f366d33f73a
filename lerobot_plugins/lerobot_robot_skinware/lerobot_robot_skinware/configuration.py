"""Options of the robot, as a command line or a YAML file gives them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, cast

import draccus
from lerobot.cameras.configs import CameraConfig
from lerobot.robots.config import RobotConfig


@RobotConfig.register_subclass("skinware")
@dataclass(kw_only=True)
class SkinwareConfig(RobotConfig):
    """A robot and the skin on it.

    Attributes:
        robot: options of the robot that moves, its ``type`` among them: ``{type: so101_follower, port: /dev/ttyACM0}``.
            (Not a nested configuration: a robot in a robot would have options without end.)
        cameras: further cameras, beside those of the robot; those of touch are of the type ``skinware``.
        driver, namespace, type_name, modules, regions, max_age_ms, timeout_s: which touch; as of the camera.
        numbers: ``module``: the sum and the largest value of each module; ``taxel``: each value; ``none``.
        contacts: number of contacts, the largest first, each with load and place; from the service ``contacts``.
        contacts_namespace: of that service.
        when_stale: ``raise`` a TimeoutError when a driver died or is silent, or ``hold`` the last touch and set
            ``touch.held``.
    """

    robot: dict[str, Any] = field(default_factory=dict)
    cameras: dict[str, CameraConfig] = field(default_factory=dict)
    driver: str = ""
    namespace: str = ""
    type_name: str = "pressure"
    modules: list[str] = field(default_factory=list)
    regions: str = ""
    numbers: str = "module"
    contacts: int = 0
    contacts_namespace: str = "calm"
    max_age_ms: float | None = None
    when_stale: str = "raise"
    timeout_s: float = 5.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if "type" not in self.robot:
            raise ValueError("robot: give the options of the robot that moves, as {type: so101_follower, ...}")
        for name, value, known in (
            ("numbers", self.numbers, ("module", "taxel", "none")),
            ("when_stale", self.when_stale, ("raise", "hold")),
        ):
            if value not in known:
                raise ValueError(f"{name} is {value!r}: give one of {', '.join(known)}")

    @property
    def of_robot(self) -> RobotConfig:
        """The configuration of the robot that moves."""
        return cast(RobotConfig, draccus.decode(RobotConfig, self.robot))
