"""Robot skin and tactile hands as cameras of LeRobot: ``{type: skinware, driver: hand, width: 64, height: 64}``."""

from lerobot_camera_skinware.camera import SkinwareCamera
from lerobot_camera_skinware.configuration import SkinwareCameraConfig

__all__ = ["SkinwareCamera", "SkinwareCameraConfig"]
