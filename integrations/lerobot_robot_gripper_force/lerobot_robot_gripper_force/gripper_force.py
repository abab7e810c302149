"""The robot ``gripper_force``: observations and actions of LeRobot, on the public interface of gripper-force."""

import logging
import math
from contextlib import ExitStack
from functools import cached_property
from typing import Any

import numpy as np
from lerobot.cameras.utils import make_cameras_from_configs
from lerobot.robots import Robot
from lerobot.utils.decorators import check_if_already_connected, check_if_not_connected

import gripper_force as gf
from lerobot_robot_gripper_force.config_gripper_force import ACTION_KEYS, GripperForceConfig

logger = logging.getLogger(__name__)

_SIMULATED_PX = 128
"""Side of the simulated camera's image, which ``camera.side_px`` does not change."""


class GripperForce(Robot):
    """A gripper with force control as a LeRobot robot.

    Observations are the estimated contact force and its standard deviation, the distance between the jaws, the motor
    current, the newest frame of the gripper's own camera (``gripper.frame``) and one of each further camera. An action
    is a force or a width, as ``action`` of the configuration says.

    A stop or a fault is final: every later action raises ``RequestError``, until a person calls
    ``robot.gripper.release()`` or connects again.

    Args:
        config: The configuration.

    Raises:
        ConfigError: A key or value of the configuration of gripper-force is wrong.

    Attributes:
        settings: The configuration of gripper-force. Its ``on_exit`` is always ``release``.
        cameras: The further cameras.
    """

    config_class = GripperForceConfig
    name = "gripper_force"

    def __init__(self, config: GripperForceConfig) -> None:
        self._gripper: gf.Gripper | None = None
        self._resources = ExitStack()
        self._last_value: float | None = None
        super().__init__(config)
        self.config = config
        # LeRobot's users expect no torque after `disconnect`.
        self.settings = gf.load_config(config.config, config.overrides).with_values(on_exit="release")
        self.cameras = make_cameras_from_configs(config.cameras)

    @cached_property
    def observation_features(self) -> dict[str, Any]:
        """Keys of an observation: ``float``, or the shape of an image."""
        features: dict[str, Any] = dict.fromkeys(
            ("gripper.force_n", "gripper.std_n", "gripper.width_m", "gripper.current_a"), float
        )
        if self.settings.camera.backend != "none":
            is_simulated = self.settings.camera.backend == "simulated"
            side_px = _SIMULATED_PX if is_simulated else self.settings.camera.side_px
            features["gripper.frame"] = (side_px, side_px, 3)
        for name, camera in self.cameras.items():
            features[name] = (camera.height, camera.width, 3)
        return features

    @cached_property
    def action_features(self) -> dict[str, Any]:
        """Key of an action: ``gripper.force_n`` or ``gripper.width_m``."""
        return {ACTION_KEYS[self.config.action]: float}

    @property
    def is_connected(self) -> bool:
        """True from `connect` to `disconnect`."""
        return self._gripper is not None

    @property
    def is_calibrated(self) -> bool:
        """True: ``gripper-force calibrate`` calibrates, and ``calibration.rig`` names the result."""
        return True

    @property
    @check_if_not_connected
    def gripper(self) -> gf.Gripper:
        """The live gripper, for example for ``robot.gripper.stop()``, which any thread may call."""
        assert self._gripper is not None
        return self._gripper

    @check_if_already_connected
    def connect(self, calibrate: bool = True) -> None:
        """Opens cameras and gripper, and arms the servo. Nothing moves before the first action.

        Args:
            calibrate: Has no effect; see `is_calibrated`.

        Raises:
            GripperError: The gripper cannot be opened; see ``gripper_force.open_gripper``.
        """
        with ExitStack() as stack:
            for camera in self.cameras.values():
                camera.connect()
                stack.callback(camera.disconnect)
            gripper = stack.enter_context(gf.open_gripper(self.settings, log=self.config.log))
            self._last_value = None
            self._resources = stack.pop_all()
        self._gripper = gripper
        self.configure()
        logger.info("%s connected", self)

    def calibrate(self) -> None:
        """Has no effect; see `is_calibrated`."""

    def configure(self) -> None:
        """Has no effect: `connect` applies the whole configuration."""

    def get_observation(self) -> dict[str, Any]:
        """Returns the newest values. In lockstep it first advances the simulated time by one frame.

        Raises:
            DeviceError: A device failed.
            TimeoutError: A further camera has no new frame.
        """
        gripper = self.gripper
        gripper.sleep(1 / self.config.lockstep_fps if self.settings.clock == "lockstep" else 0)
        state, frame = gripper.state, gripper.frame
        observation: dict[str, Any] = {
            "gripper.force_n": state.force_n,
            "gripper.std_n": state.std_n,
            "gripper.width_m": state.width_m,
            "gripper.current_a": state.current_a,
        }
        if "gripper.frame" in self.observation_features:
            if frame is None:
                raise gf.DeviceError("the gripper's camera gave no frame yet; check its cable and lens cap")
            observation["gripper.frame"] = np.repeat(frame.gray[:, :, None], 3, axis=2)  # (H, W, 3)
        for name, camera in self.cameras.items():
            observation[name] = camera.async_read()
        return observation

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        """Requests a force or a width, limited to what the gripper accepts, and returns at once.

        A force below ``open_below_n`` opens the jaws. An action that equals the one before makes no new request, so a
        grasp that ended (``no_object``, ``slip``) is not repeated until the action changes.

        Args:
            action: The action, with the key of `action_features`.

        Returns:
            The action that was sent: within the limits, and 0 for a force that opens the jaws.

        Raises:
            RequestError: The gripper was stopped or is at fault, or the value is missing or not finite.
            DeviceError: A device failed.
        """
        gripper, (key,) = self.gripper, self.action_features
        if key not in action:
            raise gf.RequestError(
                f"the action has no {key}, but {', '.join(action) or 'nothing'}; set --robot.action and "
                "--teleop.action to the same kind"
            )
        value = float(action[key])
        if not math.isfinite(value):
            raise gf.RequestError(f"the action {key}={value} is not finite; send a finite number")
        state = gripper.state
        if state.phase == gf.Phase.FAULT:
            self._last_value = None  # after a release, the same action has to be sent again
            raise gf.RequestError(
                f"the action was refused: the gripper was stopped or is at fault ({state.reason}); call "
                "robot.gripper.release() once the cause is gone"
            )
        open_width_m = gripper.config.gripper.open_width_m
        if key == ACTION_KEYS["width"]:
            limited = min(max(value, 0.0), open_width_m)
        else:
            limited = 0.0 if value < self.config.open_below_n else min(value, gripper.largest_force_n)
        if limited != self._last_value:
            # A move, not a release: a release would also reset a stop that came just now.
            if key == ACTION_KEYS["width"]:
                gripper.move(limited, wait=False)
            elif limited == 0.0:
                gripper.move(open_width_m, wait=False)
            else:
                # An arm has moved the camera since the jaws opened, and the object may be another.
                is_open = state.phase == gf.Phase.OPEN or state.outcome == gf.Outcome.MOVED
                gripper.grasp(limited, wait=False, new_object=is_open)
            self._last_value = limited
        return {key: limited}

    @check_if_not_connected
    def disconnect(self) -> None:
        """Turns torque off and closes all devices; after a stop or fault the servo ends as ``control.on_fault`` says.

        Raises:
            GripperError: A device failed since the last call, or records are missing from the log.
        """
        self._gripper = None
        self._resources.close()
        logger.info("%s disconnected", self)
