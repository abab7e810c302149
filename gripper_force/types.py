"""Frozen records that travel through the project, in SI units, with the unit in the name.

Time is the host's monotonic clock in integer nanoseconds (``t_ns``). In lockstep it is the simulated clock.
Every record but `Frame` is written to a log field by field (see `gripper_force.runtime.log`), so a field's
type is ``int``, ``float``, ``bool`` or ``str``.
"""

from dataclasses import dataclass
from enum import StrEnum
from typing import Final

import numpy as np
import numpy.typing as npt

NS_PER_S: Final = 1_000_000_000
NS_PER_MS: Final = 1_000_000

Gray = npt.NDArray[np.uint8]
"""A gray image, (H, W) uint8."""


class Phase(StrEnum):
    """What the grasp controller is doing."""

    OPEN = "open"
    APPROACH = "approach"
    CONTACT = "contact"
    RAMP = "ramp"
    HOLD = "hold"
    RELEASE = "release"
    MOVE = "move"
    FAULT = "fault"


class Outcome(StrEnum):
    """Result of a grasp or a move; ``NONE`` while it is under way."""

    NONE = ""
    HELD = "held"
    NO_OBJECT = "no_object"
    SLIP = "slip"
    TIMEOUT = "timeout"
    FAULT = "fault"
    MOVED = "moved"
    BLOCKED = "blocked"


class RequestKind(StrEnum):
    """What a caller asks of the controller. A newer request pre-empts an older one; stop always wins."""

    GRASP = "grasp"
    RELEASE = "release"
    MOVE = "move"
    STOP = "stop"


class EstimateSource(StrEnum):
    """Which sensors a force estimate rests on."""

    FUSED = "fused"
    CURRENT = "current"
    VISION = "vision"


@dataclass(frozen=True, slots=True)
class ServoState:
    """What one bus cycle read from the servo.

    Attributes:
        t_ns: Host time of the reading.
        position_rad: Angle of the horn; 0 rad is tick 2048.
        velocity_rad_s: Angular velocity of the horn.
        current_a: Motor current, signed.
        temperature_c: Temperature of the servo.
        voltage_v: Supply at the servo.
        hardware_error: The Hardware Error Status byte (0: none).
    """

    t_ns: int
    position_rad: float
    velocity_rad_s: float
    current_a: float
    temperature_c: float
    voltage_v: float
    hardware_error: int


@dataclass(frozen=True, slots=True)
class ServoCommand:
    """What one bus cycle writes to the servo, in current-based position mode (5).

    Attributes:
        t_ns: Host time of the decision.
        goal_position_rad: Bounds the travel.
        goal_current_a: Magnitude that bounds the current, and with it the force. Never negative.
    """

    t_ns: int
    goal_position_rad: float
    goal_current_a: float


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One gray camera frame.

    Attributes:
        t_ns: Host time at the middle of the exposure.
        received_ns: Host time at which the frame could first be used.
        seq: The camera's frame number; a gap is a lost frame.
        gray: Image, (H, W) uint8.
    """

    t_ns: int
    received_ns: int
    seq: int
    gray: Gray


@dataclass(frozen=True, slots=True)
class LoadCellSample:
    """One load-cell reading.

    Attributes:
        t_ns: Host time of the sample.
        force_n: Force after tare and scale.
        raw: The reading before tare and scale, in the sensor's own unit.
        valid: False where the sample was rejected (spike, saturation, stuck value).
    """

    t_ns: int
    force_n: float
    raw: float
    valid: bool = True


@dataclass(frozen=True, slots=True)
class ForceEstimate:
    """Estimate of the contact force from one frame.

    Attributes:
        force_n: Contact force.
        std_n: Standard deviation of its error, as the estimator claims it.
    """

    force_n: float
    std_n: float


@dataclass(frozen=True, slots=True)
class VisualForce:
    """The network's estimate for one frame.

    Attributes:
        t_ns: Capture time of the frame.
        ready_ns: Host time at which the estimate was there.
        seq: The frame's number.
        force_n: Estimated contact force.
        std_n: Standard deviation the estimator claims for it.
        compute_ms: Time the estimator took.
    """

    t_ns: int
    ready_ns: int
    seq: int
    force_n: float
    std_n: float
    compute_ms: float


@dataclass(frozen=True, slots=True)
class FusedForce:
    """The estimate the force loop acts on.

    Attributes:
        t_ns: Time it holds for.
        force_n: Estimated contact force.
        std_n: Its standard deviation.
        current_n: What the motor current alone says.
        bias_n: Correction of the current-derived force, held by the filter.
        friction_n: Coulomb friction of one jaw, as free travel told it.
        source: Which sensors the estimate rests on (a `EstimateSource` value).
    """

    t_ns: int
    force_n: float
    std_n: float
    current_n: float
    bias_n: float
    friction_n: float
    source: str


@dataclass(frozen=True, slots=True)
class Request:
    """What a caller asks for.

    Attributes:
        t_ns: Host time of the request.
        kind: A `RequestKind` value.
        target_n: Wanted grip force (grasp only).
        width_m: Wanted distance between the jaws (move only).
    """

    t_ns: int
    kind: str
    target_n: float = 0.0
    width_m: float = 0.0


@dataclass(frozen=True, slots=True)
class GraspStatus:
    """Where the grasp stands after one control cycle.

    Attributes:
        t_ns: Time of the cycle.
        phase: A `Phase` value.
        outcome: An `Outcome` value.
        reference_n: Force the loop steers to in this cycle (the target, shaped by the ramp).
        width_m: Distance between the jaws.
        reason: Why the phase or the outcome changed in this cycle; empty otherwise.
    """

    t_ns: int
    phase: str
    outcome: str
    reference_n: float
    width_m: float
    reason: str = ""


@dataclass(frozen=True, slots=True)
class Event:
    """Something worth a line: a retry on the bus, a dropped frame, a limit that acted.

    Attributes:
        t_ns: When.
        unit: Which part says so (``servo``, ``camera``, ``vision``, ``control``, ``session``...).
        text: One sentence.
    """

    t_ns: int
    unit: str
    text: str


Record = (
    ServoState
    | ServoCommand
    | Frame
    | LoadCellSample
    | VisualForce
    | FusedForce
    | Request
    | GraspStatus
    | Event
)
