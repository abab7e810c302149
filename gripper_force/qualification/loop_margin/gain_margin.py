"""The gain margin of the force loop: predicted from the plant that was identified, and observed.

The margin is the factor by which the loop's gain may be raised before a swing of the force stops dying out.
It is raised as a user would, by ``control.plant_gain``: gains go with its inverse.

The loop is not linear. Its deadband leaves small errors alone, friction takes the swing of small pushes, and
the push is bounded. The swing is therefore released from several times what friction takes, at a high force,
on a rig that is said to be known so badly that no bound and no gate acts.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from gripper_calibration.fits.plant_fit import PressSeries, fit_plant
from gripper_force.config import Config, ControlConfig
from gripper_force.control.force_loop import ForceLoop
from gripper_force.control.fusion import OBSERVER_LAG_S, Fusion
from gripper_force.control.limits import Limits
from gripper_force.control.state_machine import GraspController
from gripper_force.control.tuning import Gains
from gripper_force.qualification.loop_margin.analytic_plant import (
    CYCLE_NS,
    NOISE_A,
    Gripper,
    SimulatedVision,
    transmission_of,
)
from gripper_force.types import NS_PER_S, EstimateSource, Phase, Request, RequestKind, ServoCommand

SWING_N: Final = 4.0
"""From where the swing is released, with vision alone: four times what friction takes."""

FUSED_SWING_N: Final = 2.0
"""The same for the fused loop, whose bounds and gates are those of the rig as it is."""

FRAME_S: Final = 1 / 60
MARGINS: Final = {"vision": (0.3, 8.0), "fused": (1.0, 30.0)}
"""Between what the margin is looked for."""

_PRESS_N: Final = 9.0
_PRESS_S: Final = 7.0
_GENTLE_M_S: Final = 0.005  # else the impact on a stiff object leaves more force than the ramp begins with
_TARGET_N: Final = 20.0
_OPEN_M: Final = 1.0  # room for the softest object
_TIME_S: Final = 10.0
_LAST_S: Final = 2.0
_LEAST_SWING_N: Final = 1.0
_NOISE_N: Final = 0.02
_HALVINGS: Final = 7
_CYCLE_S: Final = CYCLE_NS / NS_PER_S
_CURRENT_LOOP_S: Final = 0.002
_ALIASES: Final = 8

Complex = npt.NDArray[np.complexfloating[Any, Any]]


@dataclass(frozen=True, slots=True)
class Identified:
    """What calibration finds of a plant: `gripper_calibration.fits.plant_fit`.

    Attributes:
        gain: Contact force for one newton of push.
        lag_s: From push to contact force.
    """

    gain: float
    lag_s: float


def identify(config: Config, truth: Gripper) -> Identified:
    """Presses by motor current alone, and fits the plant to ramps and holds, as calibration does."""
    control = config.control.model_copy(update={"feedback": "current", "approach_speed_m_s": _GENTLE_M_S})
    presses = []
    for seed in range(3):
        rng = np.random.default_rng([config.seed, 43, seed])
        gripper = replace(truth)
        controller = GraspController(control, truth.transmission, config.servo.current_limit_a)
        request: Request | None = Request(0, RequestKind.GRASP, min(_PRESS_N, 0.02 * truth.stiffness_n_m))
        rows: list[tuple[float, float, float]] = []
        for cycle, noise in enumerate(rng.standard_normal(round(_PRESS_S / _CYCLE_S)).tolist()):
            t_ns = cycle * CYCLE_NS
            servo = gripper.read(t_ns, NOISE_A * noise)
            decision = controller.step(t_ns, servo, None, request)
            request = None
            if decision.status.phase in (Phase.RAMP, Phase.HOLD):
                motor_force_n = truth.transmission.force_n(servo.current_a) - truth.transmission.friction_n
                rows.append((t_ns / NS_PER_S, motor_force_n, gripper.force_n))
            gripper.advance(decision.command, _CYCLE_S)
        presses.append(PressSeries(*(np.array(column) for column in zip(*rows, strict=True))))
    found = fit_plant(presses, 0.035)
    assert found is not None  # the presses above cover the whole range of forces
    return Identified(found.gain, 1e-3 * found.lag_ms)


def by_identified_plant(gains: Gains, plant: Identified, delay_s: float) -> float:
    """Margin with vision alone that gain, lag and delay predict."""

    def force(s: Complex) -> Complex:
        return plant.gain / (plant.lag_s * s + 1)

    return _sampled(gains, force, delay_s)


def with_inertia(gains: Gains, plant: Identified, truth: Gripper, delay_s: float) -> float:
    """Margin with vision alone that the identified gain predicts, with inertia and friction of the jaws.

    Friction counts as the damper that takes as much out of each swing (its describing function), and the
    swing is what friction has left of it when vision first tells of it.
    """
    stiffness_n_m, friction_n = truth.stiffness_n_m, truth.friction_n

    def force(s: Complex) -> Complex:
        swings = np.abs(s.imag) * (delay_s + FRAME_S / 2) / (2 * math.pi)
        left_n = np.maximum(SWING_N - 4 * friction_n * swings, _LEAST_SWING_N)
        braking = 1j * np.sign(s.imag) * 4 * friction_n / (math.pi * left_n)
        return plant.gain / (1 + (truth.mass_kg * s**2 + truth.damping_n_s_m * s) / stiffness_n_m + braking)

    return _sampled(gains, force, delay_s)


def by_rule(gains: Gains, plant: Identified, delay_s: float) -> float:
    """Margin of the fused hold that its tuning promises: an integral, and all lags of stuck jaws as delay."""
    whole_s = plant.lag_s + delay_s + FRAME_S / 2 + OBSERVER_LAG_S
    return math.pi / 2 / (gains.integral_s * plant.gain * whole_s)


def _sampled(gains: Gains, force: Callable[[Complex], Complex], delay_s: float) -> float:
    """Margin of a PI controller on frames that are each held until the next.

    What is above half the frame rate is folded back by the sampling, so the loop's response is a sum.
    """
    omega = np.geomspace(0.5, math.pi / FRAME_S, 4000)
    loop = np.zeros(len(omega), complex)
    for fold in range(-_ALIASES, _ALIASES + 1):
        s = 1j * (omega + fold * 2 * math.pi / FRAME_S)
        held = (1 - np.exp(-s * FRAME_S)) / (s * FRAME_S)
        late = np.exp(-s * (delay_s + _CYCLE_S / 2)) / (1 + _CURRENT_LOOP_S * s)
        loop += (gains.proportional + gains.integral_s / s) * held * late * force(s)
    factor = -1 / loop
    turns = np.flatnonzero((np.diff(np.sign(factor.imag)) != 0) & (factor.real[1:] > 0))
    found = [*factor.real[turns], *factor.real[-1:][factor.real[-1:] > 0]]  # at half the rate it is real
    return float(min(found, default=math.inf))


def observed(config: Config, truth: Gripper, feedback: str, delay_s: float) -> float:
    """Margin of the unmodified controller, by halving the interval within which it lies."""
    low, high = MARGINS[feedback]
    for _ in range(_HALVINGS):
        middle = math.sqrt(low * high)
        if dies_out(config, truth, feedback, delay_s, middle):
            low = middle
        else:
            high = middle
    return math.sqrt(low * high)


def dies_out(config: Config, truth: Gripper, feedback: str, delay_s: float, factor: float) -> bool:
    """Whether a swing dies out with so many times the loop gain, and vision counts to the end."""
    alone = feedback == "vision"
    swing_n = SWING_N if alone else FUSED_SWING_N
    rig = replace(truth.transmission, open_width_m=_OPEN_M)
    if alone:
        rig = replace(rig, gain_std=0.5)
    given = {
        **config.control.model_dump(),
        "feedback": feedback,
        "plant_gain": config.control.plant[0] / factor,
        "force_limit_n": 70.0,
        "vision_age_ms": 400.0,
        "vision_timeout_ms": 400.0,
    }
    control = ControlConfig.model_validate(given)
    depth_m = (_TARGET_N - swing_n) / truth.stiffness_n_m
    jaw_m = truth.contact_m + depth_m
    gripper = replace(
        truth,
        transmission=rig,
        x_m=jaw_m + truth.play_m,
        jaw_m=jaw_m,
        current_a=rig.current_a(_TARGET_N + rig.friction_n),
    )
    loop, fusion, limits = ForceLoop(control, rig), Fusion(control, rig), Limits(control, rig, 3.0)
    loop.start(_TARGET_N, _TARGET_N)
    vision = SimulatedVision(delay_s, _NOISE_N)
    rng = np.random.default_rng([config.seed, 44])
    cycles, forces_n = round(_TIME_S / _CYCLE_S), []
    source = ""
    for cycle, (servo_noise, vision_noise) in enumerate(rng.standard_normal((cycles, 2)).tolist()):
        t_ns = cycle * CYCLE_NS
        servo = gripper.read(t_ns, NOISE_A * servo_noise)
        estimate, _ = fusion.step(t_ns, servo, vision.sample(t_ns, gripper.force_n, vision_noise))
        source = estimate.source
        motor_force_n = loop.step(_CYCLE_S, _TARGET_N, estimate)
        goal_rad = rig.position_rad(max(rig.width_m(servo.position_rad) - 0.02, 0.0))
        wanted = ServoCommand(t_ns, goal_rad, abs(rig.current_a(motor_force_n)))
        motor_n = rig.force_n(servo.current_a)
        command, _ = limits.apply(
            wanted, estimate.force_n, estimate.friction_n, motor_n, _CYCLE_S, may_rise=True
        )
        forces_n.append(gripper.force_n)
        gripper.advance(command, _CYCLE_S)
    last = forces_n[-round(_LAST_S / _CYCLE_S) :]
    return max(last) - min(last) < swing_n / 2 and source != EstimateSource.CURRENT


def gains_of(config: Config, feedback: str) -> Gains:
    """The gains that the force loop takes."""
    margins = ForceLoop(config.control, transmission_of(config.gripper)).margins
    return margins["vision" if feedback == "vision" else "hold"].gains
