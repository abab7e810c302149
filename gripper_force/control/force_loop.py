"""Force loop: from a wanted contact force to a motor force."""

from gripper_force.config import ControlConfig
from gripper_force.control.fusion import observer_lag_s
from gripper_force.control.trajectory import TrapezoidalProfile
from gripper_force.control.transmission import Transmission
from gripper_force.control.tuning import Gains, Plant, simc
from gripper_force.types import EstimateSource, FusedForce

_RAMP_ACCELERATION_S = 0.4
"""Acceleration time of the ramp: longer than a quarter oscillation period of the softest object."""

_MAX_RAMP_PER_S = 10.0
"""Fastest ramp as a share of the force limit per second. With a faster one, moving jaws exceed the force limit."""

_LOWERING_S = 0.15
_RETURN_S = 0.05
"""Lowering: the motor force falls during twice `_LOWERING_S`, half of that time at full rate. Then it returns to the
closing side of friction within `_RETURN_S`, which stops the jaws. A later return would let their inertia carry them
too far."""

_SETTLE_S = 0.2
"""After a lowering, the integral waits for this time: the jaws first close by what the lowering opened them too far,
and the estimate follows late."""

_LOWER_AT_ONCE_S = 0.05
_SEEN_LOWER_AT_ONCE = 1.5
"""A lowering that ends above the tolerance is followed at once by a second one of twice `_LOWER_AT_ONCE_S`. The first
leaves a stiff object with too much force: the motor force returns before its lag lets it reach its lowest value. At a
soft object, inertia opens the jaws further than the motor current shows. So with a camera, which corrects it later, the
second one begins above this multiple of the tolerance only."""

_LOWERING_WAIT_S = 1.0
"""Longest total wait of a lowering, whatever the measured speed is."""

_REPEAT_SHARE = 0.75
_REPEAT_S = 0.5
_REPEAT_WITHIN_S = 1.0
"""In the first `_REPEAT_WITHIN_S` of rest after a lowering, the force is lowered once more if the camera sees it above
the target by `_REPEAT_SHARE` of the tolerance for `_REPEAT_S`. Otherwise the integral would have to overcome twice the
friction, which takes seconds."""

_WAIT_SHARE = 0.2
_WAIT_N = 0.2
"""Ramp and integral wait while the motor force falls short by more than this share of the reference and this force."""

_FORWARD_DEADBAND = 0.25
_REVERSE_DEADBAND = 0.5
"""Deadband of the hold as shares of the tolerance: in the last direction of motion, and against it."""

_REVERSED_FRICTION_SHARE = 0.25
"""Share of the friction in the feedforward after a reversal. Whatever the true friction is, it then holds the
jaws at rest, and the integral adds what is missing. The reversal can't drop the object either."""


def tolerance_n(target_n: float) -> float:
    """Returns the largest force error at which a target counts as held."""
    return max(0.04 * target_n, 0.1)


def loop_gains(config: ControlConfig, *, vision_alone: bool) -> Gains:
    """Returns the gains of a hold with vision alone, or with the motor current too."""
    gain, lag_s, delay_s = config.plant
    # The current follows jaws that move at once. The force of stuck jaws is observed by vision alone,
    # through the filter. For an integral controller the lags are additional delay.
    stuck = Plant(gain, 0.0, delay_s + lag_s + observer_lag_s(config.frame_hz))
    return simc(Plant(gain, lag_s, delay_s) if vision_alone else stuck)


