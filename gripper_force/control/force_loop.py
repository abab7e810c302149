"""From a wanted force to a push of the motor."""

from dataclasses import dataclass

from gripper_force.config import ControlConfig
from gripper_force.control.fusion import OBSERVER_LAG_S
from gripper_force.control.trajectory import TrapezoidalProfile
from gripper_force.control.transmission import Transmission
from gripper_force.control.tuning import Gains, Plant, phase_margin_deg, simc
from gripper_force.types import EstimateSource, FusedForce

_RAMP_S = 0.4
"""Time in which the ramp gathers and loses its speed: longer than a quarter swing of the softest object."""

_ONWARD = 0.25
_BACKWARD = 0.5
"""Deadband of the hold as shares of the tolerance."""

_TURN = 0.25
"""Share of the friction that is still asked for once the push has turned back: within the play the jaws rest,
whatever the true friction is, and the integral does what is missing. It can't drop the object either."""


def tolerance_n(target_n: float) -> float:
    """How near to its target a force must be to count as held."""
    return max(0.04 * target_n, 0.1)


@dataclass(frozen=True, slots=True)
class Margin:
    """Gains of one loop and the phase they leave."""

    gains: Gains
    phase_margin_deg: float


class ForceLoop:
    """Steers the contact force along a ramp to its target and holds it.

    *Ramp.* The push is the reference, plus friction, less the filter's bias: a disturbance observer. The
    force rises all the way, so the sign of friction is known. With vision alone the estimate comes too late
    to steer by while the force moves, and the ramp runs on the nominal statics.

    *Hold.* An integral (with vision alone: PI) trims the push. It has a deadband that is narrow onward and
    wide backward: stuck jaws must cross twice the friction before they turn, and a loop that does so on noise
    hunts.

    The push never leaves what friction and gearing make plausible for the reference, whatever is estimated;
    that bounds the integral too.
    """

    def __init__(self, config: ControlConfig, transmission: Transmission) -> None:
        gain, lag_s, delay_s = config.plant
        # The current follows jaws that move at once, but of stuck ones vision alone tells, through the
        # filter. To an integral the lags are more delay.
        stuck = Plant(gain, 0.0, delay_s + lag_s + OBSERVER_LAG_S)
        plants = {"hold": stuck, "vision": Plant(gain, lag_s, delay_s)}
        self.margins = {
            name: Margin(gains := simc(plant), phase_margin_deg(plant, gains))
            for name, plant in plants.items()
        }
        self._vision_alone = config.feedback == "vision"
        self._gains = self.margins["vision" if self._vision_alone else "hold"].gains
        self._transmission = transmission
        self._ramp_n_s = config.ramp_n_s
        self._profile = TrapezoidalProfile(_RAMP_S)
        self._trim_n = 0.0
        self._rising = True

    @property
    def reference_n(self) -> float:
        """Where the ramp is."""
        return self._profile.value

    def start(self, force_n: float, target_n: float) -> None:
        """Begins a ramp at the present force."""
        self._profile.start(force_n, self._ramp_n_s)
        self._trim_n = 0.0
        self._rising = target_n >= force_n

    def retarget(self, target_n: float) -> None:
        """Begins a ramp where the last one is, and keeps what was learnt."""
        self._profile.start(self.reference_n, self._ramp_n_s)
        self._rising = target_n >= self.reference_n

    def step(self, dt_s: float, target_n: float, estimate: FusedForce) -> float:
        """One cycle. Returns the push at each jaw."""
        ramping = self.reference_n != target_n
        reference_n = self._profile.step(target_n, dt_s)
        error_n = 0.0
        # A push that rests keeps a force that rests; the current alone has no news of friction to act on.
        if not ramping and estimate.source != EstimateSource.CURRENT:
            error_n = self._beyond_deadband(reference_n - estimate.force_n, tolerance_n(target_n))
            self._trim_n += self._gains.integral_s * error_n * dt_s
        elif ramping and not self._vision_alone:
            self._trim_n = -estimate.bias_n
        friction_n = estimate.friction_n
        ahead_n = reference_n + friction_n * (1.0 if self._rising else _TURN)
        room_n = 3 * self._transmission.bias_std_n(reference_n) + friction_n
        low_n, high_n = max(reference_n - room_n, 0.0), reference_n + room_n
        self._trim_n = min(max(self._trim_n, low_n - ahead_n), high_n - ahead_n)
        motor_force_n = ahead_n + self._trim_n + self._gains.proportional * error_n
        return min(max(motor_force_n, low_n), high_n)

    def _beyond_deadband(self, error_n: float, tolerance: float) -> float:
        onward_n = error_n if self._rising else -error_n
        if onward_n < -_BACKWARD * tolerance:
            self._rising = not self._rising
            return error_n
        return error_n if onward_n > _ONWARD * tolerance else 0.0
