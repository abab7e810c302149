"""Safety checks of each cycle, and the derating of a hot servo."""

import math

from gripper_force.config import ControlConfig
from gripper_force.types import NS_PER_S, ServoState

_JUMP_RAD = 0.05
_JUMP_RAD_S = 20.0
"""Largest plausible rotation of the horn between two readings: an offset plus a speed. The fastest of the
servos does 11 rad/s without load."""

_OVER_FORCE_S = 0.25
"""Time after which a force over its limit is a fault. `Limits` lowers the current within 10 ms."""

_EXCESS_A = 0.03
_EXCESS_SHARE = 0.15
_EXCESS_S = 0.02
"""A motor current above its goal by more than this share and offset, for longer than this, is a fault."""

_BACK_DRIVEN_RAD_S = 0.05
"""Speed against the current above which the horn is back-driven: somebody pulls the jaws. Such a motor brakes, and its
back-EMF may raise the current above the goal (decision 21). Two steps of an X-series servo's Present Velocity."""

_MIN_DERATING = 0.6
"""Share of the target force at the temperature limit: a third of the heat."""


class SafetyLatch:
    """Fault latch: tripped by a failed check, and cleared only by a reset once the cause is gone.

    Deterministic: the same readings give the same results.

    Attributes:
        reason: Reason of the trip; empty while not tripped.
    """

    def __init__(self, config: ControlConfig) -> None:
        self.reason = ""
        self._config = config
        self._cause = ""
        self._last: ServoState | None = None
        self._over_s = self._excess_s = 0.0

    def check(self, servo: ServoState, goal_current_a: float, dt_s: float, *, over_force: bool) -> bool:
        """Checks a cycle's reading.

        Args:
            servo: This cycle's reading.
            goal_current_a: Goal current of the last cycle.
            dt_s: Time since the last cycle.
            over_force: True if the last cycle's force estimate was over its limit.

        Returns:
            True if the latch tripped in this cycle.
        """
        self._over_s = self._over_s + dt_s if over_force else 0.0
        if not exceeds_goal_current(servo.current_a, goal_current_a):
            self._excess_s = 0.0
        elif not is_back_driven(servo):
            self._excess_s += dt_s
        self._cause = self._find_fault(servo)
        if is_plausible(servo):
            self._last = servo
        return self.trip(self._cause) if self._cause else False

    def trip(self, reason: str) -> bool:
        """Trips the latch. Returns False if it was tripped before; the first reason is kept."""
        if self.reason:
            return False
        self.reason = reason
        return True

    def reset(self) -> str:
        """Clears the latch. Returns the cause that prevents it, or an empty text."""
        if not self._cause:
            self.reason = ""
        return self._cause

    def derating(self, temperature_c: float) -> float:
        """Returns the share of the target force to hold, which keeps a hot servo from shutting down."""
        warm_c, limit_c = self._config.warm_c, self._config.temperature_limit_c
        if temperature_c <= warm_c:
            return 1.0
        return max(1.0 - (1.0 - _MIN_DERATING) * (temperature_c - warm_c) / (limit_c - warm_c), _MIN_DERATING)

    def _find_fault(self, servo: ServoState) -> str:
        if not is_plausible(servo):
            return "the servo's reading is not finite"
        if servo.hardware_error:
            return f"the servo reports hardware error 0x{servo.hardware_error:02x}"
        if servo.temperature_c > self._config.temperature_limit_c:
            limit_c = self._config.temperature_limit_c
            return f"the servo is at {servo.temperature_c:.0f} C; control.temperature_limit_c is {limit_c:g}"
        low_v, high_v = self._config.voltage_limits_v or (-math.inf, math.inf)
        if not low_v <= servo.voltage_v <= high_v:
            return f"the servo's supply is at {servo.voltage_v:.1f} V, outside {low_v:g} to {high_v:g} V"
        if self._last is not None and self._jumps(self._last, servo):
            return f"the servo's position leapt to {servo.position_rad:.3f} rad"
        if self._excess_s > _EXCESS_S:
            return f"the motor takes {abs(servo.current_a):.3f} A, more than its goal allows"
        if self._over_s > _OVER_FORCE_S:
            return f"the force stayed over its limit for {_OVER_FORCE_S:g} s"
        return ""

    @staticmethod
    def _jumps(previous: ServoState, present: ServoState) -> bool:
        time_s = max(present.t_ns - previous.t_ns, 0) / NS_PER_S
        return abs(present.position_rad - previous.position_rad) > _JUMP_RAD + _JUMP_RAD_S * time_s


def exceeds_goal_current(current_a: float, goal_current_a: float) -> bool:
    """Returns True if a motor takes more current than its goal allows."""
    return abs(current_a) > (1 + _EXCESS_SHARE) * goal_current_a + _EXCESS_A


def is_back_driven(servo: ServoState) -> bool:
    """Returns True if the horn is turned against the motor."""
    return servo.current_a * servo.velocity_rad_s < 0 and abs(servo.velocity_rad_s) > _BACK_DRIVEN_RAD_S


def is_plausible(servo: ServoState) -> bool:
    """Returns True if every number of a reading is finite and of a plausible magnitude."""
    numbers = (
        servo.position_rad,
        servo.velocity_rad_s,
        servo.current_a,
        servo.temperature_c,
        servo.voltage_v,
    )
    return all(abs(number) <= 1e9 for number in numbers)
