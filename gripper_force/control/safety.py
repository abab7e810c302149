"""Whether the gripper may go on, and how hard it may still press when it grows hot."""

import math

from gripper_force.config import ControlConfig
from gripper_force.types import NS_PER_S, ServoState

_LEAP_RAD = 0.05
_LEAP_RAD_S = 20.0
"""Most a horn can turn between two readings. The fastest of the servos does 11 rad/s without load."""

_OVER_FORCE_S = 0.25
"""The limits ease within 10 ms what is too much. A force that stays too high for so long does not obey."""

_EXCESS_A = 0.03
_EXCESS_SHARE = 0.15
_EXCESS_S = 0.02
"""A motor that takes more than its goal allows, by so much and for so long, does not obey."""

_EASED = 0.6
"""What is left of the wanted force at the temperature limit: a third of the heat."""


class Safety:
    """A latch: what forbids to go on trips it, and only a reset opens it, once the cause is gone.

    Pure: the same readings give the same verdicts.

    Attributes:
        reason: Why it tripped; empty while it has not.
    """

    def __init__(self, config: ControlConfig) -> None:
        self.reason = ""
        self._config = config
        self._cause = ""
        self._last: ServoState | None = None
        self._over_s = self._excess_s = 0.0

    def check(self, servo: ServoState, goal_current_a: float, dt_s: float, *, over_force: bool) -> bool:
        """Takes a cycle's reading.

        Args:
            servo: What the servo says of itself.
            goal_current_a: What the last cycle allowed it.
            dt_s: Time since the last cycle.
            over_force: The last cycle's force estimate was over its limit.

        Returns:
            Whether the latch has tripped in this cycle.
        """
        self._over_s = self._over_s + dt_s if over_force else 0.0
        excess = abs(servo.current_a) > (1 + _EXCESS_SHARE) * goal_current_a + _EXCESS_A
        self._excess_s = self._excess_s + dt_s if excess else 0.0
        self._cause = self._why_not(servo)
        if is_sound(servo):
            self._last = servo
        return self.trip(self._cause) if self._cause else False

    def trip(self, reason: str) -> bool:
        """Trips the latch, from outside or within. Returns whether it was open; the first reason stays."""
        if self.reason:
            return False
        self.reason = reason
        return True

    def reset(self) -> str:
        """Opens the latch. Returns what forbids it, or an empty text."""
        if not self._cause:
            self.reason = ""
        return self._cause

    def easing(self, temperature_c: float) -> float:
        """The share of the wanted force that a servo this hot is to hold, so that it need not shut down."""
        warm_c, most_c = self._config.warm_c, self._config.temperature_limit_c
        if temperature_c <= warm_c:
            return 1.0
        return max(1.0 - (1.0 - _EASED) * (temperature_c - warm_c) / (most_c - warm_c), _EASED)

    def _why_not(self, servo: ServoState) -> str:
        if not is_sound(servo):
            return "the servo's reading is not finite"
        if servo.hardware_error:
            return f"the servo reports hardware error 0x{servo.hardware_error:02x}"
        if servo.temperature_c > self._config.temperature_limit_c:
            return f"the servo is at {servo.temperature_c:.0f} C"
        low_v, high_v = self._config.voltage_limits_v or (-math.inf, math.inf)
        if not low_v <= servo.voltage_v <= high_v:
            return f"the servo's supply is at {servo.voltage_v:.1f} V, outside {low_v:g} to {high_v:g} V"
        if self._last is not None and self._leaps(self._last, servo):
            return f"the servo's position leapt to {servo.position_rad:.3f} rad"
        if self._excess_s > _EXCESS_S:
            return f"the motor takes {abs(servo.current_a):.3f} A, more than its goal allows"
        if self._over_s > _OVER_FORCE_S:
            return f"the force stayed over its limit for {_OVER_FORCE_S:g} s"
        return ""

    @staticmethod
    def _leaps(before: ServoState, now: ServoState) -> bool:
        time_s = max(now.t_ns - before.t_ns, 0) / NS_PER_S
        return abs(now.position_rad - before.position_rad) > _LEAP_RAD + _LEAP_RAD_S * time_s


def is_sound(servo: ServoState) -> bool:
    """Whether every number of a reading is finite, and small enough to be reckoned with."""
    numbers = (
        servo.position_rad,
        servo.velocity_rad_s,
        servo.current_a,
        servo.temperature_c,
        servo.voltage_v,
    )
    return all(abs(number) <= 1e9 for number in numbers)
