"""Resolution of a configuration: every choice made and every file read, once, before devices open."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from gripper_force.config import Config, ControlConfig, GripperConfig
from gripper_force.control.limits import largest_target_n, rounded_down
from gripper_force.control.speed_limit import PositionLoop
from gripper_force.control.state_machine import MAX_CYCLE_S, GraspController
from gripper_force.control.transmission import Transmission, force_bound
from gripper_force.errors import ConfigError, RequestError
from gripper_force.interfaces import ServoSpec
from gripper_force.plugins import importing
from gripper_force.profiles import apply
from gripper_force.runtime.backends import load_servo_class, resolve_simulation, with_camera_rate
from gripper_force.runtime.process import allowed_options
from gripper_force.runtime.requests import checked_number

if TYPE_CHECKING:  # a run without vision imports none of these
    from gripper_force.profiles.correction import Correction
    from gripper_force.vision.estimator import ForceEstimator
    from gripper_force.vision.header import Model

_SUPPLY_TOLERANCE_V = 0.5
"""A supply set to the end of the servo's range reads slightly beyond it."""

_MAX_RATIO = 3.0
"""A torque constant is plausible within this factor of the model's: the largest `gripper.gain_bound`."""

_MIN_TRAVEL_RAD = 0.3
"""Smallest plausible rotation of the horn for the whole travel of a rack. With less, the pinion's radius is wrong."""

_NO_SCORE = (
    "the network has no out-of-distribution score, so unfamiliar frames are not noticed; bfloat16, int8 and Gaussian "
    "processes have none, and `gripper-force calibrate network` fits that of other networks"
)

_CYCLES_PER_WATCHDOG = 2
"""One lost cycle must not make the servo stop."""


@dataclass(frozen=True, slots=True)
class ResolvedConfig:
    """A configuration with no choice left, and what was read for it.

    Attributes:
        config: The complete configuration: no ``auto``, servo data filled in, plant of the object profile.
        model: The network's file, or None for a run without vision.
        correction: The object profile's correction of estimates, or None.
        target_limits_n: Largest calibrated force by profile.
        notes: Facts for the log: unit and sentence.
        choices: What was chosen for each ``auto``, and why.
    """

    config: Config
    model: Model | None = None
    correction: Correction | None = None
    target_limits_n: Mapping[str, float] = field(default_factory=dict)
    notes: tuple[tuple[str, str], ...] = ()
    choices: tuple[str, ...] = ()

    @property
    def largest_target_n(self) -> float:
        """Largest target that `check_target` accepts."""
        limit_n = largest_target_n(self.config.control.force_limit_n, force_bound(self.config.gripper))
        return min([limit_n, *self.target_limits_n.values()])

    def check_target(self, target_n: float) -> None:
        """Raises `RequestError` if a target is beyond the force limit or a profile's calibrated range."""
        limit_n, bound = self.config.control.force_limit_n, force_bound(self.config.gripper)
        largest_n = largest_target_n(limit_n, bound)
        if not checked_number(target_n, "a target") > 0:
            raise RequestError(f"a target of {target_n} N is not a positive force; request more than 0 N")
        if target_n > largest_n:
            raise RequestError(
                f"a target of {target_n:g} N is too close to control.force_limit_n {limit_n:g} N: the motor force can "
                f"be {bound:.3g} times the calculated one (gripper.gain_bound and, with a linkage, "
                f"gripper.position_bound_rad); request at most {rounded_down(largest_n)} N, raise the limit, or lower "
                "the bounds after calibrate jaws and servo"
            )
        for name, max_n in self.target_limits_n.items():
            if target_n > max_n:
                raise RequestError(
                    f"a target of {target_n:g} N is above the {rounded_down(max_n)} N that the {name} was calibrated "
                    "with; request less, or calibrate with larger forces"
                )

    def check_width(self, width_m: float) -> None:
        """Raises `RequestError` if a width is outside the travel of the jaws."""
        open_width_m = self.config.gripper.open_width_m
        if not 0 <= checked_number(width_m, "a width") <= open_width_m:
            raise RequestError(
                f"a width of {1e3 * width_m:g} mm is outside 0 to {1e3 * open_width_m:g} mm, the travel of the "
                "jaws; request a width in metres within gripper.open_width_m"
            )


