"""Gain margin of the force loop: predicted from the identified plant, and observed.

The margin is the factor by which the loop gain can be raised until an oscillation of the force no longer
decays. The gain is raised as a user would do it, by ``control.plant_gain``: gains follow its inverse.

The loop is not linear. Its deadband ignores small errors, friction absorbs small motor forces, and the motor
force is bounded. Therefore the oscillation starts with several times the friction, at a high force, with
prior variances so large that no bound and no gate acts.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from gripper_calibration.fits.plant_fit import PressSeries, fit_plant
from gripper_force.config import Config, ControlConfig
from gripper_force.control.force_loop import ForceLoop, loop_gains
from gripper_force.control.fusion import Fusion, observer_lag_s
from gripper_force.control.limits import Limits
from gripper_force.control.linkage import RackAndPinion
from gripper_force.control.state_machine import GraspController
from gripper_force.control.tuning import Gains
from gripper_force.qualification.loop_margin.analytic_plant import (
    CURRENT_LOOP_S,
    CYCLE_NS,
    NOISE_A,
    POSITION_LOOP,
    Gripper,
    SimulatedVision,
)
from gripper_force.types import NS_PER_S, EstimateSource, Phase, Request, RequestKind, ServoCommand

AMPLITUDE_N: Final = 4.0
"""Initial amplitude with vision alone: four times the friction."""

FUSED_AMPLITUDE_N: Final = 2.0
"""Initial amplitude of the fused loop, which keeps the configured bounds and gates."""

FRAME_S: Final = 1 / 60
"""Time between frames."""

SEARCH_RANGE: Final = {"vision": (0.3, 8.0), "fused": (1.0, 30.0)}
"""Range of the bisection for the margin, by feedback."""

_PRESS_N: Final = 9.0
_PRESS_S: Final = 7.0
_APPROACH_M_S: Final = 0.025
"""Approach speed of the presses, which also bounds the speed of the ramp. A lower one would be identified as lag of a
soft object, and a higher one leaves more force on a stiff object than the ramp starts with."""

_TARGET_N: Final = 20.0
_OPEN_WIDTH_M: Final = 1.0  # room for the softest object
_TIME_S: Final = 10.0
_JUDGED_S: Final = 2.0  # time at the end over which the oscillation is judged
_MIN_AMPLITUDE_N: Final = 1.0
_NOISE_N: Final = 0.02
_BISECTIONS: Final = 7
CYCLE_S: Final = CYCLE_NS / NS_PER_S
_ALIASES: Final = 8

Complex = npt.NDArray[np.complexfloating[Any, Any]]


@dataclass(frozen=True, slots=True)
class IdentifiedPlant:
    """Plant identified by calibration: `gripper_calibration.fits.plant_fit`.

    Attributes:
        gain: Contact force per newton of motor force.
        lag_s: Lag from motor force to contact force.
    """

    gain: float
    lag_s: float


def identify(config: Config, truth: Gripper) -> IdentifiedPlant:
    """Presses with motor current alone and fits the plant to ramps and holds, as calibration does."""
    control = config.control.model_copy(update={"feedback": "current", "approach_speed_m_s": _APPROACH_M_S})
    presses = []
    for seed in range(3):
        rng = np.random.default_rng([config.seed, 43, seed])
        gripper = replace(truth)
        controller = GraspController(control, truth.transmission, config.servo.current_limit_a, POSITION_LOOP)
        request: Request | None = Request(0, RequestKind.GRASP, min(_PRESS_N, 0.02 * truth.stiffness_n_m))
        rows: list[tuple[float, float, float]] = []
        for cycle, noise in enumerate(rng.standard_normal(round(_PRESS_S / CYCLE_S)).tolist()):
            t_ns = cycle * CYCLE_NS
            servo = gripper.read(t_ns, NOISE_A * noise)
            decision = controller.step(t_ns, servo, None, request)
            request = None
            if decision.status.phase in (Phase.RAMP, Phase.HOLD):
                motor_force_n = (
                    truth.transmission.force_n(servo.current_a, servo.position_rad)
                    - truth.transmission.friction_n
                )
                rows.append((t_ns / NS_PER_S, motor_force_n, gripper.force_n))
            gripper.advance(decision.command, CYCLE_S)
        presses.append(PressSeries(*(np.array(column) for column in zip(*rows, strict=True))))
    found = fit_plant(presses, 0.035)
    assert found is not None  # the presses above cover the whole force range
    return IdentifiedPlant(found.gain, 1e-3 * found.lag_ms)


def margin_by_lag(gains: Gains, plant: IdentifiedPlant, delay_s: float) -> float:
    """Returns the margin with vision alone, predicted from gain, lag and delay."""

    def force(s: Complex) -> Complex:
        return plant.gain / (plant.lag_s * s + 1)

    return _sampled_margin(gains, force, delay_s)


def margin_with_inertia(gains: Gains, plant: IdentifiedPlant, truth: Gripper, delay_s: float) -> float:
    """Returns the margin with vision alone, predicted from the identified gain, inertia and friction.

    Friction is a damper that removes the same energy per oscillation (its describing function), for the
    amplitude that friction has left when vision first shows the oscillation.
    """
    stiffness_n_m, friction_n = truth.stiffness_n_m, truth.friction_n

    def force(s: Complex) -> Complex:
        periods = np.abs(s.imag) * (delay_s + FRAME_S / 2) / (2 * math.pi)
        remaining_n = np.maximum(AMPLITUDE_N - 4 * friction_n * periods, _MIN_AMPLITUDE_N)
        braking = 1j * np.sign(s.imag) * 4 * friction_n / (math.pi * remaining_n)
        return plant.gain / (1 + (truth.mass_kg * s**2 + truth.damping_n_s_m * s) / stiffness_n_m + braking)

    return _sampled_margin(gains, force, delay_s)


def margin_by_rule(gains: Gains, plant: IdentifiedPlant, delay_s: float) -> float:
    """Returns the margin of the fused hold by its tuning: integral control, all lags as delay."""
    total_s = plant.lag_s + delay_s + FRAME_S / 2 + observer_lag_s(1 / FRAME_S)
    return math.pi / 2 / (gains.integral_s * plant.gain * total_s)


def _sampled_margin(gains: Gains, force: Callable[[Complex], Complex], delay_s: float) -> float:
    """Returns the margin of a PI controller on frames that are each held until the next.

    Sampling aliases frequencies above half the frame rate, so the response of the loop is a sum.
    """
    omega = np.geomspace(0.5, math.pi / FRAME_S, 4000)
    loop = np.zeros(len(omega), complex)
    for alias in range(-_ALIASES, _ALIASES + 1):
        s = 1j * (omega + alias * 2 * math.pi / FRAME_S)
        held = (1 - np.exp(-s * FRAME_S)) / (s * FRAME_S)
        late = np.exp(-s * (delay_s + CYCLE_S / 2)) / (1 + CURRENT_LOOP_S * s)
        loop += (gains.proportional + gains.integral_s / s) * held * late * force(s)
    factor = -1 / loop
    crossings = np.flatnonzero((np.diff(np.sign(factor.imag)) != 0) & (factor.real[1:] > 0))
    found = [*factor.real[crossings], *factor.real[-1:][factor.real[-1:] > 0]]  # at half the rate it is real
    return float(min(found, default=math.inf))


def observed_margin(config: Config, truth: Gripper, feedback: str, delay_s: float) -> float:
    """Returns the margin of the unmodified controller, by bisection."""
    low, high = SEARCH_RANGE[feedback]
    for _ in range(_BISECTIONS):
        middle = math.sqrt(low * high)
        if oscillation_decays(config, truth, feedback, delay_s, middle):
            low = middle
        else:
            high = middle
    return math.sqrt(low * high)


def oscillation_decays(config: Config, truth: Gripper, feedback: str, delay_s: float, factor: float) -> bool:
    """Returns True if an oscillation decays with ``factor`` times the loop gain while vision stays in use."""
    vision_alone = feedback == "vision"
    amplitude_n = AMPLITUDE_N if vision_alone else FUSED_AMPLITUDE_N
    radius_m = truth.transmission.jaw_m_per_rad(truth.transmission.open_position_rad)
    rig = replace(truth.transmission, linkage=RackAndPinion(radius_m, _OPEN_WIDTH_M))
    if vision_alone:
        rig = replace(rig, torque_constant_std=0.5)
    given = {
        **config.control.model_dump(),
        "feedback": feedback,
        "plant_gain": config.control.plant[0] / factor,
        "force_limit_n": 70.0,
        "vision_age_ms": 400.0,
        "vision_timeout_ms": 400.0,
    }
    control = ControlConfig.model_validate(given)
    depth_m = (_TARGET_N - amplitude_n) / truth.stiffness_n_m
    jaw_m = truth.contact_m + depth_m
    gripper = replace(
        truth,
        transmission=rig,
        x_m=jaw_m + truth.play_m,
        jaw_m=jaw_m,
        current_a=rig.current_a(_TARGET_N + rig.friction_n, rig.open_position_rad),
    )
    loop, fusion, limits = ForceLoop(control, rig), Fusion(control, rig), Limits(control, rig, 3.0)
    loop.start(_TARGET_N, _TARGET_N)
    vision = SimulatedVision(delay_s, _NOISE_N)
    rng = np.random.default_rng([config.seed, 44])
    cycles, forces_n = round(_TIME_S / CYCLE_S), []
    source = ""
    for cycle, (servo_noise, vision_noise) in enumerate(rng.standard_normal((cycles, 2)).tolist()):
        t_ns = cycle * CYCLE_NS
        servo = gripper.read(t_ns, NOISE_A * servo_noise)
        estimate, _ = fusion.step(t_ns, servo, vision.sample(t_ns, gripper.force_n, vision_noise))
        source = estimate.source
        motor_force_n = loop.step(CYCLE_S, _TARGET_N, estimate)
        goal_rad = rig.position_rad(max(rig.width_m(servo.position_rad) - 0.02, 0.0))
        wanted = ServoCommand(t_ns, goal_rad, abs(rig.current_a(motor_force_n, servo.position_rad)))
        motor_n = rig.force_n(servo.current_a, servo.position_rad)
        command, _ = limits.apply(
            wanted,
            estimate.force_n,
            estimate.friction_n,
            motor_n,
            servo.position_rad,
            CYCLE_S,
            may_rise=True,
        )
        forces_n.append(gripper.force_n)
        gripper.advance(command, CYCLE_S)
    last = forces_n[-round(_JUDGED_S / CYCLE_S) :]
    return max(last) - min(last) < amplitude_n / 2 and source != EstimateSource.CURRENT


def gains_of(config: Config, feedback: str) -> Gains:
    """Returns the gains of the force loop."""
    return loop_gains(config.control, vision_alone=feedback == "vision")
