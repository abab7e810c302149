"""Step ``torque``: motor current in newtons at the jaws, by the load cell, a weight, or the data sheet."""

import math
from datetime import date
from typing import Any, Final

from gripper_calibration.procedures.calibrate_servo import SIM_GAUGE, SIM_GAUGE_MM, calibrate_servo
from gripper_calibration.procedures.calibrate_weight import calibrate_weight, masses_kg
from gripper_calibration.setup.load_cell import PROFILE, interval
from gripper_calibration.setup.step import Found, StepResult, Task
from gripper_force.config import Config
from gripper_force.errors import ConfigError
from gripper_force.profiles.rig_profile import FRICTION_DRIFT, NORMAL, RigProfile
from gripper_force.runtime.backends import is_simulated
from gripper_force.runtime.resolve import resolve

_FORCES_N: Final = (2.0, 4.0, 8.0)


def torque_uses(config: Config) -> tuple[str, ...]:
    """Returns the names in `Task` of what the step uses: a width to press a load cell, or a mass to balance."""
    if _presses(config):
        return ("gauge_mm",)
    try:
        masses_kg(config)
    except ConfigError:
        return ()
    return ("mass_kg",)


def _presses(config: Config) -> bool:
    return config.load_cell.backend not in ("none", "playback") and len(config.servo.ids) == 1


def torque(task: Task) -> StepResult:
    """Presses the load cell; without one, balances a known mass, or takes the data sheet's torque constant.

    Raises:
        ConfigError: A script did not give the width of the load cell.
        GripperError: See `calibrate_servo` and `calibrate_weight`.
    """
    config = task.config
    if not _presses(config):
        return _weight(task)
    simulated = is_simulated(config)
    gauge_mm = task.gauge_mm
    if gauge_mm is None:
        default = SIM_GAUGE_MM if simulated else None
        gauge_mm = task.number("Width of the load cell between the jaws in mm", "--gauge-mm MM", default)
    pressed = config.with_values(object=SIM_GAUGE) if simulated else config
    result = calibrate_servo(
        pressed, [1e-3 * gauge_mm], task.folder / PROFILE, prompt=task.person.do, progress=task.progress
    )
    servo = result.calibration
    by = f"pressed the load cell, {servo.date.date().isoformat()}"
    settings = RigProfile(servo=servo).settings()["gripper"]
    origins = {
        "nm_per_a": interval(servo.nm_per_a),
        "friction_n": interval(servo.friction_n),
        "damping_n_s_m": interval(servo.damping_n_s_m),
        "open_position_rad": interval(servo.open_position_rad),
        "gain_std": "relative error of nm_per_a",
        "friction_std": "relative error of friction_n",
    }
    values = {
        f"gripper.{key}": Found(round(settings[key], 5), f"{origin}, {by}") for key, origin in origins.items()
    }
    calibrated_config = config.with_values(gripper={key: settings[key] for key in origins})
    return StepResult(
        f"{servo.nm_per_a.value:.3f} Nm/A ({interval(servo.nm_per_a)})",
        values,
        [*([] if result.width_remark is None else [result.width_remark]), _reference(calibrated_config)],
        {"figure": result.report},
        {"servo": servo, "intervals_n": _intervals_n(calibrated_config)},
        {"gauge_mm": gauge_mm},
    )


def _weight(task: Task) -> StepResult:
    """Balances a mass, if the gripper can and there is one."""
    try:
        min_kg, max_kg = masses_kg(task.config)
    except ConfigError:
        return _data_sheet(task)
    mass_kg = task.mass_kg
    if mass_kg is None:
        mass_kg = 1e-3 * task.number(
            f"Known mass to hang from one jaw in grams, {1e3 * min_kg:.0f} to {1e3 * max_kg:.0f}; 0 for none",
            "--mass-kg KG",
            0.0,
        )
    if mass_kg == 0:
        return _data_sheet(task)
    result = calibrate_weight(task.config, mass_kg, prompt=task.person.do, progress=task.progress)
    origin = f"balanced {1e3 * mass_kg:g} g, {date.today().isoformat()}"
    settings = result.settings
    if "friction_n" in settings:
        settings["friction_std"] = FRICTION_DRIFT  # the jaws step has measured it
    origins = {
        "nm_per_a": f"{interval(result.nm_per_a)}, {origin}",
        "gain_std": f"relative error of nm_per_a, {origin}",
        "friction_n": f"that of the homing, scaled like nm_per_a, {origin}",
        "friction_std": "relative error of friction_n",
    }
    values = {f"gripper.{key}": Found(round(value, 5), origins[key]) for key, value in settings.items()}
    calibrated_config = task.config.with_values(gripper=settings)
    return StepResult(
        f"{result.nm_per_a.value:.3f} Nm/A ({interval(result.nm_per_a)})",
        values,
        [_reference(calibrated_config)],
        details={"weight": result, "intervals_n": _intervals_n(calibrated_config)},
        used={"mass_kg": mass_kg},
    )


def _data_sheet(task: Task) -> StepResult:
    config = resolve(task.config, vision=False).config
    return StepResult(
        f"torque constant of the data sheet, {config.gripper.nm_per_a:.3f} Nm/A, not measured",
        remarks=[_reference(config)],
        details={"intervals_n": _intervals_n(config)},
    )


def _intervals_n(config: Config) -> dict[str, Any]:
    """95 % intervals of the force at a jaw, while motor current reads some forces after closing."""
    gripper = config.gripper
    bounds = {}
    for force_n in _FORCES_N:
        gain_n = gripper.gain_std * (force_n + gripper.friction_n)
        half_n = NORMAL * math.hypot(gain_n, gripper.friction_std * gripper.friction_n)
        bounds[f"{force_n:g}"] = [round(max(force_n - half_n, 0.0), 2), round(force_n + half_n, 2)]
    return bounds


def _reference(config: Config) -> str:
    bounds = ", ".join(f"{of} N: {low:g} to {high:g}" for of, (low, high) in _intervals_n(config).items())
    return f"force by motor current alone, 95 % interval: {bounds}"
