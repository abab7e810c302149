"""gripper-force as a LeRobot robot. Importing this package registers the type ``gripper_force``."""

from lerobot_robot_gripper_force.config_gripper_force import GripperForceConfig
from lerobot_robot_gripper_force.config_target_steps import TargetStepsConfig
from lerobot_robot_gripper_force.gripper_force import GripperForce
from lerobot_robot_gripper_force.target_steps import TargetSteps

__all__ = ["GripperForce", "GripperForceConfig", "TargetSteps", "TargetStepsConfig"]
