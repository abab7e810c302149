"""Frozen records exchanged between the parts of the project, in SI units, with the unit in the name.

Time is the host's monotonic clock in integer nanoseconds (``t_ns``); in lockstep it is the simulated clock.
Images are logged as ``foxglove.RawImage``, all other records field by field (see `gripper_force.runtime.log_codecs`),
so the type of their fields is ``int``, ``float``, ``bool`` or ``str``.
"""

from dataclasses import dataclass
from enum import StrEnum
from typing import Final

import numpy as np
import numpy.typing as npt

NS_PER_S: Final = 1_000_000_000
NS_PER_MS: Final = 1_000_000
STANDARD_GRAVITY_M_S2: Final = 9.80665

Gray = npt.NDArray[np.uint8]
"""A gray image, (H, W) uint8."""


class Phase(StrEnum):
    """State of the grasp controller."""

    OPEN = "open"
    APPROACH = "approach"
    CONTACT = "contact"
    RAMP = "ramp"
    HOLD = "hold"
    RELEASE = "release"
    MOVE = "move"
    FAULT = "fault"


GRIPPING: Final = (Phase.CONTACT, Phase.RAMP, Phase.HOLD)
"""Phases in which the jaws grip an object."""


class Outcome(StrEnum):
    """Result of a grasp, of a move, or of a release that fails (``BLOCKED``); ``NONE`` while it is under way."""

    NONE = ""
    HELD = "held"
    NO_OBJECT = "no_object"
    STUCK = "stuck"
    SLIP = "slip"
    TIMEOUT = "timeout"
    FAULT = "fault"
    MOVED = "moved"
    BLOCKED = "blocked"


class RequestKind(StrEnum):
    """Kind of a request. A newer request pre-empts an older one; stop has priority over all others."""

    GRASP = "grasp"
    RELEASE = "release"
    MOVE = "move"
    STOP = "stop"


class EstimateSource(StrEnum):
    """Sensors that a force estimate is computed from."""

    FUSED = "fused"
    CURRENT = "current"
    VISION = "vision"


@dataclass(frozen=True, slots=True)
class ServoState:
    """Servo state read in one bus cycle.

    Attributes:
        t_ns: Host time of the reading.
        position_rad: Angle of the horn; 0 rad is tick 2048.
        velocity_rad_s: Angular velocity of the horn.
        current_a: Motor current, signed.
        temperature_c: Temperature of the servo.
        voltage_v: Supply voltage at the servo.
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
    """Goals written to the servo in one bus cycle, in current-based position mode (5).

    Attributes:
        t_ns: Host time of the decision.
        goal_position_rad: Goal position, which limits the travel.
        goal_current_a: Limit on the magnitude of the current, and with it on the force. Never negative.
    """

    t_ns: int
    goal_position_rad: float
    goal_current_a: float


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One gray camera frame.

    Attributes:
        t_ns: Host time at the middle of the exposure.
        received_ns: Host time at which the frame became available.
        seq: Frame number of the camera; a gap is a lost frame.
        gray: Image, (H, W) uint8.
    """

    t_ns: int
    received_ns: int
    seq: int
    gray: Gray


@dataclass(frozen=True, slots=True, eq=False)
class AttentionMap:
    """Spatial attention of the network over one frame.

    Attributes:
        t_ns: Capture time of the frame.
        received_ns: Host time at which the map became available.
        seq: Number of the frame.
        gray: Attention over the region of interest, (h, w) uint8: 0 where it is least, 255 where it is most.
    """

    t_ns: int
    received_ns: int
    seq: int
    gray: Gray


@dataclass(frozen=True, slots=True)
class LoadCellSample:
    """One load-cell sample.

    Attributes:
        t_ns: Host time of the sample.
        force_n: Force after tare and scale.
        raw: Value before tare and scale, in the unit of the sensor.
        valid: False if the sample was rejected (spike, saturation, stuck value).
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
    """Visual estimate for one frame.

    Attributes:
        t_ns: Capture time of the frame.
        ready_ns: Host time at which the estimate became available.
        seq: Number of the frame.
        force_n: Estimated contact force; NaN if the view is covered or blurred, or the object is gone.
        std_n: Standard deviation claimed by the estimator; infinite if the frame is unfamiliar.
        compute_ms: Computing time of the estimator.
    """

    t_ns: int
    ready_ns: int
    seq: int
    force_n: float
    std_n: float
    compute_ms: float

    @property
    def is_familiar(self) -> bool:
        """False if the frame raised `UnfamiliarFrameError`; ``force_n`` is then not the contact force."""
        return self.std_n != float("inf")


@dataclass(frozen=True, slots=True)
class FusedForce:
    """Fused estimate: the force that the force loop controls.

    Attributes:
        t_ns: Time of the estimate.
        force_n: Estimated contact force.
        std_n: Standard deviation of `force_n`.
        current_n: Current estimate: the force by the motor current alone.
        bias_n: Correction that the filter adds to `current_n`.
        friction_n: Coulomb friction of one jaw, estimated during free travel.
        source: Sensors used (an `EstimateSource` value).
        object_gain: Gain of the object, the factor on visual estimates, as far as motor current has shown it; 0 if it
            has not.
        object_gain_std: Its relative standard deviation.
    """

    t_ns: int
    force_n: float
    std_n: float
    current_n: float
    bias_n: float
    friction_n: float
    source: str
    object_gain: float = 0.0
    object_gain_std: float = 0.0


@dataclass(frozen=True, slots=True)
class Request:
    """Request to the controller.

    Attributes:
        t_ns: Host time of the request.
        kind: A `RequestKind` value.
        target_n: Wanted grip force (grasp only).
        width_m: Wanted distance between the jaws (move only).
        new_object: True if the camera sees another object than in the grasps before (grasp only): the newest frames
            become the reference of vision, and the gain that was learned is forgotten.
    """

    t_ns: int
    kind: str
    target_n: float = 0.0
    width_m: float = 0.0
    new_object: bool = False


@dataclass(frozen=True, slots=True)
class GraspStatus:
    """State of the grasp after one control cycle.

    Attributes:
        t_ns: Time of the cycle.
        phase: A `Phase` value.
        outcome: An `Outcome` value.
        reference_n: Reference of the force loop in this cycle (the target, shaped by the ramp).
        width_m: Distance between the jaws.
        reason: Reason for a change of phase or outcome, or the end of a move, in this cycle; otherwise empty.
    """

    t_ns: int
    phase: str
    outcome: str
    reference_n: float
    width_m: float
    reason: str = ""


@dataclass(frozen=True, slots=True)
class Event:
    """Message in the log: a retry on the bus, a dropped frame, an active limit.

    Attributes:
        t_ns: Time of the event.
        unit: Part that reports it (``servo``, ``camera``, ``vision``, ``control``, ``session``...).
        text: One sentence.
    """

    t_ns: int
    unit: str
    text: str


Record = (
    ServoState
    | ServoCommand
    | Frame
    | AttentionMap
    | LoadCellSample
    | VisualForce
    | FusedForce
    | Request
    | GraspStatus
    | Event
)
