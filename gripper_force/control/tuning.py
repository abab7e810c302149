"""Gains from an identified plant by a published rule, and the phase margin they leave.

The rule is SIMC: S. Skogestad, "Simple analytic rules for model reduction and PID controller tuning", Journal
of Process Control 13 (2003) 291-309, doi:10.1016/S0959-1524(02)00062-8, equations 23 and 24.
"""

import cmath
import math
from dataclasses import dataclass

from scipy.optimize import brentq


@dataclass(frozen=True, slots=True)
class Plant:
    """First order plus delay: ``gain * exp(-delay_s * s) / (lag_s * s + 1)``."""

    gain: float
    lag_s: float
    delay_s: float

    def response(self, omega: float) -> complex:
        """Frequency response at ``omega`` in rad/s."""
        s = 1j * omega
        return self.gain * cmath.exp(-self.delay_s * s) / (self.lag_s * s + 1)


@dataclass(frozen=True, slots=True)
class Gains:
    """A PI controller: ``proportional + integral_s / s``."""

    proportional: float
    integral_s: float

    def response(self, omega: float) -> complex:
        """Frequency response at ``omega`` in rad/s."""
        return self.proportional + self.integral_s / (1j * omega)


def simc(plant: Plant) -> Gains:
    """SIMC gains with the rule's own choice of closed-loop time constant, the delay itself.

    A plant without lag gets the pure integral controller that is the rule's limit.
    """
    window_s = 2 * plant.delay_s
    proportional = plant.lag_s / (plant.gain * window_s)
    if plant.lag_s <= 4 * window_s:
        return Gains(proportional, 1 / (plant.gain * window_s))
    return Gains(proportional, proportional / (4 * window_s))


def phase_margin_deg(plant: Plant, gains: Gains) -> float:
    """Phase left at the frequency where the open loop's magnitude falls through one."""

    def excess(log_omega: float) -> float:
        omega = math.exp(log_omega)
        return math.log(abs(plant.response(omega) * gains.response(omega)))

    # The integral action makes the magnitude fall from infinity; four decades hold any crossing.
    scale = math.log(1 / plant.delay_s)
    omega = math.exp(float(brentq(excess, scale - 10.0, scale + 10.0)))
    lag_rad = plant.delay_s * omega + math.atan(plant.lag_s * omega)
    lead_rad = cmath.phase(gains.response(omega))
    return math.degrees(math.pi + lead_rad - lag_rad)
