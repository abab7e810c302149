"""Calibration of a servo: torque, friction and jaw geometry, with the load cell's body as a gauge."""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from gripper_calibration.fits.servo_fit import FreePass, Nominal, ServoFit, ServoPress, fit_servo
from gripper_calibration.plots.servo_plot import draw
from gripper_calibration.procedures.servo_measurement import CLEARANCE_M, measure, reference_m_per_rad
from gripper_force.config import Config
from gripper_force.errors import ConfigError, DataError
from gripper_force.jobs.profile_files import rig_to_update, update_rig
from gripper_force.profiles.rig_profile import CalibratedValue, RigProfile, ServoCalibration
from gripper_force.progress import Progress, Prompt, no_progress
from gripper_force.runtime.backends import is_simulated
from gripper_force.runtime.resolve import resolve

PLAUSIBLE_RATIO: Final = 1.4
"""Largest ratio between the measured and the expected torque constant, either way; see gripper.gain_bound."""

SIM_GAUGE: Final = "block"
SIM_GAUGE_MM: Final = 30.0
"""The simulated object that stands for a load cell's rigid body, and its width."""

_NOTED_SHIFT_M: Final = 0.003
"""Change of the widths that a person should hear of."""


@dataclass(frozen=True, slots=True)
class ServoResult:
    """Result of `calibrate_servo`.

    Attributes:
        calibration: The section of the rig profile.
        n_per_a: Jaw force per ampere.
        friction_share: Growth of friction with the force, as a share of it.
        free_friction_n: Friction in free travel.
        lag_s: Lag from motor current to force.
        offset_a: Offset of the measured current.
        presses: Number of presses.
        passes: Number of passes of free travel.
        width_shift_m: Width with the calibrated angle of the open jaws, less that with the configured one.
        rig: The rig profile.
        report: The figure, PNG.
    """

    calibration: ServoCalibration
    n_per_a: CalibratedValue
    friction_share: CalibratedValue
    free_friction_n: CalibratedValue
    lag_s: CalibratedValue
    offset_a: CalibratedValue
    presses: int
    passes: int
    width_shift_m: float
    rig: Path
    report: Path

    @property
    def width_remark(self) -> str | None:
        """Sentence about a shift of the widths that a person should hear of; None if there is none."""
        if abs(self.width_shift_m) <= _NOTED_SHIFT_M:
            return None
        return (
            f"with this calibration every width is {1e3 * abs(self.width_shift_m):.0f} mm "
            f"{'larger' if self.width_shift_m > 0 else 'smaller'} than the configuration said; if its widths were "
            "right, the gauge has another width than --gauge-mm"
        )


