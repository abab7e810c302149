"""A trapezoidal speed profile: how the force reference and the jaws' goal move."""

import math


class TrapezoidalProfile:
    """Moves a value to a target with bounded speed and acceleration, and arrives without overshoot.

    Jaws, rack and object are a mass on a spring: a step in the speed of what they follow makes them ring.

    Attributes:
        value: Where the profile is.
    """

    def __init__(self, ramp_s: float) -> None:
        """``ramp_s`` is the time from rest to full speed."""
        self._ramp_s = ramp_s
        self.start(0.0, 1.0)

    def start(self, value: float, rate: float) -> None:
        """Begins at rest at ``value``; ``rate`` is the full speed, a second."""
        self.value = value
        self._rate = rate
        self._speed = 0.0

    def step(self, target: float, dt_s: float) -> float:
        """Moves for ``dt_s`` towards ``target`` and gives the new value."""
        remaining = abs(target - self.value)
        acceleration = self._rate / self._ramp_s
        braking = math.sqrt(2 * acceleration * remaining)
        self._speed = min(self._speed + acceleration * dt_s, self._rate, braking)
        stride = self._speed * dt_s
        self.value = (
            target if stride >= remaining else self.value + math.copysign(stride, target - self.value)
        )
        return self.value
