"""What a configuration becomes before a run: its network, estimator and controller, nothing left open."""

from typing import TYPE_CHECKING

from gripper_force.config import Config
from gripper_force.control.state_machine import MAX_CYCLE_S, GraspController
from gripper_force.control.transmission import Transmission
from gripper_force.errors import ConfigError
from gripper_force.interfaces import Devices
from gripper_force.profiles.apply import with_plant

if TYPE_CHECKING:  # a run without vision loads none of it
    from gripper_force.profiles.correction import Correction
    from gripper_force.vision.estimator import ForceEstimator
    from gripper_force.vision.header import Model

_SUPPLY_SLACK_V = 0.5
"""A supply that is set to the end of a servo's range reads a little beyond it."""

_CYCLES_A_WATCHDOG = 2
"""One cycle that is lost must not make the servo stop."""


def settled(config: Config) -> tuple[Config, str]:
    """The configuration with nothing of its estimator left to ``auto``, and what was taken and why, in words.

    Raises:
        ConfigError: Nothing keeps the budget.
    """
    if "auto" not in (config.vision.checkpoint, config.vision.engine):
        return config, ""
    from gripper_force.vision import selection

    vision, choice = selection.resolve_auto(config.vision, config.budget)
    return config.model_copy(update={"vision": vision}), "" if choice is None else str(choice)


def checkpoint_of(config: Config) -> "Model | None":
    """The network that the configuration names, or None for a run without vision."""
    if config.camera.backend == "none" or config.vision.checkpoint == "none":
        return None
    from gripper_force.vision.model_files import read_model

    return read_model(settled(config)[0].vision.checkpoint)


def make_estimator(
    config: Config, checkpoint: "Model | None", correction: "Correction | None"
) -> "ForceEstimator | None":
    """The estimator of a run, or None for a run without vision."""
    if checkpoint is None:
        return None
    from gripper_force.vision.estimator import open_estimator

    return open_estimator(checkpoint, config.vision, correction)


def make_controller(config: Config, devices: Devices) -> tuple[Config, GraspController]:
    """Completes the configuration with what the servo knows of itself, and builds the controller from it.

    Raises:
        ConfigError: The loop is too slow to be one, or slower than the servo waits for it.
    """
    _check_rate(config)
    servo = devices.servo
    gripper = config.gripper
    if gripper.nm_per_a is None:
        gripper = gripper.model_copy(update={"nm_per_a": servo.nm_per_a})
    if gripper.current_step_a is None:
        gripper = gripper.model_copy(update={"current_step_a": servo.current_step_a})
    control = config.control
    if control.voltage_limits_v is None:
        low_v, high_v = servo.voltage_range_v
        slack = {"voltage_limits_v": (low_v - _SUPPLY_SLACK_V, high_v + _SUPPLY_SLACK_V)}
        control = control.model_copy(update=slack)
    control = with_plant(config, control)
    config = config.model_copy(update={"gripper": gripper, "control": control})
    return config, controller_from(config)


def controller_from(config: Config) -> GraspController:
    """Builds the controller of a completed configuration, such as a log holds."""
    gripper = config.gripper
    if gripper.nm_per_a is None:
        raise ConfigError("this configuration was never completed by a servo: gripper.nm_per_a is not set")
    transmission = Transmission.from_config(gripper, gripper.nm_per_a, gripper.current_step_a or 0.0)
    return GraspController(config.control, transmission, config.servo.current_limit_a)


def _check_rate(config: Config) -> None:
    rate_hz, watchdog_ms = config.control.rate_hz, config.servo.bus_watchdog_ms
    if rate_hz < 1 / MAX_CYCLE_S:
        raise ConfigError(
            f"control.rate_hz is {rate_hz:g}, too slow for a force loop; set at least {1 / MAX_CYCLE_S:g}"
        )
    if rate_hz < (least_hz := 1e3 * _CYCLES_A_WATCHDOG / watchdog_ms):
        raise ConfigError(
            f"at control.rate_hz {rate_hz:g} a servo with servo.bus_watchdog_ms {watchdog_ms} would stop by "
            f"itself; set the rate to {least_hz:.4g} or more, or make the watchdog longer"
        )