def calibrate_servo(
    config: Config,
    gauges_m: Sequence[float],
    rig: Path,
    *,
    prompt: Prompt,
    progress: Progress = no_progress,
) -> ServoResult:
    """Presses each gauge, moves freely, and writes the rig profile's section and a figure beside it.

    Args:
        config: The configuration.
        gauges_m: Width of each gauge in metres, in the order of their use.
        rig: Rig profile to write; an existing one keeps its other sections.
        prompt: Called when a person has to place a gauge between the jaws.
        progress: Called with the step and the force a few times per second.

    Raises:
        ConfigError: There is no load cell, a gauge does not fit or is no gauge, there are two servos,
            or the profile can't be read or written.
        DeviceError: A device failed, or the jaws start outside their travel. The servo has no torque.
        DataError: The jaws met nothing, or the readings are not sufficient for a calibration.
    """
    if len(config.servo.ids) > 1:
        raise ConfigError(
            "calibrate servo moves the jaws with small constant currents, at which two servos do not stay in step; "
            "with servo.second, hold a load cell with `grasp`, and scale gripper.nm_per_a by the measured over the "
            "target force"
        )
    if config.load_cell.backend == "none":
        raise ConfigError(
            "calibrate servo needs a load cell, but load_cell.backend is none; set the backend of yours"
        )
    for width_m in gauges_m:
        if not 0 < width_m < config.gripper.open_width_m - 2 * CLEARANCE_M:
            raise ConfigError(
                f"a gauge of {1e3 * width_m:g} mm does not fit between jaws that open to "
                f"{1e3 * config.gripper.open_width_m:g} mm (gripper.open_width_m); use a narrower one"
            )
    if is_simulated(config) and config.sim.object is None and config.object != SIM_GAUGE:
        raise ConfigError(
            f"calibrate servo presses a rigid gauge, but the simulated object is {config.object!r}; pass --set "
            f"object={SIM_GAUGE} --gauge-mm {SIM_GAUGE_MM:g}"
        )
    profile = rig_to_update(rig)
    nominal = Nominal(
        reference_m_per_rad(config.gripper), config.gripper.open_width_m, _scale_share(profile, config, rig)
    )
    config = resolve(config.with_values(camera={"backend": "none"}), vision=False).config
    presses: list[ServoPress] = []
    passes: list[FreePass] = []
    for width_m in gauges_m:
        prompt(f"Put the load cell with its width of {1e3 * width_m:g} mm between the open jaws")
        new_presses, new_passes = measure(config, width_m, progress)
        presses += new_presses
        passes += new_passes
    fit = fit_servo(presses, passes, nominal)
    _check_plausible(fit, config)
    calibration = _section(fit, config)
    update_rig(rig, calibration)
    report = rig.with_name(f"{rig.stem}-servo.png")
    draw(fit, presses, report)
    return ServoResult(
        calibration=calibration,
        n_per_a=fit.n_per_a,
        friction_share=fit.friction_share,
        free_friction_n=fit.free_friction_n,
        lag_s=fit.lag_s,
        offset_a=fit.offset_a,
        presses=len(presses),
        passes=len(passes),
        width_shift_m=2
        * nominal.pinion_radius_m
        * (fit.open_position_rad.value - config.gripper.closing_sign * config.gripper.open_position_rad),
        rig=rig,
        report=report,
    )


def _check_plausible(fit: ServoFit, config: Config) -> None:
    """Raises `DataError` if the torque constant is far from the expected one: the load cell may be mis-scaled."""
    expected, measured = config.gripper.nm_per_a, fit.nm_per_a.value
    assert expected is not None
    if not 1 / PLAUSIBLE_RATIO < measured / expected < PLAUSIBLE_RATIO:
        raise DataError(
            f"the presses give a torque constant of {measured:.3g} Nm/A, {measured / expected:.2f} times the expected "
            f"{expected:.3g}: calibrate the load cell with weights again (load_cell.n_per_raw), and check "
            "servo.model and gripper.pinion_radius_m; if the gripper is really so, set gripper.nm_per_a to "
            f"{measured:.3g} and start again"
        )


def _scale_share(profile: RigProfile, config: Config, rig: Path) -> float:
    """Relative half-width of the interval of the load cell's scale; 0 if the profile has none of this load cell."""
    cell = profile.load_cell
    if cell is None or cell.sensor != config.load_cell.sensor:
        return 0.0
    if cell.n_per_raw.value != config.load_cell.n_per_raw:
        raise ConfigError(
            f"{rig} has {cell.n_per_raw.value:g} N per raw unit for this load cell, but load_cell.n_per_raw is "
            f"{config.load_cell.n_per_raw}; use the profile with --set calibration.rig={rig}, or write another "
            "one with --rig"
        )
    return cell.n_per_raw.half / abs(cell.n_per_raw.value)


def _section(fit: ServoFit, config: Config) -> ServoCalibration:
    opening, sign = fit.open_position_rad, config.gripper.closing_sign
    ends = sorted(sign * end for end in (opening.low, opening.high) if end is not None)
    return ServoCalibration(
        date=datetime.now(UTC).replace(microsecond=0),
        model=config.servo.model,
        nm_per_a=fit.nm_per_a,
        friction_n=fit.friction_n,
        damping_n_s_m=fit.damping_n_s_m,
        pinion_radius_m=(
            fit.pinion_radius_m
            if config.gripper.linkage.kind == "rack"
            else CalibratedValue(value=config.gripper.pinion_radius_m)
        ),
        open_position_rad=opening.model_copy(
            update={"value": sign * opening.value, "low": ends[0], "high": ends[-1]}
        ),
        open_width_m=config.gripper.open_width_m,
        force_n=fit.force_n,
        speed_m_s=fit.speed_m_s,
        residual_n=fit.residual_n,
    )