def resolve(config: Config, *, vision: bool = True) -> ResolvedConfig:
    """Resolves a configuration: rig and object profile, ``auto``, budgets, servo data, level of detail.

    Args:
        config: A configuration as loaded.
        vision: False for a run that only records frames: no network is loaded.

    Raises:
        ConfigError: Something is unknown, missing, inconsistent or beyond the budget.
        CheckpointError: The network's file cannot be read.
    """
    if not vision:
        config = config.with_values(vision={"checkpoint": "none"})
    _check_rate(config)
    config = with_camera_rate(config)
    config, bundle = apply.with_bundle(config)
    config, model, choice = resolve_vision(config)
    config, detail = resolve_simulation(config)
    spec = load_servo_class(config).spec(config.servo)
    _check_travel(config.gripper, spec)
    profiles = apply.read_profiles(config)
    control = apply.with_object(_complete_control(config, spec), profiles)
    config = config.with_values(gripper=_complete_gripper(config.gripper, spec), control=control)
    correction = apply.read_correction(config, profiles, model)
    mismatches = {
        "object profile": () if correction is None else correction.mismatches,
        "rig profile": apply.rig_mismatches(config, profiles),
        "network": () if model is None or correction else model.header.mismatches(config.rig_settings()),
    }
    notes = [
        ("vision", choice),
        ("session", bundle),
        ("simulation", detail),
        ("session", apply.override_note(config, profiles)),
        ("session", "" if model is None or _has_score(config, model) else _NO_SCORE),
        *(
            ("session", f"the {profile} was made with {'; '.join(differences)}")
            for profile, differences in mismatches.items()
            if differences
        ),
    ]
    return ResolvedConfig(
        config,
        model,
        correction,
        profiles.target_limits_n,
        tuple((unit, text) for unit, text in notes if text),
        tuple(text for text in (choice, detail) if text),
    )


def _has_score(config: Config, model: Model) -> bool:
    return model.header.ood is not None and config.vision.precision == "float32"


def resolve_vision(config: Config) -> tuple[Config, Model | None, str]:
    """Chooses network and engine where the configuration says ``auto``, and reads the network's header.

    Returns:
        The configuration without ``auto``, the network's file (None without vision), and the reason for the
        choice (empty if nothing was left to choose).

    Raises:
        ConfigError: Nothing fits the budget.
        CheckpointError: The network's file cannot be read.
    """
    if not config.uses_vision:
        return config, None, ""
    from gripper_force.vision.model_files import read_model

    choice = ""
    if "auto" in (config.vision.checkpoint, config.vision.engine):
        from gripper_force.vision.selection import resolve_auto

        threads = allowed_options().torch_threads
        vision, choice = resolve_auto(config.vision, config.budget, set_threads=threads)
        config = config.with_values(vision=vision)
    return config, read_model(config.vision.checkpoint), choice


def make_estimator(resolved: ResolvedConfig) -> ForceEstimator | None:
    """Opens the estimator of a run, or returns None for a run without vision."""
    if resolved.model is None:
        return None
    from gripper_force.vision.estimator import open_estimator

    vision, threads = resolved.config.vision, allowed_options().torch_threads
    return open_estimator(resolved.model, vision, resolved.correction, set_threads=threads)


def make_controller(config: Config) -> GraspController:
    """Builds the controller of a complete configuration, such as that of a `ResolvedConfig` or of a log.

    Raises:
        ConfigError: The configuration is not complete.
    """
    gripper = config.gripper
    if gripper.nm_per_a is None:
        raise ConfigError("gripper.nm_per_a is not set: this configuration was never resolved for a servo")
    transmission = Transmission.from_config(gripper, gripper.nm_per_a, gripper.current_step_a or 0.0)
    return GraspController(config.control, transmission, config.servo.current_limit_a, position_loop(gripper))


