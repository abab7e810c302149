"""State and results of a gripper, as its users see them."""

from __future__ import annotations

from dataclasses import dataclass

from gripper_force.control.state_machine import Decision
from gripper_force.types import EstimateSource, LoadCellSample, Outcome, Phase, ServoState


@dataclass(frozen=True, slots=True)
class GraspResult:
    """Result of a grasp or of a change of force.

    Attributes:
        outcome: ``held``, ``no_object``, ``stuck``, ``slip``, ``timeout`` or ``fault`` (an `Outcome`).
        force_n: Estimated contact force when the outcome was reached, in newtons.
        std_n: Standard deviation of this estimate, in newtons.
        width_m: Distance between the jaws, in metres.
        vision_share: Share of the control cycles of the hold in which vision was used, 0 to 1; 0 without a hold.
        reason: The controller's reason for the outcome, one sentence.
        object_gain: Gain of the object (its stiffness over that of its kind) by motor current; None if it is not
            known.
        object_gain_std: Its relative standard deviation; None if it is not known.
    """

    outcome: Outcome
    force_n: float
    std_n: float
    width_m: float
    vision_share: float
    reason: str
    object_gain: float | None = None
    object_gain_std: float | None = None

    @property
    def held(self) -> bool:
        """True if the object is held with the requested force."""
        return self.outcome == Outcome.HELD


@dataclass(frozen=True, slots=True)
class GripperState:
    """State of the gripper after one control cycle.

    Attributes:
        t_ns: Time of the cycle on the run's clock, in nanoseconds.
        phase: What the controller is doing (a `Phase`).
        outcome: Result of the newest grasp or move (see `Outcome`); ``Outcome.NONE`` while it is under way.
        reason: Newest reason of a change of phase or outcome.
        reference_n: Force that the loop steers to in this cycle, in newtons.
        force_n: Estimated contact force, in newtons.
        std_n: Its standard deviation, in newtons.
        source: Sensors that the estimate rests on (an `EstimateSource`).
        width_m: Distance between the jaws, in metres.
        position_rad: Angle of the servo horn, in radians.
        current_a: Motor current, in amperes.
        temperature_c: Temperature of the servo, in degrees Celsius.
        voltage_v: Supply voltage, in volts.
        load_cell_n: Newest valid reading of the load cell, in newtons; None without one.
    """

    t_ns: int
    phase: Phase
    outcome: Outcome
    reason: str
    reference_n: float
    force_n: float
    std_n: float
    source: EstimateSource
    width_m: float
    position_rad: float
    current_a: float
    temperature_c: float
    voltage_v: float
    load_cell_n: float | None


class StateTracker:
    """Builds state and result after each control cycle, and counts the cycles of a hold."""

    def __init__(self) -> None:
        self._hold_cycles = self._vision_cycles = 0

    def update(
        self,
        decision: Decision,
        servo: ServoState,
        cell: LoadCellSample | None,
        *,
        reason: str,
        restart: bool,
    ) -> tuple[GripperState, GraspResult]:
        """Returns the state after a cycle, and the result of a request that ends with it.

        ``reason`` is the newest reason of a change of phase or outcome. ``restart`` is True if the cycle started a new
        request, whose hold is counted from zero.
        """
        status, estimate = decision.status, decision.estimate
        if restart:
            self._hold_cycles = self._vision_cycles = 0
        if status.phase == Phase.HOLD:
            self._hold_cycles += 1
            self._vision_cycles += estimate.source != EstimateSource.CURRENT
        state = GripperState(
            t_ns=status.t_ns,
            phase=Phase(status.phase),
            outcome=Outcome(status.outcome),
            reason=reason,
            reference_n=status.reference_n,
            force_n=estimate.force_n,
            std_n=estimate.std_n,
            source=EstimateSource(estimate.source),
            width_m=status.width_m,
            position_rad=servo.position_rad,
            current_a=servo.current_a,
            temperature_c=servo.temperature_c,
            voltage_v=servo.voltage_v,
            load_cell_n=None if cell is None else cell.force_n,
        )
        share = self._vision_cycles / self._hold_cycles if self._hold_cycles else 0.0
        gain = estimate.object_gain or None
        gain_std = estimate.object_gain_std if gain else None
        return state, GraspResult(
            state.outcome, state.force_n, state.std_n, state.width_m, share, state.reason, gain, gain_std
        )
