"""OAK cameras for LeRobot. Importing this package registers the type ``oak``."""

from lerobot_camera_oak.camera_oak import OakCamera
from lerobot_camera_oak.config_oak import OakCameraConfig

__all__ = ["OakCamera", "OakCameraConfig"]
