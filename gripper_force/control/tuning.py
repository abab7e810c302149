"""Controller gains of an identified plant by a published rule, and their phase margin.

The rule is SIMC: S. Skogestad, "Simple analytic rules for model reduction and PID controller tuning", Journal
of Process Control 13 (2003) 291-309, doi:10.1016/S0959-1524(02)00062-8, equations 23 and 24.
"""

import cmath
import math
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Plant:
    """First-order plant with delay: ``gain * exp(-delay_s * s) / (lag_s * s + 1)``."""

    gain: float
    lag_s: float
    delay_s: float


@dataclass(frozen=True, slots=True)
class Gains:
    """Gains of a PI controller: ``proportional + integral_s / s``."""

    proportional: float
    integral_s: float

    def response(self, omega: float) -> complex:
        """Returns the frequency response at ``omega`` in rad/s."""
        return self.proportional + self.integral_s / (1j * omega)


def simc(plant: Plant) -> Gains:
    """Returns the SIMC gains with the rule's recommended closed-loop time constant, the delay.

    For a plant without lag they are those of an integral controller, the limit of the rule.
    """
    window_s = 2 * plant.delay_s
    proportional = plant.lag_s / (plant.gain * window_s)
    if plant.lag_s <= 4 * window_s:
        return Gains(proportional, 1 / (plant.gain * window_s))
    return Gains(proportional, proportional / (4 * window_s))


def phase_margin_deg(plant: Plant, gains: Gains) -> float:
    """Returns the phase margin at the frequency where the open loop's magnitude falls below one."""
    # There lag^2 w^4 + (1 - (gain P)^2) w^2 = (gain I)^2. Of the two forms of the root, the one without
    # cancellation is used.
    fall = 1 - (plant.gain * gains.proportional) ** 2
    integral = plant.gain * gains.integral_s
    root = math.hypot(fall, 2 * plant.lag_s * integral)
    omega = math.sqrt(2 * integral**2 / (root + fall) if fall > 0 else (root - fall) / (2 * plant.lag_s**2))
    lag_rad = plant.delay_s * omega + math.atan(plant.lag_s * omega)
    lead_rad = cmath.phase(gains.response(omega))
    return math.degrees(math.pi + lead_rad - lag_rad)
