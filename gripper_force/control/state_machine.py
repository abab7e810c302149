"""State machine of the grasp: phases, outcomes, and the command of each phase."""

import dataclasses
import math
from collections.abc import Iterable
from dataclasses import dataclass

from gripper_force.config import ControlConfig
from gripper_force.control.approach import Approach, ApproachState
from gripper_force.control.force_loop import ForceLoop, tolerance_n
from gripper_force.control.friction_allowance import FrictionAllowance
from gripper_force.control.fusion import Fusion
from gripper_force.control.limits import Limits, largest_target_n
from gripper_force.control.safety import SafetyLatch, is_plausible
from gripper_force.control.slip import SlipMonitor
from gripper_force.control.speed_limit import PositionLoop, SpeedLimit, hold_speed_m_s
from gripper_force.control.transmission import GOAL_OFFSET_M, Transmission
from gripper_force.control.travel import Travel
from gripper_force.control.visual_check import VisualCheck
from gripper_force.types import (
    GRIPPING,
    NS_PER_S,
    EstimateSource,
    Event,
    FusedForce,
    GraspStatus,
    Outcome,
    Phase,
    Request,
    RequestKind,
    ServoCommand,
    ServoState,
    VisualForce,
)

MAX_CYCLE_S = 0.05
"""Longest cycle time that is used, so that a late cycle does not cause a jump of the command."""

_TRAVEL_SPEED_SHARE = 2.0
"""Speed of a release or move, as a share of the approach speed."""

_RISING_SHARE = 0.97
"""Largest speed while the force rises, as a share of the approach speed. Jaws that start from rest as their object
leaves go beyond the speed of their voltage for one cycle. Slower jaws on a soft object look like a loss."""

_DWELL_S = 0.12
"""Time in contact before the ramp: the impact decays and vision catches up."""

_SETTLE_FILTER_S = 0.25
"""Time constant of the filter on the force error that decides on `held`: vision alone is noisy."""

_OPEN_M = 0.003
"""Distance from the open width at which the jaws count as open."""

_START_SPARE_M = 0.004
"""Distance outside the travel at which a run may start: the error of the configured open position."""

_OPENING_SPARE_S = 4.0
"""Time for an opening beyond that of its distance: larger friction makes the jaws late."""

_AT_WIDTH_M = 0.0005
"""Distance from the requested width at which a move has arrived, unless the servo's proportional gain leaves more."""

_MIN_SPEED_M_S = 1e-4
"""Lowest speed of one jaw that gives a grasp more time: that for a target of 0.01 N."""

_BLOCKED_S = 1.0
_PROGRESS_M = 0.002
_PROGRESS_SHARE = 0.25
"""A move is blocked if the width does not change by this distance in this time; slow jaws: by this share of what their
speed allows."""

_REFUSED = "refused "
"""Beginning of the event of a refused request."""

_SAME_SHARE = 0.25
"""A target that changes by at most this share of its tolerance is the same target: streams of requests are noisy."""


@dataclass(frozen=True, slots=True)
class Decision:
    """Result of one control cycle.

    Attributes:
        command: The limited command for the servo.
        status: State of the grasp.
        estimate: The force estimate.
        events: Sentences for the log.
        refusal: Reason why this cycle's request was refused; empty otherwise.
    """

    command: ServoCommand
    status: GraspStatus
    estimate: FusedForce
    events: tuple[Event, ...]
    refusal: str = ""


