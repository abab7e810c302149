"""From a wanted force to a push of the motor."""

import math
from dataclasses import dataclass

from gripper_force.config import ControlConfig
from gripper_force.control.profile import Profile
from gripper_force.control.transmission import Transmission
from gripper_force.control.tuning import Gains, Plant, phase_margin_deg, simc
from gripper_force.types import FusedForce, Source

_RAMP_S = 0.4
"""Time in which the ramp gathers and loses its speed: longer than a quarter swing of the softest object."""

_DEADBAND = 0.25
"""Share of the tolerance within which a push that is too weak is left alone."""


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

    *Ramp.* The push is the reference, plus friction, less the filter's bias: a disturbance observer. The force
    rises all the way, so the sign of friction is known.
    *Hold.* An integral moves the push, with a deadband. Too much force is left alone up to the tolerance, for the
    jaws are stuck by twice the friction before they open, and a loop that comes and goes through that hunts.
    *Vision alone.* PI control on the delayed estimate instead.

    The push never leaves what friction and gearing make plausible for the reference, whatever is estimated; that
    bounds the integral too.
    """

    def __init__(self, config: ControlConfig, transmission: Transmission) -> None:
        lag_s, delay_s = config.plant_lag_ms * 1e-3, config.plant_delay_ms * 1e-3
        # To an integral alone, the plant's lag is more delay.
        plants = {"hold": Plant(1.0, 0.0, delay_s + lag_s), "vision": Plant(1.0, lag_s, delay_s)}
        self.margins = {
            name: Margin(gains := simc(plant), phase_margin_deg(plant, gains))
            for name, plant in plants.items()
        }
        self._vision_alone = config.feedback == Source.VISION
        self._gains = self.margins["vision" if self._vision_alone else "hold"].gains
        self._transmission = transmission
        self._ramp_n_s = config.ramp_n_s
        self._profile = Profile(_RAMP_S)
        self._push_n = 0.0
        self._rising = True
        self._trim_n = 0.0

    @property
    def reference_n(self) -> float:
        """Where the ramp is."""
        return self._profile.value

    def start(self, force_n: float, target_n: float) -> None:
        """Begins a ramp at the present force."""
        self._profile.start(force_n, self._ramp_n_s)
        self._trim_n = 0.0
        self.retarget(target_n)

    def retarget(self, target_n: float) -> None:
        """Begins a ramp where the last one is."""
        self._profile.start(self.reference_n, self._ramp_n_s)
        self._rising = target_n >= self.reference_n

    def step(self, dt_s: float, target_n: float, estimate: FusedForce) -> float:
        """One cycle. Returns the push at each jaw."""
        ramping = self.reference_n != target_n
        reference_n = self._profile.step(target_n, dt_s)
        error_n = reference_n - estimate.force_n
        friction_n = self._transmission.friction_n
        if not ramping:
            error_n = self._act_on(error_n, tolerance_n(target_n))
        # On the way down friction helps to hold; asking for none of it can't drop the object.
        ahead_n = reference_n + (friction_n if self._rising else 0.0)
        if self._vision_alone:
            self._trim_n += self._gains.integral_s * error_n * dt_s
            push_n = ahead_n + self._gains.proportional * error_n + self._trim_n
        elif ramping:
            push_n = ahead_n - estimate.bias_n
        else:
            push_n = self._push_n + self._gains.integral_s * error_n * dt_s
        room_n = 3 * self._transmission.bias_std_n(reference_n) + friction_n
        self._push_n = min(max(push_n, reference_n - room_n, 0.0), reference_n + room_n)
        return self._push_n

    def _act_on(self, error_n: float, tolerance: float) -> float:
        """What of an error in hold is acted on: to go on is cheap, to turn back means to cross friction."""
        onward_n = error_n if self._rising else -error_n
        if onward_n < -tolerance:
            self._rising = not self._rising
            self._push_n += math.copysign(self._transmission.friction_n, error_n)
            return error_n
        return error_n if onward_n > _DEADBAND * tolerance else 0.0