class ForceLoop:
    """Controls the contact force along a ramp to its target and holds it there.

    *Ramp.* The motor force is the reference plus friction minus the filter's bias: a disturbance observer.
    The force rises throughout, so the sign of friction is known. With vision alone the estimate is too late
    to be fed back while the force changes, and the ramp is open-loop with the nominal statics.

    *Hold.* An integral controller (with vision alone: PI) trims the motor force. Its deadband is narrow in
    the last direction of motion and wide against it: stuck jaws must overcome twice the friction before they
    reverse, and a loop that reverses on noise has a limit cycle.

    *Lowering.* Friction holds jaws that are to open. So the motor force falls to the reference less friction,
    which opens them until the contact force is the reference, and then returns to the closing side of
    friction, which stops them there.

    The motor force never leaves the range that friction and gearing make plausible for the reference,
    whatever the estimate is; that limits the integral too.

    Attributes:
        is_lowering: True from a lower target until the jaws are at rest at it.
    """

    def __init__(self, config: ControlConfig, transmission: Transmission) -> None:
        self._vision_alone = config.feedback == "vision"
        self._gains = loop_gains(config, vision_alone=self._vision_alone)
        self._transmission = transmission
        self._ramp_n_s = min(config.ramp_n_s, _MAX_RAMP_PER_S * config.force_limit_n)
        self._max_opening_m_s = config.approach_speed_m_s
        self._profile = TrapezoidalProfile(_RAMP_ACCELERATION_S)
        self._trim_n = 0.0
        self._friction_side = 1.0  # share of friction to overcome: 1 to close, -1 to open
        self._is_reversed = self.is_lowering = self._may_lower_at_once = False
        self._repeat_left_s = self._too_high_s = self._waited_s = self._settle_left_s = 0.0
        self._lowering_start_n = self._highest_reference_n = 0.0

    @property
    def reference_n(self) -> float:
        """Present value of the ramp."""
        return self._profile.value

    def start(self, force_n: float, target_n: float) -> None:
        """Starts a ramp at the present force."""
        self._trim_n = self._repeat_left_s = self._settle_left_s = self._waited_s = 0.0
        self._may_lower_at_once = False
        self._highest_reference_n = self._lowering_start_n = force_n
        self._start_ramp(force_n, target_n)

    def retarget(self, target_n: float) -> None:
        """Starts a ramp at the present reference and keeps the trim.

        A ramp in the same direction keeps its speed: targets that follow each other fast would never leave rest. For a
        target that is lower by less than the tolerance the jaws do not open.
        """
        lowers = target_n < self._highest_reference_n - tolerance_n(target_n)
        self._may_lower_at_once, self._repeat_left_s = lowers, _REPEAT_WITHIN_S if lowers else 0.0
        keeps_direction = self.is_lowering == lowers
        self._waited_s = 0.0
        if not keeps_direction:
            self._lowering_start_n = self.reference_n
        speed_n_s = self._profile.speed if keeps_direction else 0.0
        self._start_ramp(self.reference_n, target_n, lowers=lowers, speed_n_s=speed_n_s)

    def _start_ramp(
        self,
        force_n: float,
        target_n: float,
        fall_s: float = _LOWERING_S,
        *,
        lowers: bool = True,
        speed_n_s: float = 0.0,
    ) -> None:
        self._is_reversed, self.is_lowering = False, lowers and target_n < force_n
        self._friction_side = -1.0 if self.is_lowering else 1.0
        self._profile = TrapezoidalProfile(fall_s if self.is_lowering else _RAMP_ACCELERATION_S)
        rate_n_s = (force_n - target_n) / fall_s if self.is_lowering else self._ramp_n_s
        self._profile.start(force_n, rate_n_s, speed_n_s)

    def step(
        self,
        dt_s: float,
        target_n: float,
        estimate: FusedForce,
        *,
        shortfall_n: float = 0.0,
        closing_m_s: float = 0.0,
    ) -> float:
        """Runs one cycle and returns the motor force at each jaw.

        Args:
            dt_s: Time since the last cycle.
            target_n: Target force.
            estimate: The force estimate.
            shortfall_n: Commanded less measured motor force. Ramp and integral wait while it is large: the
                jaws close on a soft object as fast as they may.
            closing_m_s: Speed of a jaw. A lowering waits while a soft object pushes the jaws open too fast.
        """
        self._repeat_lowering(dt_s, target_n, estimate)
        ramping = self.reference_n != target_n
        if self.is_lowering and not ramping:
            self._friction_side = min(self._friction_side + 2 * dt_s / _RETURN_S, 1.0)
            self.is_lowering = self._friction_side < 1.0
            if not self.is_lowering:
                if not self._vision_alone:  # the bias of a larger force says little about this one
                    self._trim_n = 0.0
                self._lower_at_once(target_n, estimate)
        self._settle_left_s = _SETTLE_S if self.is_lowering else max(self._settle_left_s - dt_s, 0.0)
        if self.is_lowering:
            waits = -closing_m_s > self._max_opening_m_s and self._waited_s < _LOWERING_WAIT_S
            self._waited_s += dt_s * waits
        else:
            waits = shortfall_n > _WAIT_SHARE * self.reference_n + _WAIT_N
        reference_n = self._profile.step(target_n, 0.0 if waits else dt_s)
        self._highest_reference_n = (
            reference_n if self.is_lowering else max(self._highest_reference_n, reference_n)
        )
        error_n = 0.0
        # A constant motor force holds a constant contact force. The current alone carries no new information
        # on friction, so it is not fed back.
        if not (ramping or waits or self._settle_left_s > 0) and estimate.source != EstimateSource.CURRENT:
            error_n = self._beyond_deadband(reference_n - estimate.force_n, tolerance_n(target_n))
            self._trim_n += self._gains.integral_s * error_n * dt_s
        elif ramping and not self._vision_alone:
            self._trim_n = -estimate.bias_n
        friction_n = estimate.friction_n
        side = _REVERSED_FRICTION_SHARE if self._is_reversed else self._friction_side
        feedforward_n = reference_n + side * friction_n
        margin_n = 3 * self._transmission.bias_std_n(reference_n) + friction_n
        low_n, high_n = max(reference_n - margin_n, 0.0), reference_n + margin_n
        self._trim_n = min(max(self._trim_n, low_n - feedforward_n), high_n - feedforward_n)
        motor_force_n = feedforward_n + self._trim_n + self._gains.proportional * error_n
        return min(max(motor_force_n, low_n), high_n)

    def _lower_at_once(self, target_n: float, estimate: FusedForce) -> None:
        """Lowers the force again if it is still too high by motor current; one visual estimate may be an outlier."""
        may_lower = self._may_lower_at_once and estimate.source != EstimateSource.VISION
        self._may_lower_at_once = False
        share = 1.0 if estimate.source == EstimateSource.CURRENT else _SEEN_LOWER_AT_ONCE
        if may_lower and estimate.force_n > target_n + share * tolerance_n(target_n):
            self._start_ramp(min(estimate.force_n, self._lowering_start_n), target_n, _LOWER_AT_ONCE_S)

    def _repeat_lowering(self, dt_s: float, target_n: float, estimate: FusedForce) -> None:
        """Lowers the force again if the camera shows that it has stayed too high."""
        if self.is_lowering or self._repeat_left_s <= 0:
            self._too_high_s = 0.0
            return
        excess_n = 0.0 if estimate.source == EstimateSource.CURRENT else estimate.force_n - target_n
        is_high = excess_n > _REPEAT_SHARE * tolerance_n(target_n)
        self._too_high_s = self._too_high_s + dt_s if is_high else 0.0
        self._repeat_left_s -= dt_s
        if self._too_high_s > _REPEAT_S:
            self._repeat_left_s = 0.0
            self._start_ramp(min(estimate.force_n, self._lowering_start_n), target_n)

    def _beyond_deadband(self, error_n: float, band_n: float) -> float:
        forward_n = -error_n if self._is_reversed else error_n
        if forward_n < -_REVERSE_DEADBAND * band_n:
            self._is_reversed = not self._is_reversed
            return error_n
        return error_n if forward_n > _FORWARD_DEADBAND * band_n else 0.0
