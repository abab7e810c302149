"""Trapezoidal speed profile of the force reference and of the jaws' goal position."""

import math
from typing import Final

ACCELERATION_S: Final = 0.1
"""Time in which the jaws reach full speed."""


class TrapezoidalProfile:
    """Moves a value to a target with limited speed and acceleration, without overshoot.

    Jaws, rack and object are a mass on a spring: a step in the speed of their goal makes them oscillate.

    Attributes:
        value: Present value.
        speed: Present speed per second.
    """

    def __init__(self, ramp_s: float) -> None:
        """Creates a profile; ``ramp_s`` is the time from rest to full speed."""
        self._ramp_s = ramp_s
        self.start(0.0, 1.0)

    def start(self, value: float, rate: float, speed: float = 0.0) -> None:
        """Starts at ``value`` with a speed; ``rate`` is the full speed per second."""
        self.value, self.speed, self._rate = value, speed, rate

    def step(self, target: float, dt_s: float) -> float:
        """Moves towards ``target`` for ``dt_s`` and returns the new value."""
        remaining = abs(target - self.value)
        acceleration = self._rate / self._ramp_s
        braking = math.sqrt(2 * acceleration * remaining)
        self.speed = min(self.speed + acceleration * dt_s, self._rate, braking)
        stride = self.speed * dt_s
        self.value = (
            target if stride >= remaining else self.value + math.copysign(stride, target - self.value)
        )
        return self.value
