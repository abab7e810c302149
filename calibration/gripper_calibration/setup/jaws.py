"""Step ``jaws``: finds the ends of the travel, the closing direction and friction."""

import math
from datetime import date

from gripper_calibration.procedures.calibrate_jaws import calibrate_jaws
from gripper_calibration.setup.step import ANSWERED, Found, StepResult, Task
from gripper_force.config import GripperConfig
from gripper_force.runtime.backends import is_simulated
from gripper_force.runtime.resolve import resolve

_AIR = "none"
"""The simulated object that is no object."""


def jaws(task: Task) -> StepResult:
    """Asks for the geometry that is not given, and moves the empty jaws to both ends.

    Raises:
        ConfigError: The travel leaves the servo's turn, so its angle is lost at power-off.
        GripperError: See `calibrate_jaws`.
    """
    config, values = task.config, {}
    for key, question in (
        ("pinion_radius_m", "Pitch radius of the pinion in mm"),
        ("open_width_m", "Distance between the open jaws in mm"),
    ):
        rack_only = key == "pinion_radius_m" and config.gripper.linkage.kind != "rack"
        if f"gripper.{key}" in task.given or rack_only:
            continue
        default_mm = 1e3 * getattr(config.gripper, key)
        answer_m = 1e-3 * task.number(question, f"--set gripper.{key}=METRES", default_mm)
        config = config.with_values(gripper={key: answer_m})
        is_default = math.isclose(answer_m, getattr(GripperConfig(), key))
        origin = "default, not measured" if is_default else ANSWERED
        values[f"gripper.{key}"] = Found(round(answer_m, 6), origin)
    homed = config
    if is_simulated(config):
        homed = config.with_values(object=_AIR)
        if config.sim.open_width_m is None:  # what is found must not change the simulated gripper
            true_m = config.gripper.open_width_m
            values["sim.open_width_m"] = Found(true_m, "true width of the simulated jaws")
    result = calibrate_jaws(homed, prompt=task.person.do, progress=task.progress)
    today = date.today().isoformat()
    origin = f"homed {today}, ends repeated within {result.repeat_rad:.3f} rad"
    values |= {
        "gripper.closing_sign": Found(result.closing_sign, f"homed {today}"),
        "gripper.open_position_rad": Found(round(result.open_position_rad, 4), origin),
        "gripper.open_width_m": Found(
            round(result.open_width_m, 4),
            f"travel between the ends, homed {today}"
            if config.gripper.linkage.kind == "rack"
            else "of the linkage",
        ),
        "gripper.friction_n": Found(
            round(result.friction_n, 2),
            f"{result.running_n[0]:.2f} N closing, {result.running_n[1]:.2f} N opening, homed {today}",
        ),
    }
    if result.position_bound_rad is not None:
        values["gripper.position_bound_rad"] = Found(
            result.position_bound_rad, "error of the ends, and of the linkage's travel"
        )
    found_keys = (key.partition(".") for key in values)
    gripper = {key: values[f"gripper.{key}"].value for part, _, key in found_keys if part == "gripper"}
    resolve(config.with_values(gripper=gripper), vision=False)  # the travel must lie within the servo's turn
    return StepResult(
        f"the jaws open to {1e3 * result.open_width_m:.1f} mm, close with "
        f"{'rising' if result.closing_sign > 0 else 'falling'} angle, friction {result.friction_n:.2f} N",
        values,
        details={"jaws": result},
    )
