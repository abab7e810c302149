"""The teleoperator ``gripper_force_targets``: a list of targets, so that an episode needs no leader arm."""

from typing import Any

from lerobot.teleoperators import Teleoperator
from lerobot.utils.decorators import check_if_already_connected, check_if_not_connected

from lerobot_robot_gripper_force.config_gripper_force import ACTION_KEYS
from lerobot_robot_gripper_force.config_target_steps import TargetStepsConfig


class TargetSteps(Teleoperator):
    """Gives one target after another, each for a number of actions.

    Args:
        config: The configuration.
    """

    config_class = TargetStepsConfig
    name = "gripper_force_targets"

    def __init__(self, config: TargetStepsConfig) -> None:
        self._actions = 0
        self._connected = False
        super().__init__(config)
        self.config = config

    @property
    def action_features(self) -> dict[str, Any]:
        """Key of an action: ``gripper.force_n`` or ``gripper.width_m``."""
        return {ACTION_KEYS[self.config.action]: float}

    @property
    def feedback_features(self) -> dict[str, Any]:
        """Empty: there is no feedback."""
        return {}

    @property
    def is_connected(self) -> bool:
        """True from `connect` to `disconnect`."""
        return self._connected

    @property
    def is_calibrated(self) -> bool:
        """True: there is nothing to calibrate."""
        return True

    @check_if_already_connected
    def connect(self, calibrate: bool = True) -> None:
        """Begins with the first target."""
        self._actions, self._connected = 0, True

    def calibrate(self) -> None:
        """Has no effect."""

    def configure(self) -> None:
        """Has no effect."""

    @check_if_not_connected
    def get_action(self) -> dict[str, Any]:
        """Returns the target of this action."""
        step = self._actions // self.config.frames % len(self.config.targets)
        self._actions += 1
        return {ACTION_KEYS[self.config.action]: float(self.config.targets[step])}

    def send_feedback(self, feedback: dict[str, Any]) -> None:
        """Has no effect."""

    @check_if_not_connected
    def disconnect(self) -> None:
        """Ends the list of targets."""
        self._connected = False
