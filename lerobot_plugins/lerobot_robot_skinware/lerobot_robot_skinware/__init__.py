"""Any robot of LeRobot with touch in its state: ``--robot.type=skinware --robot.robot='{type: so101_follower}'``."""

from lerobot_robot_skinware.configuration import SkinwareConfig
from lerobot_robot_skinware.robot import Skinware

__all__ = ["Skinware", "SkinwareConfig"]