def position_loop(gripper: GripperConfig) -> PositionLoop | None:
    """Returns the position loop of a complete configuration's servo, or None if it is unknown."""
    if gripper.position_loop_a_per_rad is None or gripper.position_loop_gain_per_s is None:
        return None
    return PositionLoop(gripper.position_loop_a_per_rad, gripper.position_loop_gain_per_s)


def _complete_gripper(gripper: GripperConfig, spec: ServoSpec) -> GripperConfig:
    """Returns the section with the servo's data. Raises `ConfigError` for a torque constant that can't be right."""
    ratio = 1.0 if gripper.nm_per_a is None else gripper.nm_per_a / spec.nm_per_a
    if not 1 / _MAX_RATIO < ratio < _MAX_RATIO:
        raise ConfigError(
            f"gripper.nm_per_a={gripper.nm_per_a:g} is {ratio:.3g} times the {spec.nm_per_a:.3g} Nm/A of the servo's "
            "model, so that no force limit would hold; correct it, here or in the rig profile, or servo.model"
        )
    return gripper.filled(
        nm_per_a=spec.nm_per_a,
        current_step_a=spec.current_step_a,
        position_loop_a_per_rad=spec.position_loop_a_per_rad,
        position_loop_gain_per_s=spec.position_loop_gain_per_s,
    )


def _check_travel(gripper: GripperConfig, spec: ServoSpec) -> None:
    """Raises `ConfigError` if a rack's travel is too short, or a travel leaves the turn that the servo starts in."""
    with importing(f"gripper.linkage.kind={gripper.linkage.kind}"):
        transmission = Transmission.from_config(gripper, spec.nm_per_a)
    open_rad, closed_rad = transmission.open_position_rad, transmission.closed_position_rad
    if gripper.linkage.kind == "rack" and abs(closed_rad - open_rad) < _MIN_TRAVEL_RAD:
        raise ConfigError(
            f"gripper.pinion_radius_m={gripper.pinion_radius_m:g} moves the jaws over all of gripper.open_width_m="
            f"{gripper.open_width_m:g} in {abs(closed_rad - open_rad):.2g} rad, so that no force limit would hold; set "
            "the radius in metres (not the diameter), or the width, here or in the rig profile"
        )
    if spec.position_range_rad is None:
        return
    low_rad, high_rad = spec.position_range_rad
    if min(open_rad, closed_rad) < low_rad or max(open_rad, closed_rad) > high_rad:
        raise ConfigError(
            f"the jaws' travel from {open_rad:.2f} rad (open) to {closed_rad:.2f} rad (closed) leaves the "
            f"servo's turn, {low_rad:.2f} to {high_rad:.2f} rad: after power-on the position would be off by a "
            "turn; check gripper.open_position_rad, closing_sign, open_width_m and pinion_radius_m, also in the rig "
            "profile, or mount the horn so that the travel lies within the turn"
        )


def _complete_control(config: Config, spec: ServoSpec) -> ControlConfig:
    low_v, high_v = spec.voltage_range_v
    return config.control.filled(
        voltage_limits_v=(low_v - _SUPPLY_TOLERANCE_V, high_v + _SUPPLY_TOLERANCE_V),
        vision_rate_hz=config.camera.rate_hz,
    )


def _check_rate(config: Config) -> None:
    rate_hz, watchdog_ms = config.control.rate_hz, config.servo.bus_watchdog_ms
    if config.servo.reply_margin_ms >= watchdog_ms:
        raise ConfigError(
            f"servo.reply_margin_ms must be below servo.bus_watchdog_ms {watchdog_ms}; lower it"
        )
    if rate_hz < 1 / MAX_CYCLE_S:
        raise ConfigError(
            f"control.rate_hz {rate_hz:g} is too slow for a force loop; set at least {1 / MAX_CYCLE_S:g}"
        )
    if rate_hz < (min_hz := 1e3 * _CYCLES_PER_WATCHDOG / watchdog_ms):
        raise ConfigError(
            f"with control.rate_hz {rate_hz:g} and servo.bus_watchdog_ms {watchdog_ms} the servo would stop "
            f"by itself; set the rate to at least {min_hz:.4g}, or a longer watchdog time"
        )