class GraspController:
    """Deterministic state machine of the grasp: the same inputs give bit-for-bit the same decisions.

    ``open -> approach -> contact -> ramp -> hold -> release -> open``, with ``move`` and ``fault`` from any
    phase. A request pre-empts the present phase: a grasp while gripping ramps to the new target without
    letting go.

    *A move* positions the jaws at a width with the motor force of a release. It also lets go of an object.

    *Fault* is latched. A stop request or a trip of `SafetyLatch` leads to it. The jaws then go limp, hold their
    position with a current that can only fall, or open, as ``on_fault`` says. Only a release request ends it,
    and only once the cause is gone.

    *A hot servo* holds less force, and an event reports it.

    *The outcome* stays until the next grasp or move. After ``held`` it may become ``slip``, and after a release that
    does not open the jaws ``blocked``. The controller opens the jaws without a request after ``no_object`` and
    ``stuck``. When the object has left the jaws, it does what ``on_slip`` says. After another ``slip``, and after
    ``timeout``, it continues.

    *Speed.* Every command passes `SpeedLimit`, so the jaws are never much faster than the phase allows. Jaws on their
    way to an object are so slow that their impact stays within the force limit.

    Attributes:
        opening_s: Longest time in which the jaws open.
    """

    def __init__(
        self,
        config: ControlConfig,
        transmission: Transmission,
        current_limit_a: float,
        position_loop: PositionLoop | None = None,
    ) -> None:
        full_m_s = config.approach_speed_m_s
        impact_m_s = transmission.impact_m_s(config.force_limit_n)
        approach_m_s = min(full_m_s, impact_m_s)
        free_motor_force_n = config.approach_force_n + transmission.friction_n
        self._travel = Travel(
            min(_TRAVEL_SPEED_SHARE * full_m_s, impact_m_s), free_motor_force_n, transmission.open_width_m
        )
        self.opening_s = _OPENING_SPARE_S + transmission.open_width_m / self._travel.speed_m_s
        self._config = config
        self._transmission = transmission
        self._fusion = Fusion(config, transmission)
        self._loop = ForceLoop(config, transmission)
        self._limits = Limits(config, transmission, current_limit_a)
        self._speed_limit = SpeedLimit(transmission, position_loop)
        self._friction = FrictionAllowance(config, transmission)
        self._safety = SafetyLatch(config)
        self._approach = Approach(config, transmission, approach_m_s)
        self._hold_m_s = hold_speed_m_s(config, transmission)
        self._slip = SlipMonitor(config, self._hold_m_s)
        self._visual_check = VisualCheck(config)
        self._largest_target_n = largest_target_n(config.force_limit_n, transmission.force_bound)
        self._phase, self._outcome, self._reason = Phase.OPEN, Outcome.NONE, ""
        self._estimate = FusedForce(
            0, 0.0, transmission.bias_std_n(0.0), 0.0, 0.0, transmission.friction_n, EstimateSource.CURRENT
        )
        self._t_ns: int | None = None
        self._width_m: float | None = None
        self._goal_width_m = transmission.open_width_m
        self._motor_force_n = free_motor_force_n
        self._servo: ServoState | None = None
        self._target_n = self._held_width_m = self._settling_width_m = 0.0
        self._move_width_m = transmission.open_width_m
        self._progress_width_m = self._stopped_s = 0.0
        self._move_opens = False
        self._released_s = math.inf
        self._grasp_ns, self._timeout_s = 0, 0.0
        self._phase_s = self._settled_s = self._error_n = 0.0
        self._was_over_force = self._was_held = False
        self._goal_current_a = self._measured_motor_force_n = 0.0
        self._derating = 1.0

    def end_grasps(self) -> tuple[float, float] | None:
        """Ends the last grasp, and returns the ratio of all grasps (see `ObjectGain.ratio`); None without any."""
        is_held = self._phase in GRIPPING and self._outcome == Outcome.HELD
        return self._fusion.end_grasp(was_held=self._was_held or is_held)

    def start_problem(self, servo: ServoState) -> str:
        """Returns why the jaws cannot start at a position, or an empty text.

        Outside their travel, the first command would move them without a request.
        """
        width_m, open_width_m = (
            self._transmission.width_m(servo.position_rad),
            self._transmission.open_width_m,
        )
        if not is_plausible(servo) or -_START_SPARE_M <= width_m <= open_width_m + _START_SPARE_M:
            return ""
        return (
            f"the servo starts at {servo.position_rad:.3f} rad, where the jaws would be {1e3 * width_m:.1f} mm "
            f"apart, outside their travel of 0 to {1e3 * open_width_m:g} mm; nothing has moved. Check the "
            "horn, gripper.open_position_rad, closing_sign and open_width_m, and servo.homing_offset; a servo "
            "that is off by a turn needs a power cycle"
        )

    def step(
        self, t_ns: int, servo: ServoState, visual: VisualForce | None, request: Request | None
    ) -> Decision:
        """Runs one control cycle.

        Args:
            t_ns: Present time.
            servo: This cycle's reading.
            visual: Newest visual estimate, or None. A repeated one is used once.
            request: New request in this cycle, or None.

        Returns:
            The limited command, the state of the grasp, the force estimate, and events.
        """
        dt_s = self._elapsed_s(t_ns)
        self._reason = ""
        has_tripped = self._safety.check(servo, self._goal_current_a, dt_s, over_force=self._was_over_force)
        events = self._read_sensors(t_ns, servo, visual)
        if has_tripped:
            self._enter_fault()
        refusal = "" if request is None else self._handle_request(t_ns, request)
        if request is not None and refusal:
            events.append(Event(t_ns, "control", f"{_REFUSED}{str(request.kind)!r}: {refusal}"))
        if self._width_m is not None:
            closing_m_s = self._transmission.fastest_closing_m_s(servo.velocity_rad_s, self._present_rad)
            self._run_phase(t_ns, dt_s, self._width_m, closing_m_s)
        command, is_over = self._limit_command(t_ns, dt_s)
        self._goal_current_a = command.goal_current_a
        if is_over and not self._was_over_force:
            text = f"{self._estimate.force_n:.2f} N is over the limit; goal current lowered"
            events.append(Event(t_ns, "control", text))
        self._was_over_force = is_over
        return Decision(command, self._status(t_ns), self._estimate, tuple(events), refusal)

    # Inputs.

    def _elapsed_s(self, t_ns: int) -> float:
        previous_ns = t_ns if self._t_ns is None else self._t_ns
        self._t_ns = t_ns
        return min(max(t_ns - previous_ns, 0) / NS_PER_S, MAX_CYCLE_S)

    def _read_sensors(self, t_ns: int, servo: ServoState, visual: VisualForce | None) -> list[Event]:
        if not is_plausible(servo):
            self._estimate = dataclasses.replace(self._estimate, t_ns=t_ns)
            return []
        width_m = self._transmission.width_m(servo.position_rad)
        if self._width_m is None:  # nothing moves before the first request
            self._goal_width_m = width_m
        self._width_m, self._servo = width_m, servo
        self._measured_motor_force_n = self._transmission.force_n(servo.current_a, servo.position_rad)
        closing_m_s = self._transmission.fastest_closing_m_s(servo.velocity_rad_s, servo.position_rad)
        is_free = self._phase == Phase.APPROACH and self._approach.moves_freely(
            closing_m_s, self._measured_motor_force_n
        )
        self._estimate, fusion_events = self._fusion.step(
            t_ns,
            servo,
            visual if visual is not None and visual.is_familiar else None,
            free=is_free,
            gripping=self._phase in GRIPPING,
            holding=self._phase == Phase.HOLD,
            opening=self._is_opening,
            lowering=self._phase in (Phase.RAMP, Phase.HOLD) and self._loop.is_lowering,
        )
        self._visual_check.add(t_ns, visual, gripping=self._phase in GRIPPING)
        return [*fusion_events, *self._derate(t_ns, servo.temperature_c)]

    def _derate(self, t_ns: int, temperature_c: float) -> list[Event]:
        """Lowers the target force of a hot servo, before the servo shuts down."""
        previous, self._derating = self._derating, self._safety.derating(temperature_c)
        if self._derating == previous or self._phase not in (Phase.RAMP, Phase.HOLD):
            return []
        self._loop.retarget(self._derated_target_n)
        text = f"the servo is at {temperature_c:.0f} C; holding {self._derated_target_n:.2f} N"
        return [Event(t_ns, "control", text)]

    def _handle_request(self, t_ns: int, request: Request) -> str:
        """Handles a request. Returns the reason of a refusal, or an empty text."""
        if request.kind == RequestKind.STOP:
            if self._safety.trip("stop requested"):
                self._enter_fault()
        elif self._phase == Phase.FAULT and request.kind != RequestKind.RELEASE:
            return "stopped or in fault; request a release first"
        elif request.kind == RequestKind.RELEASE:
            if cause := self._safety.reset():
                if not self._opens_at_fault:
                    self._motor_force_n = 0.0  # what can't be reset is let go, also with on_fault=hold
                return cause
            if self._phase == Phase.RELEASE and self._outcome != Outcome.BLOCKED:
                return ""  # a new start would not brake jaws that a springy object pushes open
            if self._outcome == Outcome.BLOCKED:
                self._outcome = Outcome.NONE
            self._start_release("release requested")
        elif request.kind == RequestKind.MOVE:
            open_width_m = self._transmission.open_width_m
            if not 0 <= request.width_m <= open_width_m:
                return f"the width {1e3 * request.width_m:g} mm is outside 0 to {1e3 * open_width_m:g} mm"
            self._start_move(request.width_m)
        elif request.kind != RequestKind.GRASP:
            return "unknown kind of request; use grasp, release, move or stop"
        elif not 0 < request.target_n <= self._largest_target_n:
            return f"the target {request.target_n} N is outside 0 to {self._largest_target_n:g} N"
        else:
            if request.new_object and self._phase in GRIPPING:
                return "an object is held; request a release before the grasp of a new one"
            self._start_grasp(t_ns, request.target_n, new_object=request.new_object)
        return ""

    # Phase changes.

    def _enter(self, phase: Phase, reason: str) -> None:
        is_open_now = is_open(self._transmission.open_width_m, self._present_width_m)
        self._friction.start_phase(from_open=is_open_now and self._phase not in GRIPPING)
        self._phase, self._reason = phase, reason
        self._phase_s = self._settled_s = 0.0

    def _set_outcome(self, outcome: Outcome, reason: str) -> None:
        self._outcome, self._reason = outcome, reason

    def _start_grasp(self, t_ns: int, target_n: float, *, new_object: bool) -> None:
        is_same = abs(target_n - self._target_n) <= _SAME_SHARE * tolerance_n(target_n) and not new_object
        if is_same and self._is_grasping and self._outcome in (Outcome.NONE, Outcome.HELD):
            return
        self._grasp_ns, self._target_n, self._outcome = t_ns, target_n, Outcome.NONE
        is_gripping = self._phase in (Phase.RAMP, Phase.HOLD)
        self._timeout_s = self._config.timeout_s if is_gripping else self.timeout_s(target_n)
        if self._phase == Phase.CONTACT:
            return
        if is_gripping:
            self._loop.retarget(self._derated_target_n)
            self._enter(Phase.RAMP, f"new target {target_n:g} N")
            return
        if self._phase == Phase.APPROACH and not new_object:
            # The approach keeps what it knows of friction and standstill.
            self._approach.set_target(target_n)
            self._reason = f"new target {target_n:g} N"
            return
        self._released_s = self._phase_s if self._is_travelling else math.inf
        self._friction.start_grasp()
        self._fusion.restart(was_held=self._was_held, new_object=new_object)
        self._was_held = False
        self._limits.reset(reverses=self._opens_freely)
        self._approach.start(self._present_width_m, target_n)
        self._enter(Phase.APPROACH, f"grasp with {target_n:g} N requested")

    def _start_release(self, reason: str) -> None:
        self._start_travel(opens=True)
        self._enter(Phase.RELEASE, reason)

    def _start_move(self, width_m: float) -> None:
        opens = width_m > self._present_width_m
        is_moving = self._phase == Phase.MOVE and self._outcome in (Outcome.NONE, Outcome.MOVED)
        if is_moving and abs(width_m - self._move_width_m) <= _SAME_SHARE * _AT_WIDTH_M:
            return
        self._reason = f"move to {1e3 * width_m:.1f} mm requested"
        if not (is_moving and opens == self._move_opens):  # a move in the same direction keeps its speed
            self._start_travel(opens=opens)
            self._move_opens = opens
            self._enter(Phase.MOVE, self._reason)
            self._progress_width_m, self._stopped_s = self._present_width_m, 0.0
        self._outcome, self._move_width_m = Outcome.NONE, width_m

    def _start_travel(self, *, opens: bool) -> None:
        if self._phase in GRIPPING:
            self._was_held = self._outcome == Outcome.HELD
        grip_n = self._motor_force_n if self._phase in (*GRIPPING, Phase.FAULT) else self._remaining_grip_n
        self._limits.reset(reverses=self._opens_freely and not opens)
        self._goal_width_m = self._present_width_m  # in the cycle that loses an object, the jaws still close
        self._travel.start(self._goal_width_m, grip_n, opens=opens)

    def _enter_fault(self) -> None:
        reason = self._safety.reason
        if self._config.on_fault == "open":
            self._start_release(reason)
        elif self._phase not in GRIPPING:
            self._goal_width_m = self._present_width_m
        if self._config.on_fault == "limp":
            self._motor_force_n = 0.0
        self._enter(Phase.FAULT, reason)
        self._set_outcome(Outcome.FAULT, reason)

    @property
    def _opens_at_fault(self) -> bool:
        return self._phase == Phase.FAULT and self._config.on_fault == "open"

    @property
    def _is_opening(self) -> bool:
        return (
            self._phase == Phase.RELEASE
            or (self._phase == Phase.MOVE and self._move_opens)
            or (self._phase == Phase.APPROACH and self._approach.is_backing_off)
            or self._opens_at_fault
        )

    @property
    def _opens_freely(self) -> bool:
        """True if the jaws open, and have let go of what they held."""
        return self._is_opening and self._travel.remaining_grip_n(self._phase_s) == 0

    @property
    def _remaining_grip_n(self) -> float:
        """Motor force of a grip that a release, a move, or an approach after one has not let go yet."""
        if self._phase == Phase.APPROACH:
            return self._travel.remaining_grip_n(self._released_s + self._phase_s)
        return self._travel.remaining_grip_n(self._phase_s) if self._is_travelling else 0.0

    @property
    def _is_travelling(self) -> bool:
        return self._is_opening or self._phase == Phase.MOVE

    @property
    def _is_closing(self) -> bool:
        return self._phase in (Phase.APPROACH, Phase.MOVE) and not self._is_opening

    @property
    def _is_grasping(self) -> bool:
        return self._phase in (Phase.APPROACH, *GRIPPING)

    @property
    def _speed_m_s(self) -> float:
        """Largest speed of one jaw in the present phase."""
        if self._is_opening or self._phase in (Phase.MOVE, Phase.OPEN):
            return self._travel.speed_m_s
        if self._phase == Phase.APPROACH:
            return self._approach.speed_m_s
        is_rising = self._phase in (Phase.CONTACT, Phase.RAMP)
        return _RISING_SHARE * self._config.approach_speed_m_s if is_rising else self._hold_m_s

    @property
    def _derated_target_n(self) -> float:
        return self._target_n * self._derating

    @property
    def _objection(self) -> str:
        """Observation of the camera that speaks against a grip; empty without one."""
        current_n = self._motor_force_n - self._estimate.friction_n
        is_held = self._outcome == Outcome.HELD
        return self._visual_check.objection(self._derated_target_n, current_n, is_held=is_held)

    @property
    def _tolerance_n(self) -> float:
        """Largest force error at which the target counts as held: at least one step of an uncorrected current."""
        band_n = tolerance_n(self._derated_target_n)
        if self._estimate.source != EstimateSource.CURRENT:
            return band_n
        step_n = self._transmission.force_n(self._transmission.current_step_a, self._present_rad)
        return max(band_n, abs(step_n))

    @property
    def _present_width_m(self) -> float:
        return self._goal_width_m if self._width_m is None else self._width_m

    @property
    def _present_rad(self) -> float:
        """Servo angle of the last plausible reading."""
        return self._transmission.open_position_rad if self._servo is None else self._servo.position_rad

    # Phases.

    def _run_phase(self, t_ns: int, dt_s: float, width_m: float, closing_m_s: float) -> None:
        self._phase_s += dt_s
        self._friction.update(dt_s, closing_m_s, self._speed_m_s, closing=self._is_closing)
        match self._phase:
            case Phase.APPROACH:
                self._run_approach(dt_s, width_m, closing_m_s)
            case Phase.CONTACT if self._phase_s >= _DWELL_S:
                self._loop.start(self._estimate.force_n, self._derated_target_n)
                self._slip.start()
                self._visual_check.settle(self._estimate.friction_n)
                self._enter(Phase.RAMP, "contact has settled")
            case Phase.RAMP:
                self._run_ramp(dt_s, width_m, closing_m_s)
            case Phase.HOLD:
                self._run_hold(dt_s, width_m, closing_m_s)
            case Phase.RELEASE:
                self._run_release(dt_s, width_m, closing_m_s)
            case Phase.MOVE:
                self._run_move(dt_s, width_m)
            case Phase.FAULT if self._opens_at_fault:
                self._run_release(dt_s, width_m, closing_m_s)
        if self._phase in GRIPPING:
            self._goal_width_m = width_m - 2 * GOAL_OFFSET_M
        if self._is_grasping and self._outcome == Outcome.NONE:
            self._check_timeout(t_ns)
        self._note_friction(closing_m_s)

    def _note_friction(self, closing_m_s: float) -> None:
        """Learns the friction that this motion shows."""
        if self._is_travelling:
            self._travel.note_friction(
                self._phase_s, closing_m_s, self._measured_motor_force_n, opens=self._is_opening
            )
            shown_n = self._travel.free_travel.friction_n
        else:
            shown_n = self._fusion.current.free_travel.friction_n if self._phase == Phase.APPROACH else None
        self._friction.learn(shown_n, only_lower=self._phase == Phase.MOVE and not self._is_opening)

    def _run_approach(self, dt_s: float, width_m: float, closing_m_s: float) -> None:
        # The goal position leads far enough that the goal current alone drives the jaws. A goal that moved in
        # steps with the jaws would cause a current ripple, and the current is sampled at one phase of it.
        self._goal_width_m = width_m - 2 * GOAL_OFFSET_M
        was_backing_off = self._approach.is_backing_off
        state = self._approach.step(
            dt_s,
            width_m,
            closing_m_s,
            self._measured_motor_force_n,
            self._estimate,
            self._friction.max_closing_force_n(closing=self._is_closing, approaching=True),
        )
        # With less motor force at once, an object that a release has not let go yet would push the jaws open.
        self._motor_force_n = max(self._approach.motor_force_n, self._remaining_grip_n)
        mean_n = self._travel.free_travel.mean_n
        if was_backing_off and not self._approach.is_backing_off and mean_n is not None:
            self._fusion.current.take_friction(mean_n)
        match state:
            case ApproachState.BACKING_OFF:
                if not was_backing_off:
                    self._travel.start(width_m, 0.0, opens=True)
                self._goal_width_m = min(self._approach.back_off_width_m, self._transmission.open_width_m)
            case ApproachState.CONTACT:
                self._visual_check.start()
                self._fusion.reset_variance()
                self._enter(Phase.CONTACT, f"contact at {width_m * 1e3:.1f} mm")
            case ApproachState.CLOSED:
                self._end_approach(Outcome.NO_OBJECT, "closed without contact")
            case ApproachState.STUCK:
                self._friction.end_stuck()
                self._end_approach(
                    Outcome.STUCK,
                    f"the jaws do not move at {width_m * 1e3:.1f} mm; check for an obstacle, and that "
                    "gripper.friction_n is not too small",
                )

    def _end_approach(self, outcome: Outcome, reason: str) -> None:
        self._set_outcome(Outcome.SLIP if self._outcome == Outcome.SLIP else outcome, reason)
        self._start_release(reason)

    def _step_loop(self, dt_s: float, width_m: float, closing_m_s: float) -> str:
        """Sets the motor force of a grip. Returns why there is no object between the jaws, or an empty text."""
        shortfall_n = self._motor_force_n - self._measured_motor_force_n
        self._motor_force_n = self._loop.step(
            dt_s, self._derated_target_n, self._estimate, shortfall_n=shortfall_n, closing_m_s=closing_m_s
        )
        return self._slip.loss_reason(dt_s, width_m, closing_m_s, shortfall_n, self._loop.reference_n)

    def _run_ramp(self, dt_s: float, width_m: float, closing_m_s: float) -> None:
        loss = self._step_loop(dt_s, width_m, closing_m_s)
        if width_m < self._config.min_object_width_m and self._outcome == Outcome.NONE:
            self._set_outcome(Outcome.NO_OBJECT, "closed while the force was to rise")
            self._start_release(self._reason)
        elif loss:
            self._handle_loss(width_m, loss)
        elif self._loop.reference_n == self._derated_target_n and not self._loop.is_lowering:
            self._error_n = self._estimate.force_n - self._derated_target_n
            self._enter(Phase.HOLD, f"at {self._derated_target_n:g} N")

    def _run_hold(self, dt_s: float, width_m: float, closing_m_s: float) -> None:
        loss = self._step_loop(dt_s, width_m, closing_m_s)
        error_n = self._estimate.force_n - self._derated_target_n
        self._error_n += (error_n - self._error_n) * dt_s / (dt_s + _SETTLE_FILTER_S)
        is_near = abs(self._error_n) <= self._tolerance_n
        if self._settled_s == 0.0:
            self._settling_width_m = width_m
        # Jaws that break away from friction close freely against viscous friction, which looks like a steady grip.
        is_still = self._settling_width_m - width_m <= self._config.slip_width_m
        is_settled = is_near and is_still and not self._objection
        self._settled_s = self._settled_s + dt_s if is_settled else 0.0
        if self._outcome == Outcome.NONE and self._settled_s >= self._config.settle_s:
            self._held_width_m = width_m
            reason = f"{self._estimate.force_n:.2f} N for {self._settled_s:.2f} s"
            if self._derating < 1:
                reason += f", reduced from {self._target_n:g} N because the servo is hot"
            self._set_outcome(Outcome.HELD, reason)
        if not loss and self._outcome == Outcome.HELD:
            loss = self._slip.recession_reason(width_m, self._held_width_m, closing_m_s, self._motor_force_n)
        if loss:
            self._handle_loss(width_m, loss)
            return
        closed_m = self._held_width_m - width_m if self._outcome == Outcome.HELD else 0.0
        slip = self._slip.slip_reason(
            dt_s, self._estimate.force_n, self._derated_target_n, closed_m, closing_m_s
        )
        if not slip and self._outcome == Outcome.HELD and (objection := self._objection):
            slip = f"{objection}; friction or an end stop may hold the jaws"
        if slip and self._outcome in (Outcome.NONE, Outcome.HELD):
            self._set_outcome(Outcome.SLIP, slip)

    def _handle_loss(self, width_m: float, reason: str) -> None:
        """Regrips, holds the width or opens, as ``on_slip`` says, once the object has left the jaws."""
        if self._outcome in (Outcome.NONE, Outcome.HELD):
            self._set_outcome(Outcome.SLIP, reason)
        match self._config.on_slip:
            case "hold":
                self._start_travel(opens=False)
                self._move_width_m, self._move_opens = width_m, False
                self._enter(Phase.MOVE, reason)
            case "regrip" if width_m >= self._config.min_object_width_m:
                self._released_s = math.inf
                self._approach.start(width_m, self._target_n)
                self._enter(Phase.APPROACH, reason)
            case _:
                self._start_release(reason)

    def _run_release(self, dt_s: float, width_m: float, closing_m_s: float) -> None:
        self._travel.open(dt_s, self._phase_s, width_m, closing_m_s)
        self._motor_force_n, self._goal_width_m = self._travel.motor_force_n, self._travel.goal_width_m
        open_width_m = self._transmission.open_width_m
        if is_open(open_width_m, width_m):
            self._goal_width_m = open_width_m
            if self._phase == Phase.RELEASE:
                self._enter(Phase.OPEN, "open")
        elif self._phase_s - dt_s < self.opening_s <= self._phase_s:
            if self._phase == Phase.RELEASE:
                self._outcome = Outcome.BLOCKED
            self._reason = (
                f"the jaws are {1e3 * width_m:.1f} mm apart and have not opened within {self.opening_s:.1f} s; check "
                "for an obstacle, that gripper.friction_n is not too small, and that control.force_limit_n is not"
            )

    def _run_move(self, dt_s: float, width_m: float) -> None:
        self._travel.move(dt_s, self._phase_s, width_m, self._move_width_m)
        self._motor_force_n, self._goal_width_m = self._travel.motor_force_n, self._travel.goal_width_m
        if self._outcome != Outcome.NONE:
            return
        remaining_m = abs(width_m - self._move_width_m)
        friction_a = self._transmission.current_a(self._transmission.friction_n, self._present_rad)
        tolerance_m = max(_AT_WIDTH_M, self._speed_limit.rest_error_m(friction_a, self._present_rad))
        if abs(width_m - self._progress_width_m) > min(
            _PROGRESS_M, _PROGRESS_SHARE * self._travel.speed_m_s * _BLOCKED_S
        ):
            self._progress_width_m, self._stopped_s = width_m, 0.0
        self._stopped_s += dt_s
        if remaining_m <= tolerance_m and self._goal_width_m == self._move_width_m:
            self._stopped_s = 0.0
            self._set_outcome(Outcome.MOVED, f"moved to {self._move_width_m * 1e3:.1f} mm")
        elif self._stopped_s >= _BLOCKED_S:
            reason = f"stopped at {width_m * 1e3:.1f} mm by an obstacle, or by friction: "
            is_unknown = self._friction.shown_n == math.inf
            reason += "request a release first, which shows it" if is_unknown else "check gripper.friction_n"
            self._set_outcome(Outcome.BLOCKED, reason)

    def timeout_s(self, target_n: float) -> float:
        """Returns the time after which a grasp has timed out: as configured, and what slower jaws need.

        Args:
            target_n: Target force. Jaws are slower for a small one, and for a small force limit.
        """
        speed_m_s = max(self._approach.speed_for_m_s(target_n), _MIN_SPEED_M_S)
        slower_s_m = 1 / speed_m_s - 1 / self._config.approach_speed_m_s
        return self._config.timeout_s + self._transmission.open_width_m / 2 * slower_s_m

    def _check_timeout(self, t_ns: int) -> None:
        if t_ns - self._grasp_ns > self._timeout_s * NS_PER_S:
            reason = f"not held within {self._timeout_s:.3g} s"
            if objection := self._objection:
                reason += (
                    f": {objection}. Check whether there is an object, in full view. "
                    "The jaws may press on an end stop: check gripper.open_width_m with `calibrate jaws`. "
                    "If there is an object, calibrate it, or set control.feedback=current"
                )
            elif self._limits.is_at_current_limit:
                reason += (
                    ": the motor current is at its limit; request less force, or check servo.current_limit_a"
                )
            self._set_outcome(Outcome.TIMEOUT, reason)

    # Outputs.

    def _limit_command(self, t_ns: int, dt_s: float) -> tuple[ServoCommand, bool]:
        may_rise = self._phase != Phase.FAULT or self._opens_at_fault
        force_n, motor_force_n = self._estimate.force_n, self._motor_force_n
        closing = self._is_closing
        friction_n = self._friction.allowance_n(
            self._estimate.friction_n,
            opening=self._is_opening,
            closing=closing,
            gripping=self._phase in GRIPPING,
        )
        if closing or self._phase == Phase.CONTACT:
            limit_n = self._friction.max_closing_force_n(
                closing=closing, approaching=self._phase == Phase.APPROACH
            )
            motor_force_n = min(motor_force_n, limit_n)
        unlimited = ServoCommand(
            t_ns,
            self._transmission.position_rad(self._goal_width_m),
            abs(self._transmission.current_a(motor_force_n, self._present_rad)),
        )
        command, is_over = self._limits.apply(
            unlimited,
            force_n,
            friction_n,
            self._measured_motor_force_n,
            self._present_rad,
            dt_s,
            may_rise=may_rise,
            opening=self._is_opening,
            rises_slowly=self._phase in GRIPPING and not self._friction.was_shown_in_grasp,
        )
        if self._servo is not None:
            command = self._speed_limit.apply(command, self._servo, self._speed_m_s)
        return command, is_over

    def _status(self, t_ns: int) -> GraspStatus:
        return GraspStatus(
            t_ns=t_ns,
            phase=self._phase,
            outcome=self._outcome,
            reference_n=self._loop.reference_n if self._phase in (Phase.RAMP, Phase.HOLD) else 0.0,
            width_m=self._present_width_m,
            reason=self._reason,
        )


def refused_ns(events: Iterable[Event]) -> set[int]:
    """Returns the times of the requests that a controller has refused, from its events."""
    return {event.t_ns for event in events if event.unit == "control" and event.text.startswith(_REFUSED)}


def is_open(open_width_m: float, width_m: float) -> bool:
    """Returns True if jaws at ``width_m`` count as open."""
    return width_m > open_width_m - _OPEN_M
